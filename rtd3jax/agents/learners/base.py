"""`Learner`: the interface of learners, and their registration."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from rtd3jax.agents.networks import Network
from rtd3jax.agents.replay import Batch
from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.registries import LEARNERS


class Networks(NamedTuple):
    """The modules of an agent's actor and critic; both critics use the same module."""

    actor: Network
    critic: Network


class Measured(NamedTuple):
    """A quantity to be averaged over an evaluation interval: its sum and number of measurements."""

    total: jax.Array
    times: jax.Array


def measured(value: jax.Array) -> Measured:
    """A single measurement of ``value`` []."""
    return Measured(value.astype(jnp.float32), jnp.float32(1.0))


def not_measured() -> Measured:
    """Zero measurements."""
    return Measured(jnp.float32(0.0), jnp.float32(0.0))


Metrics = dict[str, Measured]


class Learner(Protocol):
    """The algorithm that trains an agent's networks."""

    @property
    def metrics(self) -> tuple[str, ...]:
        """Names of the quantities that `update` measures; they include ``critic_loss``, which must
        stay finite, or the lane is lost."""

    def init(self, key: jax.Array, networks: Networks) -> Any:
        """The initial state: a dataclass of arrays whose field ``actor`` holds the actor.

        ``freeze`` and ``actor_starts`` of `rtd3jax.Config` find the parts of it by name: ``actor``
        and ``critics``; ``target_actor`` and ``actor_optimizer`` start with the actor.
        """

    def update(
        self,
        networks: Networks,
        state: Any,
        batch: Batch,
        keys: jax.Array,
        hyperparameters: Any,
        count: jax.Array,
    ) -> tuple[Any, Metrics]:
        """One update.

        Args:
            networks: actor and critic.
            state: the learner's state.
            batch: a batch from the replay.
            keys: [2], consumed here.
            hyperparameters: the lane's `rtd3jax.agents.hyperparameters.Hyperparameters` at this
                step.
            count: int32 [], 1 for the first update.
        """


def register_learner(
    name: str, make: Callable[[Config], Learner], *, replace: bool = False
) -> None:
    """Register a learner, for use in a `Variant`.

    Args:
        name: the name of the learner.
        make: returns the learner of a configuration; equal configurations give equal learners.
        replace: whether it may replace a learner of the same name.

    Raises:
        UserError: when the name is taken or ``make`` cannot be called.
    """
    if not callable(make):
        raise UserError(f"learner {name!r} must be a function of a Config, not {make!r}")
    LEARNERS.register(name, make, replace=replace)
