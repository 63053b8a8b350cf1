"""Trains and tests agents for the paper's rover tables.

Usage: python experiments/rover.py [--quick] [--run DIR] [--out DIR] [--steps N] [--report]

The script trains six agents on AR(1) slip, on sine slip and without slip, with five seeds each, in
a run directory of the sweep; if you repeat the command, it only trains what is missing. Then it
evaluates every policy under the four slip processes of the paper's tables, in 1,000 episodes; the
paper has 20, whose means differ more between seeds, so the table shows both. It writes rover.md,
rover.parquet (a row per policy and process), rover.png and the learning curves. `--report` only
evaluates policies that are missing from the table. Rows of earlier settings are kept and marked if
there is no training with the current settings. All agents have the settings of the preset, which
experiments/rover_search.py found with seeds that are not among the five.
"""

import argparse
import functools
import itertools
import pathlib
import sys
import time
from collections.abc import Iterable

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

import rtd3jax as rtd
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.study.cells import make_cells
from rtd3jax.study.presets import PRESETS
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH as HISTORY_LENGTH
from rtd3jax.study.presets import ROVER_SETTINGS as SETTINGS
from rtd3jax.study.presets import ROVER_STEPS as STEPS
from rtd3jax.study.rundir import RunDirectory

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import continuing  # noqa: E402
from effects import ROVER_MARGIN, Effect  # noqa: E402
from settings import mark, notes, setting_text  # noqa: E402
from writing import (  # noqa: E402
    RESULTS,
    keep_curves,
    markdown_table,
    mean_text,
    parse,
    provenance,
    say,
    seeds_text,
    write_results,
)

SEEDS = 5
EPISODES = 1_000
TINY = {"hidden_size": 4, "batch_size": 4, "learning_starts": 10}
TINY |= {"eval_every": 60, "eval_episodes": 1}
"""Fields of a small configuration, to test a script."""
COLUMNS = (
    ("ar1-slip", "ar1-slip"),
    ("sine-slip", "ar1-slip"),
    ("none", "ar1-slip"),
    ("sine-slip", "ar1-slip-high-variance"),
    ("sine-slip", "ar1-slip-fast"),
    ("sine-slip", "ar1-slip-slow"),
)
"""(trained on, tested on), as in the paper's tables."""

_PAPER = """
td3                -2.92 0.07 -2.94 0.09 -5.21 0.19 -7.75 0.17 -1.73 0.17 -5.33 0.14
lstm-td3           -1.38 0.08 -2.40 0.29 -5.26 0.14 -7.38 0.97 -2.17 0.24 -2.78 0.38
lstm-td3-no-action -1.78 0.07 -2.55 0.24 -5.29 0.16 -6.90 0.18 -2.11 0.30 -3.76 0.19
lstm-td3-1ha1hc    -1.36 0.04 -1.70 0.06 -5.20 0.14 -5.95 0.22 -1.48 0.10 -2.05 0.06
lstm-td3-1ha2hc    -1.39 0.05 -2.08 0.16 -5.19 0.04 -6.09 0.24 -1.89 0.12 -2.37 0.10
h-td3              -1.92 0.07 -2.28 0.17 -5.13 0.23 -7.93 1.26 -1.91 0.20 -3.17 0.31
"""
PAPER = {
    name: [f"{mean} ± {deviation}" for mean, deviation in zip(*[iter(numbers)] * 2, strict=True)]
    for name, *numbers in map(str.split, _PAPER.strip().splitlines())
}
"""Mean ± standard deviation over five seeds (Omi et al., the rover's two tables)."""


def train(run: pathlib.Path, steps: int, tiny: dict[str, object]) -> list[str]:
    """Train the missing lanes; return a line for each lane that was lost."""
    cells = make_cells(PRESETS["rover"], {"total_steps": steps, **tiny})
    if tiny:
        cells = cells[:1]
    return continuing.train(cells, range(1 if tiny else SEEDS), run, quick=bool(tiny))


@functools.cache
def own_setting(run: pathlib.Path, algorithm: str, disturbance: str) -> str:
    """The settings with which a run trained the agent, as the text in tables."""
    wanted = {"algorithm": algorithm, "disturbance": disturbance}
    (config,) = [
        cell.config for cell in RunDirectory.open(run).cells if wanted.items() <= cell.key.items()
    ]
    return setting_text({name: getattr(config, name) for name in (*SETTINGS, "total_steps")})


