"""The paper's pendulum figures: agents, disturbances, window lengths, and what action history adds.

Usage: python experiments/pendulum.py [--quick] [--run DIR] [--out DIR] [--steps N] [--seeds N]
                                      [--lengths L ...] [--width H] [--disturbances D ...]
                                      [--algorithms A ...] [--report]

Trains the studies of experiments/pendulum_studies.py in run directories of the sweep below DIR; the
same command goes on with what is missing. Then tests each agent under its own disturbance, and
those of `random-sine` under five other conditions, 1,000 episodes each. Writes pendulum.md,
.parquet and .png, the learning curves, and generalisation.md and .parquet. The paper has five
seeds, lengths 1 to 20 and width 128; the table says what was run. `--report` does not train.
`--disturbances` and `--algorithms` are for parts of it, each in another DIR. Rows of lanes that are
not in DIR stay as they are; those of an earlier setting are marked.

Returns are normalised: 0 is the uniform-random policy, 1 the fully observed optimum.
"""

import argparse
import functools
import pathlib
import sys
import time

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import rtd3jax as rtd
from rtd3jax.envs.registry import parse_disturbance
from rtd3jax.errors import UserError
from rtd3jax.study import presets
from rtd3jax.study.colours import colour_of
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.transfer import transfer

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pendulum_studies import current_setting, settings_of, studies  # noqa: E402
from settings import mark, notes, setting_text  # noqa: E402
from writing import (  # noqa: E402
    RESULTS,
    keep_curves,
    markdown_table,
    provenance,
    write_results,
)

CONDITIONS = (
    "random-sine",
    "combined-sine",
    "damped-sine",
    "temporal-bias:amplitude_min=1.0,amplitude_max=1.0",
    "noise:sigma=1.0",
)
"""Under which agents of `random-sine` are tested (the paper's generalisation figure)."""
ALL_DISTURBANCES = (*presets.PENDULUM_DISTURBANCES, *presets.ACTION_HISTORY_DISTURBANCES)
TEST_EPISODES = 1_000
EARLIER_EPISODES = 20
"""Of rows in a table that did not say yet."""
REFERENCE_EPISODES = 1_000


@functools.cache
def scale(name: str) -> tuple[float, float]:
    """Mean return of the uniform-random policy under a disturbance, and the ceiling."""
    disturbance, parameters = parse_disturbance(name)
    env = rtd.make("pendulum", disturbance, **parameters)
    returns = rtd.evaluate(rtd.random_policy(env), env, REFERENCE_EPISODES, 0, true_reward=True)
    return float(np.mean(returns)), rtd.ceiling(rtd.make("pendulum")).mean


def normalised(lanes: pd.DataFrame, column: str) -> pd.Series:
    """``true_return`` between the two ends of the disturbance that ``column`` names."""
    low, high = np.array([scale(name) for name in lanes[column]], np.float64).reshape(-1, 2).T
    return (lanes["true_return"] - low) / (high - low)


def tested(run: pathlib.Path, trained_on: str, episodes: int) -> pd.DataFrame:
    """A row per lane of a disturbance and condition: mean true-state return, and normalised.

    The condition is what the lane was trained on; for `random-sine`, each of `CONDITIONS`. Empty
    when no lane is trained yet.
    """
    directory = RunDirectory.open(run)
    directory.cells = [cell for cell in directory.cells if cell.disturbance == trained_on]
    conditions = CONDITIONS if trained_on == "random-sine" else (trained_on,)
    try:
        returns = transfer(directory, conditions, episodes, write=False)
    except UserError as error:
        print(f"missing: trained on {trained_on}: {error}")
        return pd.DataFrame()
    lane = ["algorithm", "history_length", "trained_on", "tested_on", "seed"]
    lanes = returns.groupby(lane, as_index=False)["true_return"].mean()
    lanes["normalised"] = normalised(lanes, "tested_on")
    config = directory.cells[0].config  # agents of a study share all but what they are
    return lanes.assign(
        episodes=episodes,
        steps=config.total_steps,
        width=config.hidden_size,
        setting=own_setting(config),
    )


