"""`Agent`: networks, learner and replay of one configuration.

Actions are in half ranges. Shapes: ``B`` batch, ``O`` and ``A`` sizes of an observation and an
action.
"""

import dataclasses
import functools
from typing import Any, Protocol

import jax

from rtd3jax.agents.freeze import check_fields, check_parts, frozen_parts, waiting_actor
from rtd3jax.agents.history import Window, next_window
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.learners.base import Learner, Metrics, Networks
from rtd3jax.agents.memory.base import Carry, Memory, Params
from rtd3jax.agents.networks import (
    Network,
    act,
    advance,
    carry_before,
    init_network,
    make_network,
    part_sizes,
)
from rtd3jax.agents.normalise import Normaliser, Statistics, no_statistics, normalised
from rtd3jax.agents.replay import Batch, Replay, empty_replay, sample, sample_segments
from rtd3jax.agents.variants import Variant
from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS, LEARNERS, MEMORIES


class Sizes(Protocol):
    """Sizes of an environment, such as those of `rtd3jax.envs.interface.Interface`."""

    @property
    def observation_size(self) -> int:
        """O, the number of elements of an observation."""

    @property
    def action_size(self) -> int:
        """A, the number of elements of an action."""

    @property
    def true_observation_size(self) -> int:
        """S, for the undisturbed observation; 0 if the environment does not give it."""


@dataclasses.dataclass(frozen=True)
class Agent:
    """An agent as pure functions of one lane's arrays.

    Attributes:
        variant: the definition of the agent.
        networks: actor and critic for updates, in the configuration's precision.
        acting_actor: the actor in float32, for acting and for policies.
        learner: the learner that trains the networks.
        config: the configuration.
        observation_size: O.
        action_size: A.
        true_observation_size: S, if the critics read the undisturbed observation, else 0.
    """

    variant: Variant
    networks: Networks
    acting_actor: Network
    learner: Learner
    config: Config
    observation_size: int
    action_size: int
    true_observation_size: int

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the quantities that `update` measures."""
        return self.learner.metrics

    @property
    def has_running_carry(self) -> bool:
        """Whether the agent acts with a carry from the start of the episode, not with a window."""
        return self.config.has_running_carry

    @property
    def acting_tokens(self) -> int:
        """Past tokens in the arrays of the window with which the agent acts."""
        return 0 if self.has_running_carry else self.config.window_tokens

    def init(self, key: jax.Array) -> Any:
        """The initial state of the learner; its field ``actor`` holds the actor's parameters."""
        return self.learner.init(key, self.networks)

    @property
    def stores_carry(self) -> bool:
        """Whether the replay stores the actor's carries, for the critics or for segments."""
        from_carries = self.has_running_carry and self.config.replay == "segments"
        return self.variant.critic_reads_carries or from_carries

    @property
    def reads_truth(self) -> bool:
        """Whether the critics read the undisturbed observation, which the replay then stores."""
        return self.true_observation_size > 0

    def empty_replay(self) -> Replay:
        """An empty ring buffer for the agent's transitions."""
        carry = self.acting_actor.zero_carry(1) if self.stores_carry else None
        return empty_replay(
            self.config.capacity,
            self.observation_size,
            self.action_size,
            carry,
            self.config.environments,
            self.true_observation_size,
        )

    def zero_carry(self) -> Carry | None:
        """The running carries, leaves [E, ...], at the start of episodes; None with windows."""
        return (
            self.acting_actor.zero_carry(self.config.environments)
            if self.has_running_carry
            else None
        )

    def no_statistics(self) -> Statistics | None:
        """Statistics of zero observations; None without normalisation of observations."""
        return no_statistics(self.observation_size) if self.config.normalise_observations else None

    def no_true_statistics(self) -> Statistics | None:
        """As `no_statistics`, of undisturbed observations; None if the critics do not read them."""
        wanted = self.config.normalise_observations and self.reads_truth
        return no_statistics(self.true_observation_size) if wanted else None

    def act(
        self, actor: Params, window: Window, running: Carry | None
    ) -> tuple[jax.Array, Carry | None]:
        """The deterministic action [B, A], and the carry that the replay stores, or None.

        Args:
            actor: the actor's parameters.
            window: the window of the step; it has no past tokens with a running carry.
            running: the running carry before the step; None with windows.
        """
        carry = running
        if carry is None and self.variant.critic_reads_carries:
            carry = carry_before(self.acting_actor, actor, window)
        kept = carry if self.stores_carry else None
        return act(self.acting_actor, actor, window, carry), kept

    def carry_after(
        self, actor: Params, window: Window, action: jax.Array, running: Carry | None
    ) -> Carry | None:
        """The running carry after a step with ``action`` [B, A]; None with windows."""
        if running is None:
            return None
        return advance(self.acting_actor, actor, window, action, running)

    def final_carry(
        self,
        actor: Params,
        window: Window,
        action: jax.Array,
        final_observation: jax.Array,
        history_length: jax.Array,
        running: Carry | None,
    ) -> Carry:
        """The carry before the final observation [B, O] of an episode, after ``action`` [B, A].

        With a running carry, it is ``running``, which `carry_after` returned.
        """
        if running is not None:
            return running
        after = next_window(window, action, final_observation, history_length)
        return carry_before(self.acting_actor, actor, after)

    def sample(
        self,
        replay: Replay,
        key: jax.Array,
        count: jax.Array,
        history_length: jax.Array,
        normaliser: Normaliser | None,
        of_truth: Normaliser | None = None,
    ) -> Batch:
        """A batch from the ``count`` steps written so far, with normalised observations."""
        batch = self._sample(replay, key, count, history_length)
        return dataclasses.replace(
            batch,
            window=normalised(batch.window, normaliser, of_truth),
            next_window=normalised(batch.next_window, normaliser, of_truth),
        )

    def _sample(
        self, replay: Replay, key: jax.Array, count: jax.Array, history_length: jax.Array
    ) -> Batch:
        config = self.config
        rows = replay, key, count, config.batch_size, config.window_tokens, history_length
        if config.replay == "segments":
            return sample_segments(
                *rows,
                config.segment_steps,
                config.burn_in_gradient,
                critic_reads_carries=self.variant.critic_reads_carries,
                actor_reads_carries=config.has_running_carry,
            )
        return sample(*rows)

    def update(
        self,
        state: Any,
        batch: Batch,
        keys: jax.Array,
        hyperparameters: Hyperparameters,
        count: jax.Array,
    ) -> tuple[Any, Metrics]:
        """The update number ``count`` (int32 [], from 1); it consumes ``keys`` [2]."""
        new, metrics = self.learner.update(
            self.networks, state, batch, keys, hyperparameters, count
        )
        waits = self.config.updates_before_the_actor
        if waits:
            new = waiting_actor(state, new, count > waits)
        return frozen_parts(state, new, self.config.frozen), metrics