def evaluate_policies(run: pathlib.Path, episodes: int, known: pd.DataFrame | None, setting: str):
    """A row per lane and process: the mean over ``episodes``, and over the paper's twenty.

    Rows of ``known`` with the current settings are not evaluated again. Rows with other settings
    are kept if the run has no policy for them.
    """
    rows, missing = [], []
    names = ["trained_on", "tested_on", "algorithm", "seed"]
    there = (
        {} if known is None else {tuple(r[n] for n in names): r for r in known.to_dict("records")}
    )
    for trained, tested in COLUMNS:
        env = rtd.make("rover", tested)
        for algorithm in rtd.ALGORITHMS:
            for seed in range(SEEDS):
                row = there.get((trained, tested, algorithm, seed))
                if row is not None and row["setting"] == setting:
                    rows.append(row)
                    continue
                try:
                    key = {"algorithm": algorithm, "disturbance": trained}
                    policy = rtd.load_policy(run, **key, seed=seed)
                except rtd.UserError as error:
                    if row is None:
                        missing.append(str(error))
                    else:
                        rows.append(row)
                    continue
                returns = np.asarray(rtd.evaluate(policy, env, episodes, seed=seed))
                rows.append(
                    {
                        "algorithm": algorithm,
                        "trained_on": trained,
                        "tested_on": tested,
                        "seed": seed,
                        "episodes": episodes,
                        **continuing.mean_and_error(returns),
                        "mean_of_20": float(returns[: continuing.FINAL_EPISODES].mean()),
                        "setting": own_setting(run, **key),
                    }
                )
    return pd.DataFrame(rows), sorted(set(missing))


def in_the_agents_episodes(policy: PolicyLike, env: EnvironmentLike, episodes: int) -> np.ndarray:
    """Returns of a policy in the ``episodes`` in which each seed of an agent is tested."""
    found = [rtd.evaluate(policy, env, episodes, seed) for seed in range(SEEDS)]
    return np.concatenate(found).astype(np.float64)


@functools.cache
def ceiling_returns(tested: str, episodes: int) -> np.ndarray:
    """Returns of the best policy under one slip, in the episodes of the agents."""
    env = rtd.make("rover", tested)
    return in_the_agents_episodes(rtd.bayes_policy(env), env, episodes)


def references(
    episodes: int, slips: Iterable[str] = tuple(tested for _, tested in COLUMNS)
) -> dict[str, dict[str, str]]:
    """The ceiling and the policies without training, in the episodes of the agents."""
    rows: dict[str, dict[str, str]] = {}
    nominal = rtd.make("rover", "ar1-slip")
    for tested in dict.fromkeys(slips):
        env = rtd.make("rover", tested)
        best = ceiling_returns(tested, episodes)
        error = best.std(ddof=1) / np.sqrt(best.size)
        rows.setdefault("ceiling", {})[tested] = f"{best.mean():.3f} ± {error:.3f}"
        policies = {
            "Bayes policy told nominal AR(1) slip": rtd.bayes_policy(nominal),
            "constant command": rtd.constant_policy([0.5, 0.0]),
            "uniform random": rtd.random_policy(env),
        }
        for name, policy in policies.items():
            rows.setdefault(name, {})[tested] = (
                f"{in_the_agents_episodes(policy, env, episodes).mean():.2f}"
            )
    return rows


def levels(episodes: int, tested: str) -> str:
    """A sentence about the returns of `references` under one slip."""
    returns = {name: values[tested] for name, values in references(episodes, [tested]).items()}
    return (
        f"In the same episodes, the ceiling is {returns['ceiling']}, the constant command has "
        f"{returns['constant command']}, and uniform random actions have "
        f"{returns['uniform random']}."
    )


def pick(rows: pd.DataFrame, algorithm: str, trained: str, tested: str) -> pd.DataFrame:
    """The rows of one entry of the table."""
    return rows[
        (rows["algorithm"] == algorithm)
        & (rows["trained_on"] == trained)
        & (rows["tested_on"] == tested)
    ]


def spread(here: pd.DataFrame, setting: str, column: str = "mean") -> str:
    """Mean ± standard deviation over seeds, and the number of seeds if some are missing."""
    values = here[column]
    older = int((here["setting"] != setting).sum())
    few = seeds_text(len(values), SEEDS)
    return f"{mean_text(values, 2)}{few}{mark(older, len(here))}"


def table(rows: pd.DataFrame, others: dict[str, dict[str, str]], setting: str) -> str:
    """The paper's two rover tables as one, with our numbers above those of the paper.

    The paper's statistic is a mean of 20 episodes for each seed.
    """
    header = ["agent", *(f"{trained} → {tested}" for trained, tested in COLUMNS)]
    body = []
    for algorithm in rtd.ALGORITHMS:
        for name, column in ((f"**{algorithm}**", "mean"), ("the same, 20 episodes", "mean_of_20")):
            own = [pick(rows, algorithm, trained, tested) for trained, tested in COLUMNS]
            entries = [
                spread(here, setting, column) if len(here) else "not trained yet" for here in own
            ]
            body.append([name, *entries])
        body.append(["paper, 20 episodes", *PAPER[algorithm]])
    body += fine_tuned()
    for name, values in others.items():
        body.append([f"*{name}*", *(values[tested] for _, tested in COLUMNS)])
    return "\n".join([markdown_table(header, body), *notes({*rows["setting"]} - {setting})])


