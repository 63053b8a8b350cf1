"""TD3's targets, losses and updates (Fujimoto et al., 2018), over the networks of any agent.

Actions are in half ranges from the centre of the environment's range, within [-1, 1], so learning
does not depend on the units of the environment's actions; `Bounds` converts them. Shapes: ``B``
batch, ``A`` action elements.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import lax

from rtd3jax.agents.freeze import frozen_parts
from rtd3jax.agents.history import History
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.learners.base import Measured, Metrics, Networks, measured, not_measured
from rtd3jax.agents.memory.base import Params
from rtd3jax.agents.networks import Network, act, apply_network, carry_before, init_network
from rtd3jax.agents.noise import add_noise
from rtd3jax.agents.replay import Batch
from rtd3jax.config import Config

Critics = tuple[Params, Params]

SATURATED = 0.99
"""An action beyond this fraction of its half range counts as saturated."""

NORMS_EVERY = 16
"""Critic updates per measurement of gradient norms, because these read all parameters."""


@struct.dataclass
class TD3State:
    """Online networks, target networks, and Adam's moments."""

    actor: Params
    critics: Critics
    target_actor: Params
    target_critics: Critics
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState


_MOMENTUM = 0.9
# The learning rate may differ between lanes; `_descend` applies it.
_ADAM = optax.scale_by_adam(b1=_MOMENTUM)


@dataclasses.dataclass(frozen=True)
class TD3:
    """TD3 as a learner; see `rtd3jax.agents.learners.base.Learner`.

    Attributes:
        policy_delay: critic updates per update of the actor and the targets.
        frozen: parts of the networks that keep their values, as in `frozen_parts`. They are put
            back before the targets are averaged, which would otherwise follow steps of Adam that
            the networks never keep.
    """

    policy_delay: int = 2
    frozen: tuple[str, ...] = ()

    metrics = (
        "critic_loss",
        "critic_loss_1",
        "critic_loss_2",
        "action_value",
        "target",
        "actor_loss",
        "saturated_actions",
        "critic_gradient_norm",
        "actor_gradient_norm",
    )

    def init(self, key: jax.Array, networks: Networks) -> TD3State:
        """The initial state; the target networks equal the online networks."""
        actor_key, first_key, second_key = jax.random.split(key, 3)
        actor = init_network(actor_key, networks.actor)
        critics = (
            init_network(first_key, networks.critic),
            init_network(second_key, networks.critic),
        )
        return TD3State(
            actor=actor,
            critics=critics,
            # Copies: a donated buffer must not appear twice.
            target_actor=jax.tree.map(jnp.copy, actor),
            target_critics=jax.tree.map(jnp.copy, critics),
            actor_optimizer=_ADAM.init(actor),
            critic_optimizer=_ADAM.init(critics),
        )

    def update(
        self,
        networks: Networks,
        state: TD3State,
        batch: Batch,
        keys: jax.Array,
        hyperparameters: Hyperparameters,
        count: jax.Array,
    ) -> tuple[TD3State, Metrics]:
        """Update the critics, and every ``policy_delay``-th time the actor and the targets."""
        norms = count % NORMS_EVERY == 0
        actors_norm = count // self.policy_delay % max(1, NORMS_EVERY // self.policy_delay) == 0
        new, critic = update_critics(networks, state, batch, keys[0], hyperparameters, norms)
        state = frozen_parts(state, new, self.frozen)
        state, actor = lax.cond(
            count % self.policy_delay == 0,
            lambda before: update_actor_and_targets(
                networks, before, batch, keys[1], hyperparameters, actors_norm, self.frozen
            ),
            lambda before: (before, {name: not_measured() for name in ACTOR_METRICS}),
            state,
        )
        return state, critic | actor


def make_td3(config: Config) -> TD3:
    """The learner of a configuration."""
    return TD3(config.policy_delay, config.frozen)


def target(
    networks: Networks,
    state: TD3State,
    batch: Batch,
    key: jax.Array,
    hyperparameters: Hyperparameters,
) -> jax.Array:
    """``y = r + gamma (1 - terminated) min_i Q'_i(next, smoothed target action)``: [B].

    ``r`` is the reward times ``reward_scale``.
    """
    action = act(networks.actor, state.target_actor, batch.next_window)
    noise = hyperparameters.target_noise * jax.random.normal(key, action.shape, jnp.float32)
    clip = hyperparameters.target_noise_clip
    action = jnp.clip(action + jnp.clip(noise, -clip, clip), -1.0, 1.0)
    first, second = (
        _value(networks.critic, critic, batch.next_window, action, batch.next_carry)
        for critic in state.target_critics
    )
    bootstrap = jnp.where(batch.terminated, 0.0, jnp.minimum(first, second))
    return hyperparameters.reward_scale * batch.reward + hyperparameters.gamma * bootstrap


