"""Starts of training from trained networks: from a policy, or from the whole learner of a lane.

A policy contains its actor, and the statistics that normalise its observations. A checkpoint also
contains the critics, the targets and the optimisers. The replay, the state of the environment and
the random numbers always belong to the new lane.
"""

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.agents.normalise import Normaliser, Statistics
from rtd3jax.config import Config
from rtd3jax.errors import UserError
from rtd3jax.policies.trained import Policy
from rtd3jax.system.files import read_arrays
from rtd3jax.training.checkpoint_arrays import leaves_from_arrays
from rtd3jax.training.lane import HEALTHY, Lane, LaneState
from rtd3jax.training.loop import Program

KNOWN_OBSERVATIONS = 1_000
"""Number of observations for which a policy's statistics count in the statistics of a new lane."""

_TAKEN = "learner", "statistics", "true_statistics"
"""The parts of a `LaneState` in a lane's checkpoint from which training continues."""

_FATE = ".failure", ".failed_at"


@dataclasses.dataclass(frozen=True)
class Start:
    """The networks from which one lane starts.

    Attributes:
        where: the name of the source, for messages and tables.
        policy: the trained policy, if the source is a policy.
        checkpoint: the checkpoint of a lane, if the source is a lane.
        missing: the reason why the source cannot be read. This is an error only for a lane without
            checkpoints of its own, because other lanes do not need their start any more.
    """

    where: str
    policy: Policy | None = None
    checkpoint: Path | None = None
    missing: str | None = None

    @property
    def about(self) -> str:
        """The networks that the lane takes over, and their source, for tables."""
        whole = "actor, critics and optimisers" if self.checkpoint is not None else "actor"
        return f"{whole} of {self.where}"

    def begin(self, program: Program, lane: Lane, state: LaneState) -> LaneState:
        """The lane's ``state`` before its first step, with the networks of this start.

        Raises:
            UserError: when the networks are of another agent or other sizes, or cannot be read.
        """
        begun = self._begin(program, lane, state)
        self.__dict__.pop("_read", None)  # the arrays are now in the lane's state
        return begun

    def check(self, program: Program, lane: Lane) -> None:
        """Raise the errors of `begin` before anything is compiled; `begin` uses the read arrays."""
        self._begin(program, lane, jax.eval_shape(program.init, lane))

    def _begin(self, program: Program, lane: Lane, state: LaneState) -> LaneState:
        if self.missing is not None:
            raise UserError(
                f"a lane that began from {self.where} cannot start over: {self.missing}"
            )
        if self.checkpoint is not None:
            return self._whole(program, lane, state)
        policy = self.policy
        assert policy is not None
        self._check(program, policy)
        statistics = state.statistics
        if policy.normaliser is not None:
            statistics = _statistics_of(policy.normaliser)
        learner = state.learner
        # Copies: a lane's buffers are donated, but the owner of the policy keeps using it. On no
        # fixed device: policies of several devices may start lanes of one group.
        names = [name for name in ("actor", "target_actor") if hasattr(learner, name)]
        parts = {name: jax.tree.map(_copy, policy.actor) for name in names}
        learner = dataclasses.replace(learner, **parts)
        return dataclasses.replace(state, learner=learner, statistics=statistics)

    def _check(self, program: Program, policy: Policy) -> None:
        config, sizes = program.config, (program.observation_size, program.action_size)
        there = {
            "algorithm": policy.algorithm,
            "memory": policy.memory,
            "hidden_size": policy.width,
            "normalise_observations": policy.normaliser is not None,
        }
        self._compare(there, config.to_dict(), program)
        own = policy.observation_size, int(np.prod(policy.action_shape, dtype=int))
        if own != sizes:
            raise UserError(
                f"{self.where} is of a plant with {own[0]} observation and {own[1]} action "
                f"elements, and this one has {sizes[0]} and {sizes[1]}"
            )
        if np.any(np.asarray(policy.centre_token)):
            raise UserError(
                f"{self.where} was written by rtd3jax 0.1 for actions whose range is not about "
                "zero; no training can go on from it"
            )

    def _compare(self, there: Mapping[str, Any], here: Mapping[str, Any], program: Program) -> None:
        fields = ["algorithm", "hidden_size", "normalise_observations"]
        if program.agent.acting_actor.memory is not None:
            fields.append("memory")
        for name in fields:
            # A file of an earlier version may lack the field, which then has its default.
            before = there.get(name, getattr(Config, name, None))
            if before != here[name]:
                raise UserError(
                    f"{self.where} has {name}={before}, and the new training "
                    f"{here[name]}: they must agree"
                )

    @functools.cached_property
    def _read(self) -> tuple[dict[str, np.ndarray], Any]:
        """The arrays that a new lane takes over, by their names in the checkpoint, and the identity
        of the checkpoint's lane; without the replay."""
        assert self.checkpoint is not None
        arrays, about = read_arrays(self.checkpoint)
        places = tuple(f".{name}{mark}" for name in _TAKEN for mark in ".[")
        kept = {n: array for n, array in arrays.items() if n.startswith(places) or n in _FATE}
        return kept, about.get("identity") if isinstance(about, dict) else None

    def _whole(self, program: Program, lane: Lane, state: LaneState) -> LaneState:
        assert self.checkpoint is not None
        arrays, identity = self._read
        if int(arrays.get(".failure", HEALTHY)) != HEALTHY:
            raise UserError(
                f"{self.where} was lost in training, at step {int(arrays['.failed_at']):,}: no "
                "training can go on from it"
            )
        self._compare(identity or {}, program.config.to_dict(), program)
        expected = jax.eval_shape(program.init, lane)
        found = {
            name: leaves_from_arrays(getattr(expected, name), arrays, f".{name}", self.checkpoint)
            for name in _TAKEN
        }
        return dataclasses.replace(state, **found)


def _statistics_of(normaliser: Normaliser) -> Statistics:
    mean, scale = _copy(normaliser.mean), _copy(normaliser.scale)
    count = jnp.int32(KNOWN_OBSERVATIONS)
    return Statistics(count, mean, jnp.zeros_like(mean), 1.0 / jnp.square(scale))


def _copy(array: jax.Array) -> jax.Array:
    """A copy on JAX's default device; `jnp.array` alone would stay on the device of ``array``."""
    return jnp.array(np.asarray(array))