def fine_tuned() -> list[list[str]]:
    """The row of an agent that was trained on sine slip and then briefly on AR(1) slip."""
    path = RESULTS / "fine_tuning.parquet"
    if not path.exists():
        return []
    found = pd.read_parquet(path)
    found = found[found["way"] == "with critics and optimisers"]["mean"]
    name = "**lstm-td3-1ha1hc**, then 5,000 steps on ar1-slip"
    return [
        [name, *(mean_text(found, 2) if c == ("sine-slip", "ar1-slip") else "–" for c in COLUMNS)]
    ]


def order(rows: pd.DataFrame) -> str:
    """The paper's order of the agents on AR(1) slip, with a verdict for each pair of neighbours."""
    header = ["trained on", "the paper's order: difference of means [95% interval]", "verdict"]
    body = []
    for column, (trained, tested) in list(enumerate(COLUMNS))[:2]:
        ranked = sorted(PAPER, key=lambda name, k=column: -float(PAPER[name][k].split()[0]))
        for better, worse in itertools.pairwise(ranked):
            sides = [
                pick(rows, name, trained, tested)["mean"].to_numpy() for name in (better, worse)
            ]
            effect = Effect(f"{better} over {worse}", *sides, margin=ROVER_MARGIN)
            body.append([trained, effect.text(), effect.verdict()])
    return markdown_table(header, body)


def draw(rows: pd.DataFrame, path: pathlib.Path) -> None:
    """Draw the transfer matrix: the mean return of each agent (rows) in each column."""
    grid = np.full((len(rtd.ALGORITHMS), len(COLUMNS)), np.nan)
    for i, algorithm in enumerate(rtd.ALGORITHMS):
        for j, (trained, tested) in enumerate(COLUMNS):
            here = pick(rows, algorithm, trained, tested)
            grid[i, j] = here["mean"].mean() if len(here) else np.nan
    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(grid, cmap="cividis", norm=Normalize(-6.0, -1.0), aspect="auto")
    for (i, j), value in np.ndenumerate(grid):
        text = "–" if np.isnan(value) else f"{value:.2f}"
        dark = np.isnan(value) or value > -3.0
        axes.text(j, i, text, ha="center", va="center", color="black" if dark else "white")
    labels = [f"{a.removesuffix('-slip')} →\n{b.replace('ar1-slip-', '')}" for a, b in COLUMNS]
    axes.set_xticks(range(len(COLUMNS)), [text.replace("ar1-slip", "ar1") for text in labels])
    axes.set_yticks(range(len(rtd.ALGORITHMS)), rtd.ALGORITHMS)
    axes.set_title("Rover: mean return over seeds, trained on → tested on")
    figure.colorbar(image, label="return", extend="min")
    with mpl.rc_context({"svg.hashsalt": "rtd3jax"}):
        figure.savefig(path, dpi=150)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--steps", type=int, default=STEPS)
    parser.add_argument("--report", action="store_true", help="evaluate without training")
    options = parse(parser, arguments)
    began, steps, episodes = time.time(), options.steps, EPISODES
    tiny: dict[str, object] = {}
    if options.quick:
        steps, episodes = 60, continuing.FINAL_EPISODES
        tiny = TINY
    if not options.report:
        for line in train(options.run, steps, tiny):
            print(line, file=sys.stderr)
    kept = options.out / "rover.parquet"
    known = pd.read_parquet(kept) if options.report and kept.exists() else None
    now = {**SETTINGS, "total_steps": steps}
    setting = setting_text({name: tiny.get(name, value) for name, value in now.items()})
    rows, missing = evaluate_policies(options.run, episodes, known, setting)
    if rows.empty:
        print(f"nothing is trained in {options.run} yet")
        return 1
    facts = provenance(
        steps=steps,
        history_length=HISTORY_LENGTH,
        **SETTINGS,
        seeds=SEEDS,
        episodes_per_seed=episodes,
        policies=len(rows.drop_duplicates(["algorithm", "trained_on", "seed"])),
        missing=len(missing),
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )
    text = "\n\n".join([table(rows, references(episodes), setting), order(rows)])
    write_results(options.out, "rover", rows, text, facts)
    draw(rows, options.out / "rover.png")
    keep_curves(options.run, options.out, "rover")
    say(text, missing)
    return 0


if __name__ == "__main__":
    sys.exit(main())
