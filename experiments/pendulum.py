"""Trains and tests the agents for the paper's figures of the pendulum.

Usage: python experiments/pendulum.py [--quick] [--run DIR] [--out DIR] [--steps N] [--seeds N]
                                      [--lengths L ...] [--width H] [--disturbances D ...]
                                      [--algorithms A ...] [--first-seed S] [--report]

The script trains the cells of experiments/pendulum_cells.py that are not in the table yet, as a
study in DIR. If you repeat the command, also with another DIR, it only trains what is missing from
the table. With --first-seed 5, further seeds join those of the table. They need a DIR of their own,
because a study trains all of its seeds in all of its cells. With other --steps, give another --out,
because the claims compare trainings with one number of steps.

Then the script tests each agent under its own disturbance, and the agents of `random-sine` under
five other conditions, in 1,000 episodes each. It writes pendulum.md and .parquet, generalisation.md
and .parquet, pendulum_curves.parquet, and the pictures of experiments/pendulum_figures.py. The
paper has five seeds, lengths 1 to 20 and width 128; the table states what was run. `--report` does
not train: it reads all run directories in DIR, also incomplete studies, if there are any, and draws
the tables and pictures again. Other rows of the table do not change; rows of earlier settings are
marked.

Returns are normalised: 0 is the uniform random policy, 1 is the fully observed optimum.
"""

import argparse
import functools
import pathlib
import sys
import time

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.errors import UserError
from rtd3jax.study import presets
from rtd3jax.study.derive import derive
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.transfer import transfer

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from continuing import train_missing  # noqa: E402
from effects import FAILED  # noqa: E402
from pendulum_cells import (  # noqa: E402
    BEYOND_THE_PAPER,
    HARD_BIAS,
    cells,
    current_setting,
    in_the_paper,
    missing,
    settings_of,
)
from pendulum_figures import draw_all, filter_returns  # noqa: E402
from settings import mark, notes, setting_text  # noqa: E402
from writing import (  # noqa: E402
    RESULTS,
    check_steps,
    markdown_table,
    mean_text,
    parse,
    provenance,
    write_results,
)

CONDITIONS = (
    "random-sine",
    "combined-sine",
    "damped-sine",
    HARD_BIAS,
    "noise:sigma=1.0",
)
"""Conditions for tests of the agents of `random-sine` (the paper's generalisation figure)."""
LENGTHS = (6, 20, 1, 3, 10)
"""The paper's lengths, in an order that soon gives a useful figure."""
ALL_DISTURBANCES = (
    *presets.PENDULUM_DISTURBANCES,
    *presets.ACTION_HISTORY_DISTURBANCES,
    *BEYOND_THE_PAPER,
)
SEEDS = 5
"""The paper's seeds."""
KEY = ("algorithm", "history_length", "seed")
TEST_EPISODES = 1_000
EARLIER_EPISODES = 20
"""The episodes of rows of an old table, which has no column of that name."""
REFERENCE_EPISODES = 1_000


@functools.cache
def scale(name: str) -> tuple[float, float]:
    """Mean return of the uniform random policy under a disturbance, and the ceiling."""
    env = rtd.make("pendulum", name)
    returns = rtd.evaluate(rtd.random_policy(env), env, REFERENCE_EPISODES, 0, true_reward=True)
    return float(np.mean(returns)), rtd.ceiling(rtd.make("pendulum")).mean


def normalised(lanes: pd.DataFrame, column: str) -> pd.Series:
    """``true_return``, normalised by the scale of the disturbance in ``column``."""
    low, high = np.array([scale(name) for name in lanes[column]], np.float64).reshape(-1, 2).T
    return (lanes["true_return"] - low) / (high - low)


