"""From invented slip to soil: the rover's agents on the rover on soil, without further training.

Usage: python experiments/rover_soil.py [--quick] [--slip-run DIR] [--run DIR] [--out DIR]
                                        [--steps N] [--report]

Six agents, five seeds, trained on the rover's AR(1) and sine slip: those of experiments/rover.py,
in its run directory, where what is missing is trained. Beside them the same six, trained with the
same setting on each ground, in a run directory of their own; and controllers that need no training.
All are tested on every ground in 1,000 episodes, and the agents of the grounds on the two slips.
Writes rover_soil.md, rover_soil.parquet (a row per policy and world) and rover_soil.json.
`--report` only evaluates what there is.

Intervals are 95% bootstrap intervals over seeds (10,000 resamples, fixed random numbers).
"""

import argparse
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.envs.rover_soil.controllers import adaptive_slip, feedforward_pi
from rtd3jax.study.plan import Cell, Grid, make_cells
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH as HISTORY_LENGTH
from rtd3jax.study.presets import ROVER_SETTINGS as SETTINGS
from rtd3jax.study.presets import ROVER_STEPS as STEPS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from claims import RESAMPLES, ROVER_MARGIN, Effect  # noqa: E402
from rover import EPISODES, PAPER_EPISODES, SEEDS  # noqa: E402
from rover import train as train_on_slip  # noqa: E402
from writing import RESULTS, markdown_table, provenance, write_results  # noqa: E402

SLIPS = ("ar1-slip", "sine-slip")
GROUNDS = ("dry-sand", "mixed", "mixed-slope")
TINY = {"hidden_size": 4, "batch_size": 4, "learning_starts": 10}
TINY |= {"eval_every": 60, "eval_episodes": 1}
QUICK_STEPS, QUICK_EPISODES = 60, 20
COLUMNS = ["algorithm", "trained_on", "tested_on", "seed", "episodes", "mean", "standard_error"]


def cells_on_soil(steps: int, tiny: dict[str, object]) -> list[Cell]:
    """Every agent on every ground; one of them where it is ``tiny``."""
    settings = {**SETTINGS, "total_steps": steps, **tiny}
    grid = Grid("rover-soil", GROUNDS, rtd.ALGORITHMS, (HISTORY_LENGTH,), settings)
    cells = make_cells((grid,), {})
    return cells[:1] if tiny else cells


def train_on_soil(run: pathlib.Path, steps: int, tiny: dict[str, object]) -> list[str]:
    """Train what is missing; a line for each lane that was lost."""
    seeds, episodes = range(1 if tiny else SEEDS), 1 if tiny else PAPER_EPISODES
    study = rtd.Study(cells_on_soil(steps, tiny), seeds=seeds, out=run, final_episodes=episodes)
    return study.run(quiet=bool(tiny), page=not tiny)


def row_of(policy: object, world: tuple[str, str], who: tuple, episodes: int) -> dict[str, object]:
    """Evaluate ``policy``, which is (algorithm, trained on, seed), in ``world``."""
    returns = np.asarray(rtd.evaluate(policy, rtd.make(*world), episodes, seed=who[2]), np.float64)
    error = float(returns.std(ddof=1) / np.sqrt(episodes))
    values = (who[0], who[1], world[1], who[2], episodes, float(returns.mean()), error)
    return dict(zip(COLUMNS, values, strict=True))


def agents(
    runs: dict[str, pathlib.Path], grounds: tuple[str, ...], seeds: int, episodes: int
) -> tuple[list[dict], list[str]]:
    """A row per trained policy and world, and what is missing."""
    plan = [("rover", slip, ground) for ground in grounds for slip in SLIPS]
    plan += [("rover-soil", ground, world) for ground in grounds for world in (ground, *SLIPS)]
    rows, missing = [], []
    for trained_in, trained_on, tested_on in plan:
        world = ("rover-soil" if tested_on in GROUNDS else "rover", tested_on)
        for algorithm in rtd.ALGORITHMS:
            for seed in range(seeds):
                try:
                    policy = rtd.load_policy(
                        runs[trained_in], algorithm=algorithm, disturbance=trained_on, seed=seed
                    )
                except rtd.UserError as error:
                    missing.append(str(error))
                    continue
                rows.append(row_of(policy, world, (algorithm, trained_on, seed), episodes))
    return rows, sorted(set(missing))


def controllers(grounds: tuple[str, ...], seeds: int, episodes: int) -> list[dict]:
    """A row per controller, ground and seed."""
    rows = []
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
                world = ("rover-soil", ground)
                rows.append(row_of(policy, world, (name, "no training", seed), episodes))
    return rows


