"""What the animations share: two policies of a run, and a GIF."""

import pathlib
from collections.abc import Callable, Sequence

from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

import rtd3jax as rtd


def load_policies(
    run: pathlib.Path, agents: Sequence[str], history_length: int | None = None, **which: object
) -> dict[str, rtd.Policy]:
    """The policies there are, by agent; says which are missing. td3 has no ``history_length``."""
    found = {}
    for agent in agents:
        length = None if agent == "td3" else history_length
        try:
            found[agent] = rtd.load_policy(run, algorithm=agent, history_length=length, **which)
        except rtd.UserError as error:
            print(f"missing: {error}")
    return found


def save_gif(
    figure: Figure, frame: Callable[[int], list], path: pathlib.Path, steps: int, every: int
) -> None:
    """Every so-many-th frame of ``steps``; ``frame`` draws what is known after so many steps."""
    FuncAnimation(figure, frame, frames=range(1, steps + 1, every)).save(
        path, writer=PillowWriter(fps=20), dpi=80
    )
