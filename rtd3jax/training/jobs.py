"""Jobs: the lanes of a training, each with the program that trains it."""

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

from rtd3jax.config import Config
from rtd3jax.envs.entry import parameters_of
from rtd3jax.envs.interface import describe
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.switches import check_compiling
from rtd3jax.training.executables import structure_of
from rtd3jax.training.feasibility import check_segments, warn_if_untrained
from rtd3jax.training.lane import Lane, as_arrays, make_lane
from rtd3jax.training.loop import Program, make_program
from rtd3jax.training.start import Start

Executable = tuple[Program, Any]
"""A program, and the structure of its lanes; see `Job.executable`."""


@dataclasses.dataclass(eq=False)
class Job:
    """One lane to be trained.

    Attributes:
        program: the program to compile.
        lane: the seed, the hyperparameters and the environment parameters of the lane.
        cell: key of the cell of the lane; jobs of one cell are adjacent in a list of jobs.
        seed: the seed of the lane within its cell.
        start: trained networks from which training starts; None for new weights.
    """

    program: Program
    lane: Lane
    cell: Any
    seed: int
    start: Start | None = None

    @property
    def key(self) -> tuple[Any, int]:
        """The unique key of the job."""
        return self.cell, self.seed

    @functools.cached_property
    def executable(self) -> Executable:
        """Equal for jobs that share executables, and so can advance together.

        Equal environments can have parameters of different structure, such as other disturbances.
        """
        return self.program, structure_of(self.lane)


def make_jobs(
    env: EnvironmentLike,
    config: Config,
    seeds: Sequence[int],
    *,
    params: object = None,
    cell: object = None,
    window: int | None = None,
    starts: Mapping[int, Start] | None = None,
) -> list[Job]:
    """Check the environment, and make a job per seed with key ``(cell, seed)``.

    With ``window``, jobs of shorter history lengths share the program of length ``window``.

    Raises:
        UserError: for an unsuitable environment or configuration.
    """
    check_compiling()
    params = parameters_of(env, params)
    warn_if_untrained(config)
    check_segments(config, _horizon(params))
    interface = describe(env, params)
    program = make_program(
        env,
        config,
        interface.observation_size,
        interface.action_shape,
        window,
        interface.true_observation_size,
    )
    _ = program.agent  # raises UserError, before anything is compiled or written
    starts = starts or {}
    params = as_arrays(params)  # once, so that the lanes share a recording
    return [
        Job(program, make_lane(config, seed, params), cell, seed, starts.get(seed))
        for seed in seeds
    ]


def _horizon(params: Any) -> int | None:
    """The time limit in the environment's parameters, as in gymnax's; None without it."""
    own = getattr(params, "env", params)
    steps = getattr(own, "max_steps_in_episode", None)
    return int(steps) if isinstance(steps, int) else None