def tested(run: pathlib.Path, trained_on: str, episodes: int) -> pd.DataFrame:
    """A row per lane and condition: the mean return of the true state, also normalised.

    The condition is the lane's own disturbance; for `random-sine`, also each of `CONDITIONS`. The
    table is empty if no lane is trained yet.
    """
    directory = RunDirectory.open(run)
    trained = [cell for cell in directory.cells if cell.disturbance == trained_on]
    conditions = CONDITIONS if trained_on == "random-sine" else (trained_on,)
    try:
        returns = transfer(directory, conditions, episodes, cells=trained, write=False)
    except UserError as error:
        print(f"missing: trained on {trained_on}: {error}")
        return pd.DataFrame()
    lane = ["algorithm", "history_length", "trained_on", "tested_on", "seed"]
    lanes = returns.groupby(lane, as_index=False)["true_return"].mean()
    lanes["normalised"] = normalised(lanes, "tested_on")
    configs = {(c.config.algorithm, c.config.window_tokens): c.config for c in directory.cells}
    own = [configs[key] for key in zip(lanes["algorithm"], lanes["history_length"], strict=True)]
    return lanes.assign(
        episodes=episodes,
        steps=[config.total_steps for config in own],
        width=[config.hidden_size for config in own],
        setting=[own_setting(config) for config in own],
    )


def all_tested(run: pathlib.Path, episodes: int) -> pd.DataFrame:
    """`tested` for each disturbance of a study; empty for a study of another environment."""
    own = [cell for cell in RunDirectory.open(run).cells if cell.env == "pendulum"]
    names = dict.fromkeys(cell.disturbance for cell in own)
    rows = [tested(run, name, episodes) for name in names]
    return pd.concat(rows, ignore_index=True) if rows else pd.DataFrame()


def own_setting(config: rtd.Config) -> str:
    """The text of `current_setting` for this configuration."""
    fields = settings_of(config.algorithm)
    return setting_text({name: getattr(config, name) for name in fields})


def with_others(lanes: pd.DataFrame, path: pathlib.Path, column: str) -> pd.DataFrame:
    """``lanes`` and the other rows of the table at ``path``; ``column`` is part of its key."""
    if not path.exists():
        return lanes
    kept = pd.read_parquet(path)
    if "setting" not in kept:
        kept["setting"] = "the configuration's defaults"  # as in all tables without this column
    if lanes.empty:
        return kept
    key = ["algorithm", "history_length", column, "seed"]
    replaced = pd.MultiIndex.from_frame(kept[key]).isin(pd.MultiIndex.from_frame(lanes[key]))
    return pd.concat([lanes, kept[~replaced]], ignore_index=True)


def with_whole_numbers(lanes: pd.DataFrame) -> pd.DataFrame:
    """``lanes`` with integers in the columns of `facts`, also from old tables that lacked one."""
    lanes = lanes.assign(episodes=lanes["episodes"].fillna(EARLIER_EPISODES))
    return lanes.astype(dict.fromkeys(("steps", "width", "episodes"), int))


def of_each(lanes: pd.DataFrame, column: str) -> str:
    """The value of ``column`` in most lanes, and the agents of lanes that have other values."""
    usual = lanes[column].mode()[0]
    parts = [f"{usual:,}"]
    for value, own in lanes[lanes[column] != usual].groupby(column):
        parts.append(f"{', '.join(sorted(own['algorithm'].unique()))}: {value:,}")
    return "; ".join(parts)


def table(
    lanes: pd.DataFrame, column: str, names: tuple[str, ...], filtered: dict[str, float]
) -> str:
    """Mean normalised return ± std over seeds: rows are agents and lengths, columns disturbances.

    Cells that do not have `SEEDS` seeds state their number. Cells that were trained with earlier
    settings are marked; those that no figure of the paper has are dashes. ``filtered`` has the
    returns of the filter, for a separate row.
    """
    older = lanes["setting"] != lanes["algorithm"].map(current_setting)
    body = []
    for algorithm in rtd.ALGORITHMS:
        own = lanes[lanes["algorithm"] == algorithm]
        for length in sorted(own["history_length"].unique()):
            line = [algorithm, str(length or "–")]
            for name in names:
                here = own[(own["history_length"] == length) & (own[column] == name)]
                values = here["normalised"]
                dagger = mark(int(older[here.index].sum()), len(here))
                missing_text = "not run" if in_the_paper(name, algorithm) else "–"
                more = f" ({len(values)})" if len(values) != SEEDS else ""
                line.append(
                    f"{mean_text(values, 3)}{more}{dagger}" if len(values) else missing_text
                )
            body.append(line)
    if filtered:
        known = [f"{filtered[name]:.3f}" if name in filtered else "–" for name in names]
        body.append(["a Bayes filter that knows the process", "–", *known])
    header = ["agent", "l", *names]
    return "\n".join([markdown_table(header, body), *notes(lanes["setting"][older])])