def all_tested(run: pathlib.Path, episodes: int) -> pd.DataFrame:
    """`tested` for each disturbance of a study."""
    names = dict.fromkeys(cell.disturbance for cell in RunDirectory.open(run).cells)
    return pd.concat([tested(run, name, episodes) for name in names], ignore_index=True)


def own_setting(config: rtd.Config) -> str:
    """What `current_setting` would say of this configuration."""
    fields = settings_of(config.algorithm)
    return setting_text({name: getattr(config, name) for name in fields})


def with_others(lanes: pd.DataFrame, path: pathlib.Path, column: str) -> pd.DataFrame:
    """``lanes``, and the others of the table at ``path``; ``column`` tells a lane's rows apart."""
    if not path.exists():
        return lanes
    kept = pd.read_parquet(path)
    if "setting" not in kept:
        kept["setting"] = "the configuration's defaults"  # as all tables were, when none was noted
    key = ["algorithm", "history_length", column, "seed"]
    replaced = pd.MultiIndex.from_frame(kept[key]).isin(pd.MultiIndex.from_frame(lanes[key]))
    return pd.concat([lanes, kept[~replaced]], ignore_index=True)


def of_each(lanes: pd.DataFrame, column: str) -> dict[str, str]:
    """``steps``, ``seeds`` and the like of each disturbance; by agent where they differ."""
    found = {}
    for name, here in lanes.groupby("disturbance"):
        agents = here.groupby(column)["algorithm"].unique()
        parts = [
            f"{value:,}" if len(agents) == 1 else f"{value:,} ({', '.join(sorted(own))})"
            for value, own in agents.items()
        ]
        found[name] = ", ".join(parts)
    return found


def table(lanes: pd.DataFrame, column: str, names: tuple[str, ...]) -> str:
    """Agents and lengths down, disturbances across: mean normalised return ± std over seeds.

    Cells that were trained with an earlier setting are marked.
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
                spread = f" ± {values.std(ddof=1):.3f}" if len(values) > 1 else ""
                dagger = mark(int(older[here.index].sum()), len(here))
                line.append(f"{values.mean():.3f}{spread}{dagger}" if len(values) else "not run")
            body.append(line)
    header = ["agent", "l", *names]
    return "\n".join([markdown_table(header, body), *notes(lanes["setting"][older])])


def facts(lanes: pd.DataFrame, began: float) -> dict[str, object]:
    """What was run, for the table's foot."""
    cells = lanes.groupby(["algorithm", "history_length", "disturbance"])
    return provenance(
        normalised="0 is the uniform-random policy, 1 the fully observed optimum",
        lanes=len(lanes),
        seeds=of_each(lanes.assign(seeds=cells["seed"].transform("nunique")), "seeds"),
        lengths=sorted(int(length) for length in lanes["history_length"].unique()),
        steps=of_each(lanes, "steps"),
        width=of_each(lanes, "width"),
        episodes=of_each(lanes, "episodes"),
        setting_where_not_marked=setting_text(presets.PENDULUM_SETTINGS),
        and_besides=presets.PENDULUM_OWN_SETTINGS,
        precision=rtd.Config.precision,
        minutes_of_the_last_call=round((time.time() - began) / 60, 1),
    )