def critic_loss(
    params: Params, critic: Network, batch: Batch, y: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """The mean squared error of one critic against ``y`` [B], and the mean of its values.

    The loss of both critics is the sum of their errors.
    """
    value = _value(critic, params, batch.window, batch.recorded_action, batch.carry)
    error = value - y
    return jnp.mean(error**2), jnp.mean(value)


def actor_loss(
    params: Params,
    critic_params: Params,
    networks: Networks,
    batch: Batch,
    key: jax.Array,
    noise: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The actor's loss, and the fraction of saturated actions.

    The loss is the negative mean of the first critic's values of the actor's actions.

    With ``noise`` [] > 0, Gaussian noise is added to each action of the batch, so the actor
    maximises a smoothed action value (Nachum et al., 2018): the critic has learned values around
    the explored actions, but its gradient at a single action is irregular. With 0, the loss is
    TD3's.
    """
    greedy = act(networks.actor, params, batch.window)
    action = add_noise(key, greedy, noise)
    carry = batch.carry
    if carry is None and networks.critic.reads.memory:
        # The past tokens do not depend on the actor, so no gradient flows into them.
        carry = carry_before(networks.critic, critic_params, batch.window)
    saturated = jnp.mean((jnp.abs(greedy) > SATURATED).astype(jnp.float32))
    value = _value(networks.critic, critic_params, batch.window, action, carry)
    return -jnp.mean(value), saturated


def update_critics(
    networks: Networks,
    state: TD3State,
    batch: Batch,
    key: jax.Array,
    hyperparameters: Hyperparameters,
    norms: jax.Array,
) -> tuple[TD3State, Metrics]:
    """One Adam step of both critics; ``norms`` bool []: whether to measure the gradient norms."""
    y = target(networks, state, batch, key, hyperparameters)
    pair = jax.tree.map(lambda *leaves: jnp.stack(leaves), *state.critics)
    # One critic after the other: the intermediate values of both do not fit in a CPU's cache.
    (losses, values), gradients = lax.map(
        lambda params: jax.value_and_grad(critic_loss, has_aux=True)(
            params, networks.critic, batch, y
        ),
        pair,
    )
    gradient = tuple(jax.tree.map(lambda leaf, i=i: leaf[i], gradients) for i in range(2))
    critics, optimizer = _descend(
        state.critics, gradient, state.critic_optimizer, hyperparameters.critic_learning_rate
    )
    metrics = {
        "critic_loss": measured(jnp.sum(losses)),
        "critic_loss_1": measured(losses[0]),
        "critic_loss_2": measured(losses[1]),
        "action_value": measured(values[0]),
        "target": measured(jnp.mean(y)),
        "critic_gradient_norm": _norm(norms, gradients),
    }
    return dataclasses.replace(state, critics=critics, critic_optimizer=optimizer), metrics


ACTOR_METRICS = ("actor_loss", "saturated_actions", "actor_gradient_norm")


def update_actor_and_targets(
    networks: Networks,
    state: TD3State,
    batch: Batch,
    key: jax.Array,
    hyperparameters: Hyperparameters,
    norms: jax.Array,
    frozen: tuple[str, ...] = (),
) -> tuple[TD3State, Metrics]:
    """One Adam step of the actor, without its ``frozen`` parts; then Polyak averaging."""
    (loss, saturated), gradient = jax.value_and_grad(actor_loss, has_aux=True)(
        state.actor, state.critics[0], networks, batch, key, hyperparameters.actor_noise
    )
    actor, optimizer = _descend(
        state.actor, gradient, state.actor_optimizer, hyperparameters.actor_learning_rate
    )
    tau, before = hyperparameters.tau, state.actor_optimizer.mu
    actor = frozen_parts(state, dataclasses.replace(state, actor=actor), frozen).actor

    def average(online, target):
        return jax.tree.map(lambda new, old: old + tau * (new - old), online, target)

    state = dataclasses.replace(
        state,
        actor=actor,
        actor_optimizer=optimizer,
        target_actor=average(actor, state.target_actor),
        target_critics=average(state.critics, state.target_critics),
    )
    norm = _norm(norms, _as_measured(gradient, before, optimizer.mu))
    found = measured(loss), measured(saturated), norm
    return state, dict(zip(ACTOR_METRICS, found, strict=True))


def _value(critic: Network, params: Params, history: History, action, carry) -> jax.Array:
    return apply_network(critic, params, history, action, carry)[:, 0]


def _norm(wanted: jax.Array, gradient: Params) -> Measured:
    """The Euclidean norm of the whole ``gradient``, if it is ``wanted``."""
    return lax.cond(wanted, lambda: measured(jnp.linalg.norm(_flat(gradient))), not_measured)


def _flat(tree: Params) -> jax.Array:
    """All numbers of ``tree`` in one array: XLA compiles this faster than a sum for each leaf."""
    return jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(tree)])


def _as_measured(gradient: Params, before: Params, after: Params) -> Params:
    """The actor's ``gradient``, which took Adam's first moments from ``before`` to ``after``.

    XLA fuses Adam's step with the sums that give the gradients of biases, and of a memory's input
    kernel (the sum of two products). It would round the step differently if anything else read
    these gradients. So they are computed from the moments, which makes XLA keep a copy of the
    moments before the step. The other matrices are larger, and results of one product each.
    """

    def leaf(path: tuple, own: jax.Array, old: jax.Array, new: jax.Array) -> jax.Array:
        is_product = own.ndim > 1 and path[-1].key != "input_kernel"
        return own if is_product else (new - _MOMENTUM * old) / (1.0 - _MOMENTUM)

    return jax.tree_util.tree_map_with_path(leaf, gradient, before, after)


def _descend(params, gradient, optimizer, learning_rate):
    with jax.numpy_dtype_promotion("standard"):  # optax needs standard promotion
        direction, optimizer = _ADAM.update(gradient, optimizer)
    return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), optimizer