def facts(lanes: pd.DataFrame, began: float) -> dict[str, object]:
    """The facts below the table."""
    return provenance(
        normalised="0 is the uniform-random policy, 1 the fully observed optimum",
        lanes=len(lanes),
        seeds=f"{SEEDS} in each cell; another number is in parentheses",
        lengths=sorted(int(length) for length in lanes["history_length"].unique()),
        steps=of_each(lanes, "steps"),
        width=of_each(lanes, "width"),
        episodes=of_each(lanes, "episodes"),
        setting_where_not_marked=setting_text(presets.PENDULUM_SETTINGS),
        and_besides=presets.PENDULUM_OWN_SETTINGS,
        precision=rtd.Config.precision,
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )


def failed(lanes: pd.DataFrame) -> dict[str, str]:
    """How many trainings of each agent ended below `FAILED`, under the disturbances of all agents.

    Earlier settings do not count.
    """
    own = lanes[
        lanes["disturbance"].isin(presets.PENDULUM_DISTURBANCES)
        & (lanes["setting"] == lanes["algorithm"].map(current_setting))
    ]
    worse = (own["normalised"] < FAILED).groupby(own["algorithm"]).agg(["sum", "count"])
    return {str(name): f"{low} of {count}" for name, low, count in worse.itertuples()}


def curves_of(run: pathlib.Path) -> pd.DataFrame:
    """Normalised learning curves of a run directory: a row per lane and evaluation."""
    directory = RunDirectory.open(run)
    path = run / "curves.parquet"
    lanes = ["env", "disturbance", "algorithm", "history_length", "seed"]
    done = sum(directory.lanes.is_done(c, s) for c in directory.cells for s in directory.seeds)
    if not path.exists() or len(pd.read_parquet(path, columns=lanes).drop_duplicates()) < done:
        derive(directory, (), pictures=False)  # lanes have ended since the study wrote its tables
    kept = pd.read_parquet(path)
    kept = kept.assign(normalised=normalised(kept, "disturbance").round(4))
    configs = {tuple(c.key.values()): c.config for c in directory.cells}
    own = kept[["env", "disturbance", "algorithm", "history_length"]].itertuples(index=False)
    settings = [own_setting(configs[tuple(key)]) for key in own]
    names = ["algorithm", "history_length", "disturbance", "seed", "step", "normalised"]
    return kept[names].assign(setting=settings)


def once(rows: pd.DataFrame, key: list[str], settings: list[str]) -> pd.DataFrame:
    """``rows`` without repetitions; the script ends if a training has two ``settings``."""
    rows = rows.drop_duplicates([*key, *settings], ignore_index=True)
    if rows.duplicated(key).any():
        sys.exit(f"two run directories hold the same training with other {' or '.join(settings)}")
    return rows


def tested_in(run: pathlib.Path, episodes: int) -> tuple[list[pathlib.Path], pd.DataFrame]:
    """The run directories in ``run`` with trained lanes, and their rows of `all_tested`."""
    paths = [path.parent for path in sorted(run.rglob("config.json"))]
    found = {path: rows for path in paths if len(rows := all_tested(path, episodes))}
    if not found:
        return [], pd.DataFrame(columns=["algorithm", "trained_on", "tested_on"])
    rows = pd.concat(found.values(), ignore_index=True)
    # Two directories may hold the same training, whose returns are then the same.
    return list(found), once(rows, [*KEY, "trained_on", "tested_on"], ["setting", "steps", "width"])


def curves_in(runs: list[pathlib.Path]) -> pd.DataFrame:
    """`curves_of` each of the run directories."""
    if not runs:
        return pd.DataFrame()
    curves = pd.concat([curves_of(run) for run in runs], ignore_index=True)
    return once(curves, [*KEY, "disturbance", "step"], ["setting"])


