"""How near the rover's ceiling an agent comes with twice the steps and updates.

Usage: python experiments/rover_longer.py [--quick] [--run DIR] [--out DIR] [--algorithms A ...]
                                          [--report]

The settings are those of experiments/rover.py, with 160,000 steps instead of 80,000. The script
trains five seeds on AR(1) slip, and tests them in the same 1,000 episodes as experiments/rover.py.
The returns after 80,000 steps are read from rover.parquet, in --out or else in the results. It
writes rover_longer.md and .parquet (a row per policy). If you repeat the command, it only trains
what is missing; `--report` does not train.
"""

import argparse
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study.cells import Grid, make_cells
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH, ROVER_SETTINGS, ROVER_STEPS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from continuing import joined, kept, not_in, train_missing  # noqa: E402
from effects import ROVER_MARGIN, Effect  # noqa: E402
from rover import EPISODES, SEEDS, TINY, ceiling_returns, levels  # noqa: E402
from rover_lengths import COLUMNS, KEY, TESTED_ON, has, of_the_rover, tested  # noqa: E402
from writing import (  # noqa: E402
    RESULTS,
    markdown_table,
    mean_text,
    parse,
    provenance,
    say,
    seeds_text,
    write_results,
)

STEPS = 2 * ROVER_STEPS


def table(rows: pd.DataFrame, before: pd.DataFrame, ceiling: float) -> str:
    """A line per agent: the mean ± standard deviation over seeds, and the distance to the ceiling.

    ``before`` are the rows after 80,000 steps.
    """
    body = []
    for algorithm in dict.fromkeys(rows["algorithm"]):
        short, long = (
            part[part["algorithm"] == algorithm]["mean"].to_numpy(np.float64)
            for part in (before, rows)
        )
        line = [algorithm]
        for returns in (short, long):
            if len(returns):
                few = seeds_text(len(returns), SEEDS)
                line += [f"{mean_text(returns, 3)}{few}", f"{returns.mean() / ceiling - 1:.1%}"]
            else:
                line += ["not run", ""]
        body.append([*line, Effect("", long, short, ROVER_MARGIN).text().removeprefix(": ")])
    header = ["agent"]
    for steps in (ROVER_STEPS, rows["steps"].iloc[0]):
        header += [f"{steps:,} steps", "below the ceiling"]
    return markdown_table([*header, "difference [95% interval]"], body)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover_longer"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument(
        "--algorithms", nargs="+", choices=rtd.ALGORITHMS, default=["lstm-td3-1ha1hc"]
    )
    parser.add_argument("--report", action="store_true", help="test without training")
    options = parse(parser, arguments)
    began, episodes, seeds = time.time(), EPISODES, range(SEEDS)
    settings: dict[str, object] = {**ROVER_SETTINGS, "total_steps": STEPS}
    if options.quick:
        episodes, seeds, settings = 20, range(1), {**settings, **TINY, "total_steps": 60}
    grid = Grid("rover", (TESTED_ON,), tuple(options.algorithms), (ROVER_HISTORY_LENGTH,), settings)
    cells = make_cells((grid,), {})
    rows = kept(options.out / "rover_longer.parquet", COLUMNS)
    if not options.report:
        todo = not_in(rows, cells, seeds, has)
        for line in train_missing("the table", cells, todo, seeds, options.run, options.quick):
            print(line, file=sys.stderr)
    found, missing = tested(options.run, cells, rows, seeds, episodes)
    rows = joined(rows, found, [*KEY, "steps"])
    now = rows[rows["steps"] == settings["total_steps"]]
    if now.empty:
        print(f"nothing is trained in {options.run} yet")
        return 1
    has_table = (options.out / "rover.parquet").exists()
    before = of_the_rover(options.out if has_table else RESULTS)
    before = before[before["trained_on"] == TESTED_ON]
    best = ceiling_returns(TESTED_ON, episodes).mean()
    text = f"{table(now, before, best)}\n\n{levels(episodes, TESTED_ON)}"
    facts = provenance(
        **settings,
        trained_and_tested_on=TESTED_ON,
        history_length=ROVER_HISTORY_LENGTH,
        seeds=SEEDS,
        episodes_per_seed=episodes,
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )
    write_results(options.out, "rover_longer", rows, text, facts)
    say(text, missing)
    return 0


if __name__ == "__main__":
    sys.exit(main())
