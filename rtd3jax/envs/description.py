"""Baselines, ceiling, drawing and stresses of an environment, which `rtd3jax.register` takes.

All of these are optional. A study compares trained agents with the baselines and the ceiling, and
the drawing defines how its page shows episodes. The stresses are for a test of robustness.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax

from rtd3jax.envs.stress import Stress


class Ceiling(NamedTuple):
    """The best possible mean return of an environment, or an upper bound of it.

    Attributes:
        mean: the best possible mean return, or an upper bound.
        standard_error: the standard error of ``mean``; for an integral over all starts, which has
            no sampling error, the error of the grid.
        kind: ``exact`` (the best policy's return) or ``upper bound``.
    """

    mean: float
    standard_error: float
    kind: str


@dataclasses.dataclass(frozen=True)
class Drawing:
    """How the page of a study shows an episode.

    Attributes:
        observation: a name for each element of the undisturbed observation.
        action: a name for each element of the flat action.
        kind: the page's scene, ``pendulum`` or ``rover``; without a scene, the page shows only
            curves.
        constants: names of the environment's parameters that the scene needs.
        step_seconds: name of the parameter that holds the length of a step in seconds, if there is
            one.
        hidden: a function of the environment's state before a step. It returns the hidden variable
            that acts in this step, float32 [K], or None if there is no hidden variable.
        hidden_name: name of the hidden variable.
        hidden_elements: a name for each of its K elements.
    """

    observation: tuple[str, ...] = ()
    action: tuple[str, ...] = ()
    kind: str | None = None
    constants: tuple[str, ...] = ()
    step_seconds: str | None = None
    hidden: Callable[[Any], jax.Array | None] | None = None
    hidden_name: str = "hidden"
    hidden_elements: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class Description:
    """Baselines, ceiling, drawing and stresses of one environment.

    Attributes:
        baselines: functions by name. Each takes the environment with its disturbances and returns
            a policy, or the action of a constant policy. It returns None if the baseline cannot be
            used, for example for a controller that does not observe what it controls.
        ceiling: a function of the environment with its disturbances, the number of episodes for a
            mean that is sampled, and a seed. It returns a `Ceiling`, or the best policy, whose
            return is then measured. It raises UserError if neither is known.
        drawing: how to show an episode.
        stresses: stresses of this environment, besides those that fit any environment.
    """

    baselines: Mapping[str, Callable[[Any], Any]] = dataclasses.field(default_factory=dict)
    ceiling: Callable[[Any, int, int], Any] | None = None
    drawing: Drawing | None = None
    stresses: tuple[Stress, ...] = ()

    def or_else(self, other: "Description") -> "Description":
        """This description, in which parts of ``other`` fill the empty parts."""
        return Description(
            self.baselines or other.baselines,
            self.ceiling or other.ceiling,
            self.drawing or other.drawing,
            self.stresses or other.stresses,
        )
