"""TD3's targets, losses and updates (Fujimoto et al., 2018), over any of the six agents.

Actions in here are in half ranges about the centre of the environment's range, within [-1, 1], so
that an agent learns the same in whatever unit the environment takes its actions; `Bounds` converts
at the border. Shapes: ``B`` batch, ``A`` action elements.
"""

import dataclasses

import jax
import jax.numpy as jnp
import optax
from flax import struct
from jax import lax

from rtd3jax.agents.lstm import Carry
from rtd3jax.agents.networks import (
    Params,
    apply_network,
    carry_before,
    init_network,
    part_sizes,
)
from rtd3jax.agents.replay import Batch
from rtd3jax.agents.variants import Variant
from rtd3jax.agents.windows import Window

Critics = tuple[Params, Params]


@struct.dataclass
class Hyperparameters:
    """The numbers in which lanes of one program may differ: float32 [] each, l int32 []."""

    actor_learning_rate: jax.Array
    critic_learning_rate: jax.Array
    final_learning_rate_fraction: jax.Array
    gamma: jax.Array
    reward_scale: jax.Array
    tau: jax.Array
    exploration_noise: jax.Array
    target_noise: jax.Array
    target_noise_clip: jax.Array
    actor_noise: jax.Array
    history_length: jax.Array

    def at(self, progress: jax.Array) -> "Hyperparameters":
        """These numbers when the share ``progress`` [] of all steps is done: the rates decay."""
        scale = 1.0 - (1.0 - self.final_learning_rate_fraction) * progress
        return dataclasses.replace(
            self,
            actor_learning_rate=scale * self.actor_learning_rate,
            critic_learning_rate=scale * self.critic_learning_rate,
        )


@struct.dataclass
class Bounds:
    """The range of the environment's action, in its own units. ``low`` and ``high``: [A]."""

    low: jax.Array
    high: jax.Array

    @property
    def half_range(self) -> jax.Array:
        """Half the distance between the bounds: [A]; the unit in which agents act."""
        return 0.5 * self.high - 0.5 * self.low

    @property
    def centre(self) -> jax.Array:
        """The middle of the range: [A]."""
        return 0.5 * self.high + 0.5 * self.low

    def to_environment(self, action: jax.Array) -> jax.Array:
        """An agent's ``action`` [A], in half ranges about the centre, in the environment's units.

        It is within the bounds, also where the sum is rounded.
        """
        return jnp.clip(self.centre + self.half_range * action, self.low, self.high)


@struct.dataclass
class Learner:
    """Online and target networks, and Adam's moments."""

    actor: Params
    critics: Critics
    target_actor: Params
    target_critics: Critics
    actor_optimizer: optax.OptState
    critic_optimizer: optax.OptState


_ADAM = optax.scale_by_adam()  # the learning rate is a lane's own number, applied in _descend


def init_learner(
    key: jax.Array, variant: Variant, observation_size: int, action_size: int, width: int
) -> Learner:
    """A learner whose targets equal its online networks."""
    sizes = part_sizes(observation_size, action_size)
    actor_key, first_key, second_key = jax.random.split(key, 3)
    actor = init_network(actor_key, variant.actor, sizes, width, action_size)
    critics = (
        init_network(first_key, variant.critic, sizes, width, 1),
        init_network(second_key, variant.critic, sizes, width, 1),
    )
    return Learner(
        actor=actor,
        critics=critics,
        # Copies: a donated buffer must not appear twice.
        target_actor=jax.tree.map(jnp.copy, actor),
        target_critics=jax.tree.map(jnp.copy, critics),
        actor_optimizer=_ADAM.init(actor),
        critic_optimizer=_ADAM.init(critics),
    )


def act(params: Params, variant: Variant, window: Window, carry: Carry | None = None) -> jax.Array:
    """The deterministic action [B, A] of an actor: tanh of the network's output."""
    return jnp.tanh(apply_network(params, variant.actor, window, carry=carry))


def add_noise(key: jax.Array, action: jax.Array, scale: jax.Array) -> jax.Array:
    """``action`` [B, A] with Gaussian noise of standard deviation ``scale`` [], within [-1, 1]."""
    gaussian = jax.random.normal(key, action.shape, jnp.float32)
    return jnp.clip(action + scale * gaussian, -1.0, 1.0)


