"""From invented slip to soil: the rover's agents on the rover on soil, without further training.

Usage: python experiments/rover_soil.py [--quick] [--run DIR] [--out DIR] [--steps N]
                                        [--sources S ...] [--report]

Six agents with five seeds each are trained under the rover's sine and AR(1) slip, and with the same
settings on soil (`mixed`). For comparison, there are controllers that need no training. Every
policy is tested in 1,000 episodes of each ground; policies trained on soil are also tested under
both slips. The script writes rover_soil.md, rover_soil.parquet (a row per policy and world),
rover_soil.json, and a picture
(experiments/rover_soil_report.py). It trains the cells that the table does not have yet, as a study
in DIR, in the order of `SOURCES`; if you repeat the command, also on another machine, it only
trains what is missing. `--report` does not train: it tests what DIR has so far, also of a study
that has not ended.
"""

import argparse
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.envs.rover_soil.controllers import adaptive_slip, feedforward_pi
from rtd3jax.study.cells import Grid, make_cells
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH as HISTORY_LENGTH
from rtd3jax.study.presets import ROVER_SETTINGS as SETTINGS
from rtd3jax.study.presets import ROVER_STEPS as STEPS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from continuing import (  # noqa: E402
    joined,
    kept,
    mean_and_error,
    not_in,
    train_missing,
    untested_policies,
)
from rover import EPISODES, SEEDS, TINY  # noqa: E402
from rover_soil_report import GROUNDS, SLIPS, SOIL, UNTRAINED, draw, tables  # noqa: E402
from writing import RESULTS, check_steps, parse, provenance, say, write_results  # noqa: E402

SOURCES = ("sine-slip", SOIL, "ar1-slip")
"""The slips and grounds of the trainings, in an order that soon gives a useful table."""
QUICK_STEPS, QUICK_EPISODES = 60, 20
KEY = ["algorithm", "trained_on", "tested_on", "seed"]
COLUMNS = [*KEY, "steps", "episodes", "mean", "standard_error"]


def world(name: str) -> tuple[str, str]:
    """The environment and the disturbance of a slip or a ground."""
    return ("rover-soil" if name in GROUNDS else "rover", name)


def tests_of(source: str) -> tuple[str, ...]:
    """The slips and grounds on which policies trained on ``source`` are tested."""
    return (*GROUNDS, *SLIPS) if source in GROUNDS else GROUNDS


def wanted(sources: list[str], steps: int, tiny: dict[str, object]) -> list[rtd.Cell]:
    """A cell for each source and agent; with ``tiny``, only for two agents."""
    agents = rtd.ALGORITHMS[:2] if tiny else rtd.ALGORITHMS
    settings = {**SETTINGS, "total_steps": steps, **tiny}
    grids = [
        Grid(world(source)[0], (source,), agents, (HISTORY_LENGTH,), settings) for source in sources
    ]
    return make_cells(tuple(grids), {})


def has(rows: pd.DataFrame, cell: rtd.Cell, seed: int) -> bool:
    """Whether ``rows`` has all tests of a lane."""
    own = rows[
        (rows["algorithm"] == cell.config.algorithm)
        & (rows["trained_on"] == cell.disturbance)
        & (rows["seed"] == seed)
        & (rows["steps"] == cell.config.total_steps)
    ]
    return set(tests_of(cell.disturbance)) <= set(own["tested_on"])


def row_of(policy: object, tested_on: str, who: tuple, episodes: int) -> dict[str, object]:
    """Test ``policy``, and return its row; ``who`` is (algorithm, trained on, seed, steps)."""
    algorithm, trained_on, seed, steps = who
    env = rtd.make(*world(tested_on))
    returns = np.asarray(rtd.evaluate(policy, env, episodes, seed=seed), np.float64)
    values = (algorithm, trained_on, tested_on, seed, steps, episodes)
    return {**dict(zip(COLUMNS, values, strict=False)), **mean_and_error(returns)}


def agents(
    run: pathlib.Path, cells: list[rtd.Cell], rows: pd.DataFrame, seeds: int, episodes: int
) -> tuple[list[dict], list[str]]:
    """A row for each test of a trained policy that ``rows`` does not have, and what is missing."""
    policies, missing = untested_policies(run, cells, rows, range(seeds), has)
    found = []
    for cell, seed, policy in policies:
        who = (cell.config.algorithm, cell.disturbance, seed, cell.config.total_steps)
        found += [row_of(policy, name, who, episodes) for name in tests_of(cell.disturbance)]
    return found, missing


def controllers(
    grounds: tuple[str, ...], rows: pd.DataFrame, seeds: int, episodes: int
) -> list[dict]:
    """A row for each controller, ground and seed that ``rows`` does not have."""
    there = set(rows[rows["trained_on"] == UNTRAINED][KEY].itertuples(index=False, name=None))
    found = []
    for ground in grounds:
        env = rtd.make("rover-soil", ground)
        policies = {
            "adaptive slip estimate": adaptive_slip(env),
            "feed-forward and PI": feedforward_pi(env),
            "constant command": rtd.constant_policy([0.5, 0.0]),
            "Bayes policy told AR(1) slip": rtd.bayes_policy(rtd.make("rover", "ar1-slip")),
        }
        for name, policy in policies.items():
            for seed in range(seeds):
                if (name, UNTRAINED, ground, seed) not in there:
                    found.append(row_of(policy, ground, (name, UNTRAINED, seed, 0), episodes))
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover_soil"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--sources", nargs="+", choices=SOURCES, default=list(SOURCES), metavar="S")
    parser.add_argument("--report", action="store_true", help=UNTRAINED)
    options = parse(parser, arguments)
    check_steps(parser, options, STEPS)
    began, steps, episodes, seeds = time.time(), options.steps, EPISODES, SEEDS
    tiny: dict[str, object] = {}
    grounds = GROUNDS
    if options.quick:
        steps, episodes, seeds, tiny = QUICK_STEPS, QUICK_EPISODES, 1, TINY
        grounds, options.sources = (SOIL,), ["sine-slip", SOIL]
    rows = kept(options.out / "rover_soil.parquet", COLUMNS)
    cells = wanted(options.sources, steps, tiny)
    if not options.report:
        todo = not_in(rows, cells, range(seeds), has)
        where = options.run, options.quick
        for line in train_missing("the table", cells, todo, range(seeds), *where):
            print(line, file=sys.stderr)
    found, missing = agents(options.run, cells, rows, seeds, episodes)
    rows = joined(rows, [*found, *controllers(grounds, rows, seeds, episodes)], KEY)
    facts = provenance(
        history_length=HISTORY_LENGTH,
        **{**SETTINGS, "total_steps": steps},
        seeds=seeds,
        episodes_per_seed=episodes,
        missing=len(missing),
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )
    text = tables(rows, grounds, seeds)
    write_results(options.out, "rover_soil", rows, text, facts)
    draw(rows, grounds, options.out)
    say(text, missing)
    return 0


if __name__ == "__main__":
    sys.exit(main())
