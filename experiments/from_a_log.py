"""Trains, tests and exports a policy from wheel speeds in a CSV file.

Usage: python experiments/from_a_log.py [LOG.csv] [--quick] [--out DIR]; see docs/from_a_log.md.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.envs.log import read_episodes
from rtd3jax.envs.rover import Rover, RoverParams
from rtd3jax.envs.rover.registration import feedforward_pi
from rtd3jax.envs.rover.slip import Ar1Slip
from rtd3jax.study.presets import PRESETS

SLOWEST = 0.05
"""m/s: at a lower commanded speed, a wheel's slip is not known; such rows are gaps."""


def drive(out: Path, episodes: int) -> Path:
    """Write a log of the wheel speeds, in m/s, of a rover that should drive straight ahead."""
    rover = Rover(RoverParams(slip=Ar1Slip(rho=0.97, sigma=0.06)))
    log = rtd.rollout(rtd.constant_policy([0.5, 0.0]), rover, episodes=episodes, seed=7)
    speed, turn = log.true[:, 1:].reshape(-1, 2).T * [[1.0], [0.25]] + [[0.5], [0.0]]
    frame = pd.DataFrame({"episode": np.repeat(np.arange(episodes), 200)})
    for side, realised in (("left", speed - turn), ("right", speed + turn)):
        frame[f"commanded_{side}"], frame[f"realised_{side}"] = 0.5, realised
    frame.loc[300:309, "realised_left"] = np.nan  # an encoder loses its signal for 10 steps
    frame.to_csv(out / "log.csv", index=False, float_format="%.7f")
    return out / "log.csv"


def slip_of(path: Path) -> rtd.Recorded:
    """The slip of both wheels in a log of their speeds, an array with gaps for each episode."""
    names = [f"{speed}_{side}" for speed in ("commanded", "realised") for side in ("left", "right")]
    episodes = []
    for stretches in read_episodes(path, columns=names):
        rows = []
        for commanded, realised in (np.split(part, 2, axis=1) for part in stretches):
            moving = np.where(np.abs(commanded) < SLOWEST, np.nan, commanded)
            rows += [1.0 - realised / moving, np.full((1, 2), np.nan)]
        episodes.append(np.concatenate(rows))
    # Noise of the encoders makes some slip negative.
    return rtd.Recorded(episodes, channel="slip", bounds=(0.0, 1.0))


def main(arguments: list[str] | None = None) -> None:
    try:
        from_a_log(arguments)
    except rtd.UserError as error:
        sys.exit(f"error: {error}")


def from_a_log(arguments: list[str] | None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "log", nargs="?", type=Path, help="wheel speeds; by default a rover is simulated"
    )
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--out", type=Path, default=Path("runs/from_a_log"))
    (options := parser.parse_args(arguments)).out.mkdir(parents=True, exist_ok=True)
    log = options.log or drive(options.out, 10 if options.quick else 50)
    train, test = slip_of(log).split(0.8)
    fit = rtd.fit_process(train, "ar1")
    print(fit.summary(), rtd.fit_process(train, "sine").summary(), sep="\n")
    fit.plot(options.out / "fit.png", overwrite=True)
    settings = PRESETS["quick"][0].settings | {"algorithm": "lstm-td3-1ha1hc", "history_length": 1}
    short = {"algorithm": "td3", "history_length": 0, "total_steps": 110, "learning_starts": 100}
    config = rtd.Config(**(settings | (short if options.quick else {})))
    plant = Rover(RoverParams(slip=test))
    policies = {"constant": rtd.constant_policy([0.5, 0.0]), "PI": feedforward_pi(plant)}
    policies["Bayes of the fit"] = rtd.bayes_policy(plant, fit.process)
    for name, slips in {"fit": fit.process, "recording": train}.items():
        run = rtd.train(Rover(RoverParams(slip=slips)), config, seeds=[0], progress=False)
        policies[f"trained on the {name}"] = run.policy(seed=0)
    for name, policy in policies.items():
        print(f"{name}: {float(rtd.evaluate(policy, plant, episodes=200).mean()):.2f}")
    policies["trained on the fit"].export(options.out / "policy.py", "numpy", overwrite=True)


if __name__ == "__main__":
    main()