def target(
    learner: Learner,
    variant: Variant,
    batch: Batch,
    key: jax.Array,
    hyperparameters: Hyperparameters,
) -> jax.Array:
    """``y = r + gamma (1 - terminated) min_i Q'_i(next, smoothed target action)``: [B].

    ``r`` is the reward times ``reward_scale``.
    """
    action = act(learner.target_actor, variant, batch.next_window)
    noise = hyperparameters.target_noise * jax.random.normal(key, action.shape, jnp.float32)
    clip = hyperparameters.target_noise_clip
    action = jnp.clip(action + jnp.clip(noise, -clip, clip), -1.0, 1.0)
    first, second = (
        _value(critic, variant, batch.next_window, action, batch.next_carry)
        for critic in learner.target_critics
    )
    bootstrap = jnp.where(batch.terminated, 0.0, jnp.minimum(first, second))
    return hyperparameters.reward_scale * batch.reward + hyperparameters.gamma * bootstrap


def critic_loss(critic: Params, variant: Variant, batch: Batch, y: jax.Array) -> jax.Array:
    """One critic's mean-squared error against ``y`` [B]; the loss is the sum over the two."""
    error = _value(critic, variant, batch.window, batch.action, batch.carry) - y
    return jnp.mean(error**2)


def actor_loss(
    actor: Params,
    critic: Params,
    variant: Variant,
    batch: Batch,
    key: jax.Array,
    noise: jax.Array,
) -> jax.Array:
    """Minus the first critic's mean value of the actor's actions, averaged over noise on them.

    With ``noise`` [] > 0 the actor climbs a smoothed action value (Nachum et al., 2018), by one
    draw for each of the batch: a critic knows the value around where exploration went, while its
    slope at a single action is mostly kinks. With 0 it is TD3's loss.
    """
    action = add_noise(key, act(actor, variant, batch.window), noise)
    carry = batch.carry
    if carry is None and variant.critic.memory:
        # No past token depends on the actor: the critic's prefix needs no tape.
        carry = carry_before(critic, variant.critic, batch.window)
    return -jnp.mean(_value(critic, variant, batch.window, action, carry))


def update_critics(
    learner: Learner,
    variant: Variant,
    batch: Batch,
    key: jax.Array,
    hyperparameters: Hyperparameters,
) -> tuple[Learner, jax.Array]:
    """One Adam step of both critics; the learner and the loss []."""
    y = target(learner, variant, batch, key, hyperparameters)
    pair = jax.tree.map(lambda *leaves: jnp.stack(leaves), *learner.critics)
    # One after the other, so that one tape is alive at a time: two do not fit in a CPU's cache.
    losses, gradients = lax.map(
        lambda critic: jax.value_and_grad(critic_loss)(critic, variant, batch, y), pair
    )
    loss = jnp.sum(losses)
    gradient = tuple(jax.tree.map(lambda leaf, i=i: leaf[i], gradients) for i in range(2))
    critics, optimizer = _descend(
        learner.critics, gradient, learner.critic_optimizer, hyperparameters.critic_learning_rate
    )
    return dataclasses.replace(learner, critics=critics, critic_optimizer=optimizer), loss


def update_actor_and_targets(
    learner: Learner,
    variant: Variant,
    batch: Batch,
    key: jax.Array,
    hyperparameters: Hyperparameters,
) -> Learner:
    """One Adam step of the actor, then Polyak averaging of all targets."""
    gradient = jax.grad(actor_loss)(
        learner.actor,
        learner.critics[0],
        variant,
        batch,
        key,
        hyperparameters.actor_noise,
    )
    actor, optimizer = _descend(
        learner.actor, gradient, learner.actor_optimizer, hyperparameters.actor_learning_rate
    )
    tau = hyperparameters.tau

    def average(online, target):
        return jax.tree.map(lambda new, old: old + tau * (new - old), online, target)

    return dataclasses.replace(
        learner,
        actor=actor,
        actor_optimizer=optimizer,
        target_actor=average(actor, learner.target_actor),
        target_critics=average(learner.critics, learner.target_critics),
    )


def _value(critic: Params, variant: Variant, window: Window, action, carry) -> jax.Array:
    return apply_network(critic, variant.critic, window, action, carry)[:, 0]


def _descend(params, gradient, optimizer, learning_rate):
    with jax.numpy_dtype_promotion("standard"):  # optax relies on it
        direction, optimizer = _ADAM.update(gradient, optimizer)
    return jax.tree.map(lambda p, d: p - learning_rate * d, params, direction), optimizer
