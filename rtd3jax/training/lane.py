"""A lane: the data in which lanes of one program differ, and its state between two steps."""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.memory.base import Carry
from rtd3jax.agents.normalise import Statistics
from rtd3jax.agents.replay import Replay
from rtd3jax.config import Config, traced_fields
from rtd3jax.training.metrics import Averages

HEALTHY, ENVIRONMENT_NOT_FINITE, LOSS_NOT_FINITE, ACTION_NOT_FINITE = range(4)


@struct.dataclass
class Lane:
    """The data in which lanes of one program differ.

    Attributes:
        seed: uint32 [].
        hyperparameters: traced numbers of the configuration.
        env_params: the environment's parameters.
    """

    seed: jax.Array
    hyperparameters: Hyperparameters
    env_params: Any


@struct.dataclass
class LaneState:
    """The state of a lane between two steps. ``K`` evaluations, ``E`` environments.

    Attributes:
        learner: the learner's state: networks and optimisers.
        replay: the replay of transitions.
        statistics: statistics of the observations, if networks read them normalised; else None.
        true_statistics: the same of the undisturbed observations, if critics read them.
        env_state: the state of the environment; with a leading axis for several environments.
        observation: [E, O], the current observations.
        previous_action: [E, A], in half ranges; zero at the start of an episode.
        episode_step: int32 [E], number of steps of the episode so far.
        carry: the actor's running carry, leaves [E, ...]; None without one.
        returns: [K], mean return of each evaluation so far.
        true_returns: [K], mean return of the undisturbed state's reward.
        metrics: metrics of learning, averaged over each interval between evaluations.
        failure: int32 [], HEALTHY, or the first quantity that was not finite.
        failed_at: int32 [], the step of the failure.
    """

    learner: Any
    replay: Replay
    statistics: Statistics | None
    env_state: Any
    observation: jax.Array
    previous_action: jax.Array
    episode_step: jax.Array
    carry: Carry | None
    returns: jax.Array
    true_returns: jax.Array
    metrics: Averages
    failure: jax.Array
    failed_at: jax.Array
    true_statistics: Statistics | None = None


def make_lane(config: Config, seed: int, env_params: object) -> Lane:
    """A lane of the program of `make_program`; its leaves are concrete arrays."""
    numbers = {name: jnp.float32(getattr(config, name)) for name in traced_fields()}
    numbers["history_length"] = jnp.int32(config.window_tokens)
    return Lane(jnp.uint32(seed), Hyperparameters(**numbers), as_arrays(env_params))


def as_arrays(env_params: object) -> Any:
    """The parameters of an environment as JAX arrays; JAX arrays are not copied."""
    return jax.tree.map(_array, env_params)


def _array(leaf: ArrayLike) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32 if isinstance(leaf, float) else None)
