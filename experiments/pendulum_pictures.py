"""Animates `td3` and a recurrent agent on the pendulum under the same disturbance.

Usage: python experiments/pendulum_pictures.py [--run DIR] [--disturbance D] [--history-length L]
                                               [--seed N] [--agents A B] [--out DIR] [--quick]

The script loads two policies of a study of experiments/pendulum.py, and plays the same twenty
episodes with both. (That script only trains cells that the table in its --out does not have.) It
shows the episode whose difference of returns is nearest to the mean difference, because in the
median episode, both returns are similar. It writes pendulum_swing.gif: the true pendulum, the
observed pendulum, and below them the true and the observed angular velocity.
"""

import argparse
import pathlib
import sys

import numpy as np
from matplotlib.figure import Figure

import rtd3jax as rtd
from rtd3jax.study.colours import colour_of
from rtd3jax.study.report.playback import record_episodes

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pictures import load_policies, save_gif  # noqa: E402
from writing import RESULTS, parse  # noqa: E402

STEPS, EPISODES = 200, 20
SEEN = "#D55E00"


def tip(observation: np.ndarray) -> np.ndarray:
    """The end of the rod, [2], for (cos, sin, velocity); upright is (0, 1)."""
    return np.array([-observation[1], observation[0]])


def animate(plays: dict[str, dict[str, np.ndarray]], path: pathlib.Path, every: int) -> None:
    figure = Figure(figsize=(7.2, 4.8), layout="constrained")
    panels = figure.subplots(2, len(plays), height_ratios=(2.2, 1), squeeze=False)
    moving = []
    for column, (name, play) in enumerate(plays.items()):
        top, bottom = panels[:, column]
        top.set(xlim=(-1.8, 1.8), ylim=(-1.8, 1.8), aspect="equal", xticks=[], yticks=[])
        bottom.set(xlim=(0, STEPS), xlabel="step")
        values = np.concatenate([play[kind][:, 2] for kind in ("true", "seen")])
        bottom.set_ylim(values.min() - 0.5, values.max() + 0.5)
        (seen_rod,) = top.plot([], [], color=SEEN, lw=2, ls=":", marker="o", label="reported")
        (rod,) = top.plot([], [], color=colour_of(name), lw=5, label="true")
        (seen_line,) = bottom.plot([], [], color=SEEN, lw=1)
        (line,) = bottom.plot([], [], color=colour_of(name), lw=1.5)
        moving.append((top, name, play, rod, seen_rod, line, seen_line))
        if column == 0:
            bottom.set_ylabel("angular velocity\nrad/s")
            top.legend(frameon=False, fontsize=8, loc="lower left")

    def frame(step: int):
        now = np.arange(step)
        for top, name, play, rod, seen_rod, line, seen_line in moving:
            for kind, drawn, below in (("true", rod, line), ("seen", seen_rod, seen_line)):
                x, y = tip(play[kind][step - 1])
                drawn.set_data([0, x], [0, y])
                below.set_data(now, play[kind][:step, 2])
            top.set_title(f"{name}: return {play['reward'][:step].sum():.0f}", fontsize=10)
        return []

    save_gif(figure, frame, path, STEPS, every)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/pendulum"))
    parser.add_argument("--disturbance", default="random-sine")
    parser.add_argument("--history-length", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0, help="seed of the policies")
    parser.add_argument("--agents", nargs=2, default=["td3", "lstm-td3-1ha1hc"])
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--quick", action="store_true", help="few frames")
    options = parse(parser, arguments, written=("out",))
    env = rtd.make("pendulum", options.disturbance)
    which = {"disturbance": options.disturbance, "seed": options.seed}
    policies = load_policies(options.run, options.agents, options.history_length, **which)
    plays = {
        name: record_episodes(policy, env, EPISODES, 0, STEPS) for name, policy in policies.items()
    }
    if not plays:
        return 1
    returns = np.stack([play["reward"].sum(axis=(1, 2)) for play in plays.values()])
    difference = returns[-1] - returns[0]
    typical = np.abs(difference - difference.mean()).argmin()
    plays = {name: {k: v[typical] for k, v in play.items()} for name, play in plays.items()}
    options.out.mkdir(parents=True, exist_ok=True)
    animate(plays, options.out / "pendulum_swing.gif", 50 if options.quick else 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
