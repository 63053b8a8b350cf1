"""The gains of the classical controllers of the rover on soil.

Usage: python experiments/rover_soil_gains.py [--quick] [--out DIR]

The script tests a grid of gains of the PI controller, and of the controller that estimates the
slip, on `mixed-slope`: 1,000 episodes of seed 1000, which no table reports. It writes
rover_soil_gains.md, .parquet and .json. rtd3jax/envs/rover_soil/controllers.py has the best gains.
"""

import argparse
import pathlib
import sys

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.envs.rover.controllers import target_pi
from rtd3jax.envs.rover_soil.controllers import adaptive_slip

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from continuing import mean_and_error  # noqa: E402
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

GROUND, SEED, EPISODES = "mixed-slope", 1000, 1_000
PROPORTIONAL = (0.0, 0.1, 0.2, 0.3)
INTEGRAL = (0.6, 0.8, 1.0, 1.2, 1.4, 1.6, 1.8)
SHARES = (0.1, 0.3, 0.5, 0.7, 0.8, 0.9, 1.0)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    env, episodes = rtd.make("rover-soil", GROUND), EPISODES
    pairs, shares = [(p, i) for p in PROPORTIONAL for i in INTEGRAL], SHARES
    if options.quick:
        episodes, pairs, shares = 2, pairs[:1], shares[:1]
    policies = [
        (
            "feedforward-pi",
            f"kp={kp:g} ki={ki:g}",
            target_pi(env, kp, ki),
        )
        for kp, ki in pairs
    ]
    policies += [
        ("adaptive-slip", f"gain={share:g}", adaptive_slip(env, share)) for share in shares
    ]
    rows = []
    for controller, gains, policy in policies:
        returns = np.asarray(rtd.evaluate(policy, env, episodes, SEED), np.float64)
        rows.append({"controller": controller, "gains": gains, **mean_and_error(returns)})
        print(rows[-1], flush=True)
    table = pd.DataFrame(rows).sort_values(["controller", "mean"], ascending=[True, False])
    body = [
        [r.controller, r.gains, f"{r.mean:.4f} ± {r.standard_error:.4f}"]
        for r in table.itertuples()
    ]
    text = markdown_table(["controller", "gains", "return ± standard error"], body)
    facts = provenance(ground=GROUND, seed=SEED, episodes=episodes)
    write_results(options.out, "rover_soil_gains", table, text, facts)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
