"""Compares the results of two checkouts bit by bit.

Usage: python experiments/reliability/same_numbers.py OTHER [--quick] [--env rover] [--agents A ...]

OTHER is the directory of another checkout, for example of `git worktree add /tmp/other COMMIT`.
Each checkout trains the agents in its own process, with the default settings, small networks and
few steps. Then the learning curves and all parameters of the actors are compared. Agents act in
half ranges since version 0.2, so only environments whose actions are within 1, such as the rover,
give the same results before and after this version.
"""

import argparse
import os
import pathlib
import subprocess
import sys
import tempfile

import numpy as np

AGENTS = ("td3", "lstm-td3", "lstm-td3-no-action", "lstm-td3-1ha1hc", "lstm-td3-1ha2hc", "h-td3")
HERE = pathlib.Path(__file__).parents[2]

TRAIN = """
import sys
import jax, numpy as np
import rtd3jax as rtd
out, env, steps, *agents = sys.argv[1:]
arrays = {}
for agent in agents:
    config = rtd.Config(
        algorithm=agent, history_length=None if agent == "td3" else 2, total_steps=int(steps),
        hidden_size=64, eval_every=500, replay_capacity=1_200,
    )
    environment = rtd.make(env, "ar1-slip" if env == "rover" else "random-sine")
    run = rtd.train(environment, config, seeds=[0], progress=False)
    arrays[f"{agent}.returns"], arrays[f"{agent}.true_returns"] = run.returns, run.true_returns
    for path, leaf in jax.tree_util.tree_leaves_with_path(run.policy(0).actor):
        name = ".".join(str(part.key) for part in path).replace("lstm.", "memory.")
        arrays[f"{agent}.{name}"] = np.asarray(leaf)
np.savez(out, **arrays)
"""


def trained(checkout: pathlib.Path, out: pathlib.Path, arguments: list[str]) -> dict:
    """Train with ``checkout``; return its arrays."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    command = [sys.executable, "-c", TRAIN, str(out), *arguments]
    subprocess.run(command, cwd=out.parent, env=environment, check=True)
    return dict(np.load(out))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=pathlib.Path)
    parser.add_argument("--env", default="rover")
    parser.add_argument("--agents", nargs="+", default=list(AGENTS))
    parser.add_argument("--quick", action="store_true", help="one agent, few steps")
    options = parser.parse_args(arguments)
    agents, steps = (options.agents[:1], 1_100) if options.quick else (options.agents, 3_000)
    with tempfile.TemporaryDirectory() as folder:
        names = {"here": HERE, "there": options.other.resolve()}
        here, there = (
            trained(path, pathlib.Path(folder) / f"{name}.npz", [options.env, str(steps), *agents])
            for name, path in names.items()
        )
    if here.keys() != there.keys():
        print(f"other arrays: {sorted(here.keys() ^ there.keys())}")
        return 1
    different = 0
    for agent in agents:
        own = [name for name in here if name.startswith(f"{agent}.")]
        unlike = [n for n in own if not np.array_equal(here[n], there[n], equal_nan=True)]
        different += bool(unlike)
        farthest = max((float(np.nanmax(np.abs(here[n] - there[n]))) for n in unlike), default=0.0)
        verdict = f"differ by up to {farthest:.3g} in {unlike}" if unlike else "bit-identical"
        print(f"{agent:20} {len(own)} arrays: {verdict}")
    return int(different > 0)


if __name__ == "__main__":
    sys.exit(main())