def draw(lanes: pd.DataFrame, path: pathlib.Path) -> None:
    """The paper's final returns against the agent: a panel per disturbance, dots are seeds."""
    names = [name for name in ALL_DISTURBANCES if (lanes["disturbance"] == name).any()]
    columns = min(len(names), 4)
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(2.6 * columns + 1.6, 3.4 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes in panels.flat[len(names) :]:
        axes.axis("off")
    for axes, name in zip(panels.flat, names, strict=False):
        here = lanes[lanes["disturbance"] == name]
        agents = [agent for agent in rtd.ALGORITHMS if (here["algorithm"] == agent).any()]
        for index, algorithm in enumerate(agents):
            own = here[here["algorithm"] == algorithm]
            lengths = sorted(own["history_length"].unique())
            for k, length in enumerate(lengths):
                values = own[own["history_length"] == length]["normalised"]
                x = index + 0.7 * ((k + 0.5) / len(lengths) - 0.5)
                axes.plot(
                    [x] * len(values), values, ".", ms=4, color=colour_of(algorithm), alpha=0.5
                )
                axes.plot(x, values.mean(), "_", ms=9, mew=2, color=colour_of(algorithm))
        axes.axhline(1.0, color="#777777", lw=0.8)
        axes.set_xticks(range(len(agents)), agents, rotation=60, ha="right")
        axes.set_xlim(-0.6, len(agents) - 0.4)
        steps = sorted(here["steps"].unique())
        axes.set_title(f"{name}\n{' and '.join(f'{n:,}' for n in steps)} steps", fontsize=10)
        axes.grid(axis="y", color="#E4E4E4", lw=0.6)
    for axes in panels[:, 0]:
        axes.set_ylabel("normalised return")
    figure.savefig(path, dpi=150)


def report(
    runs: list[pathlib.Path], options: argparse.Namespace, episodes: int, began: float
) -> int:
    """Write tables and pictures of what there is in the studies' run directories."""
    begun = [run for run in runs if (run / "config.json").exists()]
    found = {run: rows for run in begun if len(rows := all_tested(run, episodes))}
    if not found:
        print(f"nothing is trained in {options.run} yet")
        return 1
    rows = pd.concat(found.values(), ignore_index=True)
    lanes = rows[rows["trained_on"] == rows["tested_on"]].drop(columns="trained_on")
    lanes = lanes.rename(columns={"tested_on": "disturbance", "true_return": "mean"})
    lanes = with_others(lanes, options.out / "pendulum.parquet", "disturbance")
    lanes["episodes"] = lanes["episodes"].fillna(EARLIER_EPISODES).astype(int)
    text = table(lanes, "disturbance", ALL_DISTURBANCES)
    write_results(options.out, "pendulum", lanes, text, facts(lanes, began))
    draw(lanes, options.out / "pendulum.png")
    for run in found:
        keep_curves(run, options.out, f"pendulum_{options.run.name}_{run.name}")
    print(text)
    carried = rows[rows["trained_on"] == "random-sine"].drop(columns="trained_on")
    if carried.empty:
        print("missing: generalisation: nothing is trained on random-sine")
        return 0
    moved = with_others(carried, options.out / "generalisation.parquet", "tested_on")
    text = table(moved, "tested_on", CONDITIONS)
    under = lanes[lanes["disturbance"] == "random-sine"]
    about = {**facts(under, began), "episodes": episodes}
    write_results(options.out, "generalisation", moved, text, about)
    print(text)
    return 0


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/pendulum"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument(
        "--steps", type=int, default=presets.PENDULUM_STEPS, help="h-td3 has twice as many"
    )
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument(
        "--lengths", type=int, nargs="+", default=[*presets.PENDULUM_HISTORY_LENGTHS]
    )
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--disturbances", nargs="+", metavar="D", default=[], help="no others")
    parser.add_argument("--algorithms", nargs="+", metavar="A", default=list(rtd.ALGORITHMS))
    parser.add_argument("--report", action="store_true", help="no training")
    options = parser.parse_args(arguments)
    began, more, episodes = time.time(), [], TEST_EPISODES
    if options.quick:
        options.steps, options.seeds, options.lengths, options.width = 60, 1, [1], 4
        more = ["--learning-starts=50", "--eval-every=60", "--eval-episodes=1"]
        more += ["--final-episodes=1", "--quiet", "--no-report"]
        options.disturbances, episodes = options.disturbances or ["random-sine"], 2
    runs = []
    for study in studies(options.disturbances, options.algorithms):
        status = 0 if options.report else study.train(options.run / study.name, options, more)
        if status not in (0, 1):
            return status
        runs.append(options.run / study.name)
    return report(runs, options, episodes, began)


if __name__ == "__main__":
    sys.exit(main())
