"""What is known of an environment beside its dynamics; `rtd3jax.register` takes it.

All of it is optional. A study shows the baselines and the ceiling beside the trained agents, and
its page plays episodes with the drawing.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax


class Ceiling(NamedTuple):
    """A mean return, its standard error, and what it is.

    Attributes:
        mean: best possible mean return, or a bound from above.
        standard_error: of ``mean``; of an integral, which has no luck in it, the grid's error.
        kind: ``exact`` (the best policy's own return), or ``upper bound``.
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
        kind: the page's scene, ``pendulum`` or ``rover``; without one the page draws curves alone.
        constants: parameters of the environment that the scene needs, by name.
        step_seconds: the parameter that holds the length of a step in seconds, if one does.
        hidden: takes the environment's state before a step, and returns what the step's action
            meets and the agent does not see, float32 [K]; or None where there is no such thing.
        hidden_name: what that is.
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
    """Baselines, ceiling and drawing of one environment.

    Attributes:
        baselines: by name, functions of the environment as it was made, disturbances included. Each
            returns a policy, or the action of a policy that is constant; None where it has nothing
            to say, such as a controller that does not see what it controls.
        ceiling: takes the environment as it was made, how many episodes a random mean takes, and a
            seed. It returns a `Ceiling`, or the best policy, whose return is then measured. It
            raises UserError where neither is known.
        drawing: how to show an episode.
    """

    baselines: Mapping[str, Callable[[Any], Any]] = dataclasses.field(default_factory=dict)
    ceiling: Callable[[Any, int, int], Any] | None = None
    drawing: Drawing | None = None

    def or_else(self, other: "Description") -> "Description":
        """This, with what ``other`` knows where this knows nothing."""
        return Description(
            self.baselines or other.baselines,
            self.ceiling or other.ceiling,
            self.drawing or other.drawing,
        )
