"""The paper's pendulum figures: agents, disturbances, window lengths, and what action history adds.

Usage: python experiments/pendulum.py [--quick] [--run DIR] [--out DIR] [--steps N] [--seeds N]
                                      [--lengths L ...] [--width H] [--disturbances D ...]
                                      [--report]

Trains every agent under four disturbances, and `lstm-td3` with and without action history also
fully observed, under `temporal-bias` and under stronger noise, in a run directory of the sweep; the
same command goes on with what is missing. Then tests the agents of `random-sine` under five other
conditions, 1,000 episodes each. Writes pendulum.md, .parquet and .png, the learning curves, and
generalisation.md and .parquet. The paper has five seeds, lengths 1 to 20 and width 128; the table
says what was run. `--report` does not train.

One setting for all agents: experiments/pendulum_search.py found it on seeds that are not reported,
under `hidden`. With `--disturbances` the rows of others stay as they are; those of an earlier
setting are marked.

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
from rtd3jax import sweep
from rtd3jax.envs.registry import parse_disturbance
from rtd3jax.errors import UserError
from rtd3jax.study.figures import COLOURS
from rtd3jax.study.results import EPISODES, read_table
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import seed_means
from rtd3jax.study.transfer import transfer

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from settings import flags, setting_text  # noqa: E402
from writing import (  # noqa: E402
    RESULTS,
    keep_curves,
    markdown_table,
    provenance,
    write_results,
)

DISTURBANCES = (
    *("temporal-sine", "random-sine", "noise", "hidden"),
    *("none", "temporal-bias", "noise:sigma=1.0"),
)
CONDITIONS = (
    "random-sine",
    "combined-sine",
    "damped-sine",
    "temporal-bias:amplitude_min=1.0,amplitude_max=1.0",
    "noise:sigma=1.0",
)
"""Under which agents of `random-sine` are tested (the paper's generalisation figure)."""
SETTINGS = {
    "critic_learning_rate": 3e-3,
    "actor_learning_rate": 3e-4,
    "final_learning_rate_fraction": 0.0,
    "gamma": 0.97,
    "reward_scale": 0.1,
    "exploration_noise": 0.5,
    "replay_capacity": 10_000,
}
GENERALISATION_EPISODES = 1_000
REFERENCE_EPISODES = 1_000


def train(run: pathlib.Path, options: argparse.Namespace, more: list[str]) -> int:
    """Train what is missing; the sweep's exit status."""
    lengths = [str(length) for length in options.lengths]
    if options.disturbances:
        more = ["--disturbances", *options.disturbances, "--algorithms", *rtd.ALGORITHMS, *more]
    return sweep.main(
        [
            *("--preset", "pendulum", "--history-lengths", *lengths, "--out", str(run)),
            *("--seeds", str(options.seeds), "--total-steps", str(options.steps)),
            *("--hidden-size", str(options.width), *flags(SETTINGS), *more),
        ]
    )


@functools.cache
def scale(name: str) -> tuple[float, float]:
    """Mean return of the uniform-random policy under a disturbance, and the ceiling."""
    disturbance, parameters = parse_disturbance(name)
    env = rtd.make("pendulum", disturbance, **parameters)
    returns = rtd.evaluate(rtd.random_policy(env), env, REFERENCE_EPISODES, 0, true_reward=True)
    return float(np.mean(returns)), rtd.ceiling(rtd.make("pendulum")).mean


def normalised(lanes: pd.DataFrame, column: str) -> pd.Series:
    """``true_return`` between the two ends of the disturbance that ``column`` names."""
    low, high = (lanes[column].map(lambda name, end=end: scale(name)[end]) for end in (0, 1))
    return (lanes["true_return"] - low) / (high - low)


def finals(run: pathlib.Path) -> pd.DataFrame:
    """A row per lane: mean true-state return of the final episodes, and normalised."""
    lanes = seed_means(read_table(run / "episodes.parquet", EPISODES))
    lanes = lanes[lanes["algorithm"].isin(rtd.ALGORITHMS)].copy()
    lanes["normalised"] = normalised(lanes, "disturbance")
    return lanes.drop(columns="env").rename(columns={"true_return": "mean"})


def with_others(lanes: pd.DataFrame, path: pathlib.Path) -> pd.DataFrame:
    """``lanes``, and those of the table at ``path`` that trained under other disturbances."""
    if not path.exists():
        return lanes
    kept = pd.read_parquet(path)
    if "setting" not in kept:
        kept["setting"] = "the configuration's defaults"  # as all tables were, when none was noted
    return pd.concat([lanes, kept[~kept["disturbance"].isin(lanes["disturbance"])]])


def of_each(lanes: pd.DataFrame, column: str) -> dict[str, object]:
    """``steps``, ``width`` or ``setting`` of each disturbance."""
    return {name: own[column].tolist()[0] for name, own in lanes.groupby("disturbance")}


def generalisation(run: pathlib.Path, episodes: int) -> pd.DataFrame:
    """A row per lane of `random-sine` and condition; normalised as in `finals`."""
    directory = RunDirectory.open(run)
    directory.cells = [cell for cell in directory.cells if cell.disturbance == "random-sine"]
    table = transfer(directory, CONDITIONS, episodes, write=False)
    lane = ["algorithm", "history_length", "tested_on", "seed"]
    lanes = table.groupby(lane, as_index=False)["true_return"].mean()
    lanes["normalised"] = normalised(lanes, "tested_on")
    return lanes


def table(lanes: pd.DataFrame, column: str, names: tuple[str, ...]) -> str:
    """Agents and lengths down, disturbances across: mean normalised return ± std over seeds.

    Columns that were trained with an earlier setting are marked.
    """
    older = lanes[lanes["setting"] != setting_text(SETTINGS)]
    header = [f"{name} †" if (older[column] == name).any() else name for name in names]
    body = []
    for algorithm in rtd.ALGORITHMS:
        own = lanes[lanes["algorithm"] == algorithm]
        for length in sorted(own["history_length"].unique()):
            line = [algorithm, str(length or "–")]
            for name in names:
                here = own[(own["history_length"] == length) & (own[column] == name)]["normalised"]
                spread = f" ± {here.std(ddof=1):.3f}" if len(here) > 1 else ""
                line.append(f"{here.mean():.3f}{spread}" if len(here) else "not run")
            body.append(line)
    notes = [f"\n† trained with {text}" for text in sorted({*older["setting"]})]
    return "\n".join([markdown_table(["agent", "l", *header], body), *notes])


def draw(lanes: pd.DataFrame, path: pathlib.Path) -> None:
    """The paper's final returns against the agent: a panel per disturbance, dots are seeds."""
    names = [name for name in DISTURBANCES if (lanes["disturbance"] == name).any()]
    figure = Figure(figsize=(2.6 * len(names) + 1.6, 3.4), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(names), sharey=True))
    for axes, name in zip(panels, names, strict=True):
        here = lanes[lanes["disturbance"] == name]
        for index, algorithm in enumerate(rtd.ALGORITHMS):
            own = here[here["algorithm"] == algorithm]
            lengths = sorted(own["history_length"].unique())
            for k, length in enumerate(lengths):
                values = own[own["history_length"] == length]["normalised"]
                x = index + 0.7 * ((k + 0.5) / len(lengths) - 0.5)
                axes.plot([x] * len(values), values, ".", ms=4, color=COLOURS[algorithm], alpha=0.5)
                axes.plot(x, values.mean(), "_", ms=9, mew=2, color=COLOURS[algorithm])
        axes.axhline(1.0, color="#777777", lw=0.8)
        axes.set_xticks(range(len(rtd.ALGORITHMS)), rtd.ALGORITHMS, rotation=60, ha="right")
        axes.set_title(f"{name}\n{of_each(here, 'steps')[name]:,} steps", fontsize=10)
        axes.grid(axis="y", color="#E4E4E4", lw=0.6)
    panels[0].set_ylabel("normalised return")
    figure.savefig(path, dpi=150)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/pendulum"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--steps", type=int, default=30_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--lengths", type=int, nargs="+", default=[1, 3, 6, 10, 20])
    parser.add_argument("--width", type=int, default=128)
    parser.add_argument("--disturbances", nargs="+", metavar="D", help="no others")
    parser.add_argument("--report", action="store_true", help="no training")
    options = parser.parse_args(arguments)
    began, more, episodes = time.time(), [], GENERALISATION_EPISODES
    if options.quick:
        options.steps, options.seeds, options.lengths, options.width = 40, 1, [1], 4
        more = ["--batch-size=4", "--learning-starts=10", "--eval-every=40", "--eval-episodes=1"]
        more += ["--final-episodes=1", "--quiet", "--no-report", "--algorithms", "td3"]
        if not options.disturbances:
            more += ["--disturbances", "random-sine"]
        episodes = 2
    status = 0 if options.report else train(options.run, options, more)
    if status not in (0, 1):
        return status
    lanes = finals(options.run)
    if options.disturbances:
        lanes = lanes[lanes["disturbance"].isin(options.disturbances)]
    if lanes.empty:
        print(f"nothing is trained in {options.run} yet")
        return 1
    config = RunDirectory.open(options.run).cells[0].config
    setting = setting_text({name: getattr(config, name) for name in SETTINGS})
    lanes = lanes.assign(steps=config.total_steps, width=config.hidden_size, setting=setting)
    curves, carried_from = "pendulum", lanes[lanes["disturbance"] == "random-sine"]
    if options.disturbances:
        curves = f"pendulum_{config.total_steps}_steps"
        lanes = with_others(lanes, options.out / "pendulum.parquet")

    def facts(lanes: pd.DataFrame) -> dict[str, object]:
        return provenance(
            normalised="0 is the uniform-random policy, 1 the fully observed optimum",
            lanes=len(lanes),
            seeds={name: own["seed"].nunique() for name, own in lanes.groupby("disturbance")},
            lengths=sorted(int(length) for length in lanes["history_length"].unique()),
            steps=of_each(lanes, "steps"),
            width=of_each(lanes, "width"),
            setting=of_each(lanes, "setting"),
            precision=config.precision,
            minutes_of_the_last_call=round((time.time() - began) / 60, 1),
        )

    text = table(lanes, "disturbance", DISTURBANCES)
    write_results(options.out, "pendulum", lanes, text, facts(lanes))
    draw(lanes, options.out / "pendulum.png")
    keep_curves(options.run, options.out, curves)
    print(text)
    try:
        carried = generalisation(options.run, episodes).assign(setting=setting)
    except UserError as error:
        print(f"missing: generalisation: {error}")
        return 0
    text = table(carried, "tested_on", CONDITIONS)
    write_results(
        options.out, "generalisation", carried, text, {**facts(carried_from), "episodes": episodes}
    )
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