def make_agent(config: Config, interface: Sizes) -> Agent:
    """The agent of ``config`` for environments of ``interface``.

    Raises:
        UserError: when the agent, its memory or its learner is unknown, or violates its
            interface.
    """
    variant: Variant = AGENTS[config.algorithm]
    sizes = interface.observation_size, interface.action_size, config.hidden_size
    truth = interface.true_observation_size if variant.reads_truth else 0
    if variant.reads_truth and not truth:
        raise UserError(
            f"agent {config.algorithm!r}: its critics read the undisturbed observation, which the "
            "environment does not tell: disturb it with rtd.disturb, or give it a method "
            "true_observation(state, params) and step's info['true_observation']"
        )
    actor, critic = (
        make_part(variant, role, config.memory, *sizes, config.precision, truth)
        for role in ("actor", "critic")
    )
    networks, learner = Networks(actor, critic), LEARNERS[variant.learner](config)
    if config.frozen:
        check_parts(config.frozen, {"actor": actor, "critics": critic})
        state = jax.eval_shape(lambda: learner.init(jax.random.key(0), networks))
        check_fields(config.frozen, state, variant.learner)
    return Agent(
        variant=variant,
        networks=networks,
        acting_actor=make_part(variant, "actor", config.memory, *sizes),
        learner=learner,
        config=config,
        observation_size=interface.observation_size,
        action_size=interface.action_size,
        true_observation_size=truth,
    )


def make_part(
    variant: Variant,
    role: str,
    memory: str,
    observation_size: int,
    action_size: int,
    width: int,
    precision: str = "float32",
    true_observation_size: int = 0,
) -> Network:
    """An agent's ``actor`` or ``critic``.

    Args:
        variant: the agent.
        role: ``actor`` or ``critic``.
        memory: the name of the recurrent cell.
        observation_size: O.
        action_size: A.
        width: width H of every layer.
        precision: precision of the factors of large products.
        true_observation_size: S; 0 for S = O.
    """
    # The class is part of the key, so that a memory that replaced another takes effect.
    sizes = observation_size, action_size, width
    return _part(variant, role, memory, MEMORIES[memory], *sizes, precision, true_observation_size)


def count_parameters(
    algorithm: str,
    obs_dim: int,
    act_dim: int,
    hidden_size: int = 128,
    memory: str = "lstm",
) -> dict[str, int]:
    """Numbers of parameters of one actor and one critic, counted from initialised networks.

    ``count_parameters("lstm-td3", obs_dim=3, act_dim=1)`` gives the paper's Table 5.
    """
    variant = AGENTS[algorithm]

    def count(role: str) -> int:
        network = make_part(variant, role, memory, obs_dim, act_dim, hidden_size)
        params = jax.eval_shape(lambda: init_network(jax.random.key(0), network))
        return sum(leaf.size for leaf in jax.tree.leaves(params))

    return {role: count(role) for role in ("actor", "critic")}


@functools.cache
def _part(
    variant: Variant,
    role: str,
    memory: str,
    module: type[Memory],
    observation_size: int,
    action_size: int,
    width: int,
    precision: str,
    true_observation_size: int,
) -> Network:
    return make_network(
        getattr(variant, role),
        memory,
        part_sizes(observation_size, action_size, true_observation_size),
        width,
        action_size if role == "actor" else 1,
        precision,
        variant.encoder,
    )