def report(options: argparse.Namespace, episodes: int, began: float) -> int:
    """Write tables and pictures: the rows of the runs in ``options.run``, and those kept before."""
    runs, rows = tested_in(options.run, episodes)
    files = {name: options.out / f"{name}.parquet" for name in ("pendulum", "generalisation")}
    if not runs:
        print(f"nothing is trained in {options.run} yet")
        if not files["pendulum"].exists():
            return 1
    lanes = rows[rows["trained_on"] == rows["tested_on"]].drop(columns="trained_on")
    lanes = lanes.rename(columns={"tested_on": "disturbance", "true_return": "mean"})
    lanes = with_others(lanes, files["pendulum"], "disturbance")
    lanes = with_whole_numbers(lanes.drop(columns="return", errors="ignore"))  # of an old version
    filtered = filter_returns(options.out)
    text = table(lanes, "disturbance", ALL_DISTURBANCES, filtered)
    about = {**facts(lanes, began), f"trainings_below_{FAILED}": failed(lanes)}
    write_results(options.out, "pendulum", lanes, text, about)
    curves_file = options.out / "pendulum_curves.parquet"
    curves = with_others(curves_in(runs), curves_file, "disturbance")
    if len(curves):
        curves.to_parquet(curves_file, index=False)
    print(text)
    carried = rows[rows["trained_on"] == "random-sine"].drop(columns="trained_on")
    moved = with_others(carried, files["generalisation"], "tested_on")
    if moved.empty:
        print("missing: generalisation: nothing is trained on random-sine")
    else:
        moved = with_whole_numbers(moved)
        text = table(moved, "tested_on", CONDITIONS, filtered)
        write_results(
            options.out, "generalisation", moved, text, facts(moved.drop_duplicates(KEY), began)
        )
        print(text)
    draw_all(options.out, options.out)
    return 0


def check_seeds_of(run: pathlib.Path, seeds: range) -> None:
    """End the script if the study in ``run`` has other seeds, which it would also train."""
    if not (run / "config.json").exists():
        return
    others = set(RunDirectory.open(run).seeds) - set(seeds)
    if others:
        sys.exit(
            f"{run} holds other seeds ({min(others)} to {max(others)}), and a study trains all of "
            "its seeds in all of its cells: choose another --run"
        )


def train(options: argparse.Namespace, tiny: dict[str, object]) -> list[str]:
    """Train the cells missing from the table; return a line for each lane that was lost."""
    path = options.out / "pendulum.parquet"
    table = pd.read_parquet(path) if path.exists() else pd.DataFrame()
    if len(table) and "setting" not in table:
        table = pd.DataFrame()  # an earlier version wrote the table
    wanted = cells(options, tiny)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    todo = missing(wanted, table, seeds)
    if todo:
        check_seeds_of(options.run, seeds)
    return train_missing(path, wanted, todo, seeds, options.run, quick=bool(tiny))


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/pendulum"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument(
        "--steps", type=int, default=presets.PENDULUM_STEPS, help="h-td3 has twice as many"
    )
    parser.add_argument("--seeds", type=int, default=SEEDS, metavar="N")
    parser.add_argument("--first-seed", type=int, default=0, metavar="S", help="of the N seeds")
    parser.add_argument("--lengths", type=int, nargs="+", default=[*LENGTHS])
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--disturbances", nargs="+", metavar="D", default=[], help="no others")
    parser.add_argument("--algorithms", nargs="+", metavar="A", default=list(rtd.ALGORITHMS))
    parser.add_argument("--report", action="store_true", help="no training")
    options = parse(parser, arguments)
    check_steps(parser, options, presets.PENDULUM_STEPS)
    began, episodes = time.time(), TEST_EPISODES
    tiny: dict[str, object] = {}
    if options.quick:
        options.steps, options.seeds, options.lengths, options.width = 60, 1, [1], 4
        tiny = {"learning_starts": 50, "eval_every": 60, "eval_episodes": 1}
        options.disturbances, episodes = options.disturbances or ["random-sine"], 2
    if not options.report:
        for line in train(options, tiny):
            print(line, file=sys.stderr)
    return report(options, episodes, began)


if __name__ == "__main__":
    sys.exit(main())
