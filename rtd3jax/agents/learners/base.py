"""`Learner`: the interface of what trains networks, and the table of those that there are."""

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
    """An agent's modules; every critic is of the same one."""

    actor: Network
    critic: Network


class Measured(NamedTuple):
    """A quantity that is averaged over an evaluation interval: its sum, and how often measured."""

    total: jax.Array
    times: jax.Array


def measured(value: jax.Array) -> Measured:
    """One measurement of ``value`` []."""
    return Measured(value.astype(jnp.float32), jnp.float32(1.0))


def not_measured() -> Measured:
    """None."""
    return Measured(jnp.float32(0.0), jnp.float32(0.0))


Metrics = dict[str, Measured]


class Learner(Protocol):
    """What an agent learns by."""

    @property
    def metrics(self) -> tuple[str, ...]:
        """What `update` measures; ``critic_loss`` is among it, and a lane is lost when that is not
        finite."""

    def init(self, key: jax.Array, networks: Networks) -> Any:
        """The state at the start: a pytree of arrays with the actor's parameters as ``actor``."""

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
            state: of `init`.
            batch: of the replay.
            keys: [2], consumed here.
            hyperparameters: the lane's `rtd3jax.agents.hyperparameters.Hyperparameters`, at this
                step.
            count: int32 [], 1 for the first update.
        """


def register_learner(
    name: str, make: Callable[[Config], Learner], *, replace: bool = False
) -> None:
    """Add a learner, which a `Variant` names.

    Args:
        name: by which variants know it.
        make: gives the learner of a configuration; equal configurations, equal learners.
        replace: whether it may take the place of another of that name.

    Raises:
        UserError: when the name is taken or ``make`` cannot be called.
    """
    if not callable(make):
        raise UserError(f"learner {name!r} must be a function of a Config, not {make!r}")
    LEARNERS.register(name, make, replace=replace)