def pick(rows: pd.DataFrame, algorithm: str, trained_on: str, tested_on: str) -> np.ndarray:
    """Mean return of each seed."""
    here = rows[
        (rows["algorithm"] == algorithm)
        & (rows["trained_on"] == trained_on)
        & (rows["tested_on"] == tested_on)
    ]
    return here["mean"].to_numpy()


def text_of(values: np.ndarray) -> str:
    """Mean over seeds with its interval."""
    if not len(values):
        return "not trained yet"
    if len(values) == 1:
        return f"{values[0]:.2f} (1 of {SEEDS} seeds)"
    random = np.random.default_rng(0)
    means = values[random.integers(0, len(values), (RESAMPLES, len(values)))].mean(axis=1)
    low, high = np.quantile(means, (0.025, 0.975))
    count = "" if len(values) == SEEDS else f" ({len(values)} of {SEEDS} seeds)"
    return f"{values.mean():.2f} [{low:.2f}, {high:.2f}]{count}"


def table(rows: pd.DataFrame, grounds: tuple[str, ...]) -> str:
    """A table for each ground, one of the way back, and the differences that the study is about."""
    parts = []
    untrained = list(dict.fromkeys(rows[rows["trained_on"] == "no training"]["algorithm"]))
    for ground in grounds:
        body = [
            [name, *(text_of(pick(rows, name, source, ground)) for source in (*SLIPS, ground))]
            for name in rtd.ALGORITHMS
        ]
        body += [
            [f"*{name}*", "", "", text_of(pick(rows, name, "no training", ground))]
            for name in untrained
        ]
        header = ["agent", *(f"trained on {slip}" for slip in SLIPS), "trained here, or not at all"]
        parts.append(f"Tested on `{ground}`:\n\n{markdown_table(header, body)}")
    header = ["agent", *(f"{ground} → {slip}" for ground in grounds for slip in SLIPS)]
    body = [
        [name, *(text_of(pick(rows, name, g, slip)) for g in grounds for slip in SLIPS)]
        for name in rtd.ALGORITHMS
    ]
    parts.append(f"The way back, to the rover's slips:\n\n{markdown_table(header, body)}")
    return "\n\n".join([*parts, differences(rows, grounds, untrained)])


def differences(rows: pd.DataFrame, grounds: tuple[str, ...], untrained: list[str]) -> str:
    """What training on the ground gains over each slip, and over the best controller there."""
    body = []
    for ground in grounds:
        controllers_here = {name: pick(rows, name, "no training", ground) for name in untrained}
        best = max(controllers_here, key=lambda name: controllers_here[name].mean())
        for name in rtd.ALGORITHMS:
            there = pick(rows, name, ground, ground)
            effects = [
                Effect(
                    f"{name}: trained here over {slip}",
                    there,
                    pick(rows, name, slip, ground),
                    ROVER_MARGIN,
                )
                for slip in SLIPS
            ]
            effects += [
                Effect(
                    f"{name}, {slip} over {best}", transferred, controllers_here[best], ROVER_MARGIN
                )
                for slip in SLIPS
                if len(transferred := pick(rows, name, slip, ground))
            ]
            body += [[ground, effect.text(), effect.verdict()] for effect in effects]
    header = ["ground", "difference of means [95% interval]", "that it is positive"]
    return markdown_table(header, body)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    parser.add_argument("--slip-run", type=pathlib.Path, default=pathlib.Path("runs/rover"))
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover_soil"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--report", action="store_true", help="evaluate what there is; no training")
    options = parser.parse_args(arguments)
    began, steps, episodes = time.time(), options.steps, EPISODES
    tiny: dict[str, object] = {}
    grounds, seeds = GROUNDS, SEEDS
    if options.quick:
        steps, episodes, tiny = QUICK_STEPS, QUICK_EPISODES, TINY
        grounds, seeds = GROUNDS[:1], 1
    if not options.report:
        lost = train_on_slip(options.slip_run, steps, tiny)
        for line in [*lost, *train_on_soil(options.run, steps, tiny)]:
            print(line, file=sys.stderr)
    runs = {"rover": options.slip_run, "rover-soil": options.run}
    found, missing = agents(runs, grounds, seeds, episodes)
    rows = pd.DataFrame([*found, *controllers(grounds, seeds, episodes)], columns=COLUMNS)
    facts = provenance(
        steps=steps,
        history_length=HISTORY_LENGTH,
        **SETTINGS,
        seeds=seeds,
        episodes_per_seed=episodes,
        missing=len(missing),
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )
    text = table(rows, grounds)
    write_results(options.out, "rover_soil", rows, text, facts)
    print(text)
    for line in missing:
        print(f"missing: {line}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
