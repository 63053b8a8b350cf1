"""Code that the animations share: loads the policies of a run, and writes a GIF."""

import pathlib
from collections.abc import Callable, Sequence

from matplotlib.animation import FuncAnimation, PillowWriter
from matplotlib.figure import Figure

import rtd3jax as rtd


def load_policies(
    run: pathlib.Path, agents: Sequence[str], history_length: int | None = None, **which: object
) -> dict[str, rtd.Policy]:
    """The trained policies by agent; prints the missing ones. td3 has no ``history_length``."""
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
    """Save every ``every``-th frame of ``steps``; ``frame`` draws the state after a step."""
    FuncAnimation(figure, frame, frames=range(1, steps + 1, every)).save(
        path, writer=PillowWriter(fps=20), dpi=80
    )
