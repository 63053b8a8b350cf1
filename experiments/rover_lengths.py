"""The rover's agents with longer windows, under AR(1) and sine slip.

Usage: python experiments/rover_lengths.py [--quick] [--run DIR] [--out DIR] [--steps N]
                                           [--lengths L ...] [--slips S ...] [--algorithms A ...]
                                           [--report]

The table of experiments/rover.py has agents whose window is one past step. This script trains the
agents that have a window with three longer windows, with the same settings, seeds and steps, and
tests all of them in 1,000 episodes of AR(1) slip. It writes rover_lengths.md, .parquet
(a row per policy) and .png; window 1 and `td3` are read from rover.parquet. It trains the cells
that the table does not have yet, as a study in DIR, in the order of the lengths, slips and agents
of the command; if you repeat the command, it only trains what is missing. `--report` does not
train: it tests what DIR has so far, also of a study that has not ended.
"""

import argparse
import pathlib
import sys
import time

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import rtd3jax as rtd
from rtd3jax.study.cells import Grid, make_cells
from rtd3jax.study.colours import colour_of
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH, ROVER_SETTINGS, ROVER_STEPS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from continuing import (  # noqa: E402
    FINAL_EPISODES,
    joined,
    kept,
    mean_and_error,
    not_in,
    train_missing,
    untested_policies,
)
from rover import EPISODES, SEEDS, TINY, ceiling_returns, levels  # noqa: E402
from rover import PAPER as PAPER_RETURNS  # noqa: E402
from settings import ROVER_SETTING  # noqa: E402
from writing import (  # noqa: E402
    RESULTS,
    check_steps,
    markdown_table,
    mean_text,
    parse,
    provenance,
    say,
    seeds_text,
    write_results,
)

SLIPS = ("ar1-slip", "sine-slip")
TESTED_ON = "ar1-slip"
LENGTHS = (3, 6, 10)
WITH_WINDOW = (
    "lstm-td3-no-action",
    "lstm-td3-1ha1hc",
    "lstm-td3",
    "lstm-td3-1ha2hc",
    "h-td3",
)
"""The agent whose return differs most from the paper's comes first."""
KEY = ["algorithm", "trained_on", "history_length", "seed"]
COLUMNS = [*KEY, "steps", "episodes", "mean", "standard_error"]


def wanted(options: argparse.Namespace, tiny: dict[str, object]) -> list[rtd.Cell]:
    """The cells of the lengths, slips and agents in ``options``."""
    settings = {**ROVER_SETTINGS, "total_steps": options.steps, **tiny}
    grids = [
        Grid("rover", (slip,), tuple(options.algorithms), (length,), settings)
        for length in options.lengths
        for slip in options.slips
    ]
    return make_cells(tuple(grids), {})


def has(rows: pd.DataFrame, cell: rtd.Cell, seed: int) -> bool:
    """Whether ``rows`` has the test of a lane."""
    config = cell.config
    key = (config.algorithm, cell.disturbance, config.window_tokens, seed, config.total_steps)
    return bool((rows[[*KEY, "steps"]] == list(key)).all(axis=1).any())


def tested(
    run: pathlib.Path, cells: list[rtd.Cell], rows: pd.DataFrame, seeds: range, episodes: int
) -> tuple[list[dict[str, object]], list[str]]:
    """A row for each trained policy that ``rows`` does not have, and what is missing."""
    policies, missing = untested_policies(run, cells, rows, seeds, has)
    env, found = rtd.make("rover", TESTED_ON), []
    for cell, seed, policy in policies:
        returns = np.asarray(rtd.evaluate(policy, env, episodes, seed=seed), np.float64)
        config = cell.config
        key = (config.algorithm, cell.disturbance, config.window_tokens, seed)
        values = (*key, config.total_steps, episodes)
        found.append({**dict(zip(COLUMNS, values, strict=False)), **mean_and_error(returns)})
    return found, missing


def of_the_rover(results: pathlib.Path) -> pd.DataFrame:
    """Rows of `td3`, and of window 1, from the table of experiments/rover.py with its settings."""
    path = results / "rover.parquet"
    if not path.exists():
        return pd.DataFrame(columns=COLUMNS)
    rows = pd.read_parquet(path)
    rows = rows[rows["trained_on"].isin(SLIPS) & (rows["tested_on"] == TESTED_ON)]
    rows = rows[rows["setting"] == ROVER_SETTING]
    windows = np.where(rows["algorithm"] == "td3", 0, ROVER_HISTORY_LENGTH)
    return rows.assign(history_length=windows, steps=ROVER_STEPS)[COLUMNS]


def returns_of(rows: pd.DataFrame, slip: str, algorithm: str, length: int) -> np.ndarray:
    """Mean returns of the seeds of one cell."""
    own = rows[(rows["algorithm"] == algorithm) & (rows["trained_on"] == slip)]
    return own[own["history_length"] == length]["mean"].to_numpy(np.float64)


def table(rows: pd.DataFrame) -> str:
    """For each slip, mean ± standard deviation over seeds: agents by window length."""
    lengths = (ROVER_HISTORY_LENGTH, *LENGTHS)
    header = ["trained on", "agent", *(f"l = {length}" for length in lengths), "the paper"]
    body = []
    for column, slip in enumerate(SLIPS):
        for algorithm in rtd.ALGORITHMS:
            line = [slip, algorithm]
            for length in lengths:
                if algorithm == "td3" and length != lengths[0]:
                    line.append("no window")
                    continue
                found = returns_of(rows, slip, algorithm, 0 if algorithm == "td3" else length)
                few = seeds_text(len(found), SEEDS)
                line.append(f"{mean_text(found, 3)}{few}" if len(found) else "not run")
            body.append([*line, PAPER_RETURNS[algorithm][column]])
    return markdown_table(header, body)


def draw(rows: pd.DataFrame, ceiling: float, out: pathlib.Path) -> None:
    """Draw returns by window length: a panel for each slip, a line for each agent."""
    figure = Figure(figsize=(8.4, 3.8), layout="constrained")
    for axes, slip in zip(figure.subplots(1, len(SLIPS), sharey=True), SLIPS, strict=True):
        for k, algorithm in enumerate(WITH_WINDOW):
            colour, shift = colour_of(algorithm), 0.1 * (k - 2)  # points of equal height stay apart
            own = {
                n: returns_of(rows, slip, algorithm, n) for n in (ROVER_HISTORY_LENGTH, *LENGTHS)
            }
            own = {length: values for length, values in own.items() if len(values)}
            means = [values.mean() for values in own.values()]
            axes.plot(
                np.add(list(own), shift), means, "o-", color=colour, label=algorithm, markersize=4
            )
            for length, values in own.items():
                axes.plot([length + shift] * len(values), values, ".", color=colour, alpha=0.4)
        td3 = returns_of(rows, slip, "td3", 0)
        if len(td3):
            axes.axhline(td3.mean(), color="#777777", linestyle="--", label="td3 (no window)")
        axes.axhline(ceiling, color="black", linestyle=":", label="ceiling")
        axes.set_title(f"trained on {slip}, tested on {TESTED_ON}")
        axes.set_xlabel("window length l")
        axes.set_xticks([ROVER_HISTORY_LENGTH, *LENGTHS])
        axes.set_xlim(0.5, max(LENGTHS) + 0.5)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("return (higher is better)")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=4, fontsize=8)
    figure.savefig(out / "rover_lengths.png", dpi=150)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover_lengths"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--steps", type=int, default=ROVER_STEPS)
    parser.add_argument("--lengths", type=int, nargs="+", choices=LENGTHS, default=[*LENGTHS])
    parser.add_argument("--slips", nargs="+", choices=SLIPS, default=[*SLIPS])
    parser.add_argument("--algorithms", nargs="+", choices=WITH_WINDOW, default=[*WITH_WINDOW])
    parser.add_argument("--report", action="store_true", help="test without training")
    options = parse(parser, arguments)
    check_steps(parser, options, ROVER_STEPS)
    began, episodes, seeds = time.time(), EPISODES, range(SEEDS)
    tiny: dict[str, object] = {}
    if options.quick:
        options.steps, episodes, seeds, tiny = 60, FINAL_EPISODES, range(1), TINY
        options.lengths, options.slips = [3], ["ar1-slip"]
        options.algorithms = ["lstm-td3-no-action"]
    rows = kept(options.out / "rover_lengths.parquet", COLUMNS)
    cells = wanted(options, tiny)
    if not options.report:
        todo = not_in(rows, cells, seeds, has)
        for line in train_missing("the table", cells, todo, seeds, options.run, options.quick):
            print(line, file=sys.stderr)
    found, missing = tested(options.run, cells, rows, seeds, episodes)
    rows = joined(rows, found, KEY)
    if rows.empty:
        print(f"nothing is trained in {options.run} yet")
        return 1
    beside = of_the_rover(options.out)
    both = rows if beside.empty else pd.concat([beside, rows], ignore_index=True)
    best = ceiling_returns(TESTED_ON, episodes).mean()
    text = f"{table(both)}\n\n{levels(episodes, TESTED_ON)}"
    facts = provenance(
        **{**ROVER_SETTINGS, "total_steps": options.steps},
        tested_on=TESTED_ON,
        seeds=SEEDS,
        episodes_per_seed=episodes,
        cells=len(rows.drop_duplicates(KEY[:-1])),
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )
    write_results(options.out, "rover_lengths", rows, text, facts)
    draw(both, best, options.out)
    say(text, missing)
    return 0


if __name__ == "__main__":
    sys.exit(main())
