"""Compares returns with segments and with windows, in five paired seeds with equal steps.

Usage: python experiments/segments_returns.py [--quick] [--search] [--tasks T ...] [--seeds N]
                                              [--out DIR] [--report]

The agent is `lstm-td3-1ha1hc` with width 64 and the settings of the presets, on the rover under
AR(1) slip at l = 6, and on the pendulum under `hidden`, `random-sine` and `noise` at l = 6 and 20.
Policies are tested in 1,000 episodes. Policies trained on segments act with a running carry;
policies trained on windows are also tested with a running carry, which they have never seen. The
pendulum's returns are normalised; the rover's returns are divided by the paper's best, |-1.36|.
Then the times of a step with segments and with windows are measured alternately. The script writes
segments_returns.md, .parquet and .json.

`--search` tests candidates with seeds from 100 on, which are not reported, and writes
segments_search.csv. Existing rows are not trained again.
"""

import argparse
import pathlib
import sys
import time
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study import presets

HERE = pathlib.Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
from effects import CONTRADICTED, NO_EFFECT, SUPPORTED, UNDECIDED, Effect  # noqa: E402
from pendulum import scale  # noqa: E402
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

from experiments.benchmarks.ours import Lanes, make_config  # noqa: E402
from rtd3jax.training.devices import workers  # noqa: E402

AGENT, WIDTH, EPISODES = "lstm-td3-1ha1hc", 64, 1_000
PAPERS_BEST = 1.36
"""The divisor of the rover's returns: the paper's best agent has -1.36."""
SEARCH_SEED, SEARCH_SEEDS, SEARCH_EPISODES = 100, 4, 400
TASKS: dict[str, tuple[str, str, int]] = {
    "rover ar1-slip l=6": ("rover", "ar1-slip", 6),
    **{
        f"pendulum {name} l={length}": ("pendulum", name, length)
        for length in (6, 20)
        for name in ("hidden", "random-sine", "noise")
    },
}
ROVER = {**presets.ROVER_SETTINGS, "total_steps": 40_000, "batch_size": 100}
PENDULUM = {**presets.PENDULUM_SETTINGS, "total_steps": presets.PENDULUM_STEPS}
SEGMENTS: dict[str, Any] = {"replay": "segments"}
CHOSEN: dict[tuple[str, int], dict[str, Any]] = {
    ("rover", 6): {**SEGMENTS, "batch_size": 200, "segment_length": 10, "burn_in_gradient": False},
    ("pendulum", 6): {
        **SEGMENTS,
        "batch_size": 100,
        "segment_length": 10,
        "burn_in_gradient": False,
    },
    ("pendulum", 20): {
        **SEGMENTS,
        "batch_size": 160,
        "segment_length": 10,
        "burn_in_gradient": False,
        "actor_noise": 0.1,
    },
}
"""The fields of the chosen candidate, by environment and history length."""


class Candidate(NamedTuple):
    """What a candidate for the segments changes in the settings with windows."""

    batch_size: int
    segment_length: int
    burn_in_gradient: bool
    acting: str
    others: dict[str, Any] = {}
    """Further fields of the configuration."""

    def fields(self) -> dict[str, Any]:
        """Fields of the configuration."""
        own = self._asdict()
        others = own.pop("others")
        return {**SEGMENTS, **own, **others} if self.segment_length else {}

    def key(self) -> dict[str, Any]:
        """The columns of the table that name the candidate."""
        others = " ".join(f"{name}={value}" for name, value in self.others.items())
        return {**self._asdict(), "others": others or "-"}


CANDIDATES: dict[tuple[str, int], list[Candidate]] = {
    ("pendulum", 6): [
        Candidate(50, 5, True, "carry"),
        Candidate(50, 5, True, "window"),
        Candidate(80, 5, True, "window"),
        Candidate(100, 10, True, "window"),
        Candidate(100, 10, False, "carry"),
        Candidate(100, 5, False, "carry"),
        Candidate(200, 10, False, "carry", {"update_every": 4}),
        Candidate(100, 10, False, "carry", {"critic_learning_rate": 1e-3}),
        Candidate(100, 10, False, "carry", {"actor_noise": 0.1}),
        Candidate(100, 10, False, "carry", {"actor_learning_rate": 3e-4}),
        Candidate(100, 10, False, "carry", {"tau": 0.005}),
    ],
    ("pendulum", 20): [
        Candidate(100, 10, True, "carry"),
        Candidate(100, 10, False, "carry"),
        Candidate(200, 20, True, "carry"),
        Candidate(200, 20, False, "carry", {"update_every": 4}),
        Candidate(200, 10, False, "carry", {"update_every": 4}),
        Candidate(100, 10, False, "carry", {"critic_learning_rate": 1e-3}),
        Candidate(100, 10, False, "carry", {"actor_noise": 0.1}),
        Candidate(160, 10, False, "carry", {"actor_noise": 0.1}),
    ],
    ("rover", 6): [Candidate(200, 10, False, "carry")],
}
SEARCHED = ("pendulum hidden l=6", "pendulum hidden l=20", "rover ar1-slip l=6")


def settings(task: str) -> dict[str, Any]:
    """The settings of a task with windows."""
    env, _, length = TASKS[task]
    base = ROVER if env == "rover" else PENDULUM
    return {**base, "history_length": length, "hidden_size": WIDTH, "algorithm": AGENT}


def returns(
    task: str, fields: dict[str, Any], seeds: range, episodes: int, tiny: dict[str, Any]
) -> dict[str, list[float]]:
    """Normalised mean return of each seed's final policy, with both ways of acting."""
    env_id, disturbance, _ = TASKS[task]
    env = rtd.make(env_id, disturbance)
    run = rtd.train(env, rtd.Config(**{**settings(task), **fields, **tiny}), seeds, progress=False)
    low, high = (0.0, PAPERS_BEST) if env_id == "rover" else scale(disturbance)
    found = {}
    for acting in ("window", "carry"):
        policies = [run.policy(seed).replace(acting=acting) for seed in seeds]
        means = [
            float(np.mean(rtd.evaluate(policy, env, episodes, seed=9, true_reward=True)))
            for policy in policies
        ]
        found[acting] = [(mean - low) / (high - low) for mean in means]
    return found


def cost(task: str, fields: dict[str, Any], seconds: float, repeats: int) -> float:
    """Median time of a step with segments, divided by the time with windows.

    Both are measured alternately, on the rover under AR(1) slip for every task.
    """
    sides = []
    for changes in ({}, fields):
        own = {**settings(task), **changes, "learning_starts": 1_000}
        own = {name: value for name, value in own.items() if name not in _OF_THE_BENCH}
        config = make_config(AGENT, TASKS[task][2], **own)
        lanes = Lanes(config, len(workers()))
        lanes.warm_up(seconds / 3)
        sides.append(lanes)
    shares = []
    for _ in range(repeats):
        taken = [duration / steps for steps, duration in (side.run(seconds) for side in sides)]
        shares.append(taken[1] / taken[0])
    return float(np.median(shares))


_OF_THE_BENCH = ("algorithm", "history_length", "total_steps", "eval_every")


def kept(path: pathlib.Path) -> pd.DataFrame:
    """The existing rows."""
    if not path.exists():
        return pd.DataFrame()
    return pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)


def has(rows: pd.DataFrame, **values: Any) -> bool:
    """Whether there is a row with these values."""
    if rows.empty:
        return False
    there = np.ones(len(rows), bool)
    for name, value in values.items():
        there &= (rows[name] == value).to_numpy()
    return bool(there.any())


def search(path: pathlib.Path, tasks: list[str], tiny: dict[str, Any]) -> None:
    """Complete the table of candidates."""
    rows = kept(path)
    for task in (name for name in SEARCHED if name in tasks):
        env, _, length = TASKS[task]
        base = settings(task)
        windows = Candidate(base["batch_size"], 0, True, "window")
        for candidate in (windows, *CANDIDATES[env, length]):
            if has(rows, task=task, **candidate.key()):
                continue
            seeds = range(SEARCH_SEED, SEARCH_SEED + (1 if tiny else SEARCH_SEEDS))
            began = time.process_time()
            fields = candidate.fields()
            found = returns(task, fields, seeds, 10 if tiny else SEARCH_EPISODES, tiny)
            own = found.pop(candidate.acting)
            (other,) = found.values()
            row = {
                "task": task,
                **candidate.key(),
                "seeds": len(seeds),
                "mean": round(float(np.mean(own)), 3),
                "worst_seed": round(min(own), 3),
                "acting_otherwise": round(float(np.mean(other)), 3),
                "cpu_seconds": round(time.process_time() - began),
            }
            print(row, flush=True)
            rows = pd.concat([rows, pd.DataFrame([row])], ignore_index=True)
            path.parent.mkdir(parents=True, exist_ok=True)
            rows.to_csv(path, index=False)


def compare(out: pathlib.Path, tasks: list[str], seeds: int, tiny: dict[str, Any]) -> pd.DataFrame:
    """Complete the table of pairs, with a row per task, variant and seed."""
    path = out / "segments_returns.parquet"
    rows = kept(path)
    for task in tasks:
        env, _, length = TASKS[task]
        for way, fields in (("windows", {}), ("segments", CHOSEN[env, length])):
            text = repr(sorted(fields.items()))
            missing = [s for s in range(seeds) if not has(rows, task=task, setting=text, seed=s)]
            if not missing:
                continue
            found = returns(
                task, fields, range(min(missing), seeds), 10 if tiny else EPISODES, tiny
            )
            new = pd.DataFrame(
                {
                    "task": task,
                    "way": way,
                    "setting": text,
                    "seed": range(min(missing), seeds),
                    "normalised": found["window" if way == "windows" else "carry"],
                    "acting_otherwise": found["carry" if way == "windows" else "window"],
                }
            )
            print(new.to_string(header=False), flush=True)
            if not rows.empty:  # drop the rows of other settings, and those that are new now
                of_cell = (rows["task"] == task) & (rows["way"] == way)
                stays = (rows["setting"] == text) & (rows["seed"] < min(missing))
                rows = rows[~of_cell | stays]
            rows = pd.concat([rows, new], ignore_index=True)
            out.mkdir(parents=True, exist_ok=True)
            rows.to_parquet(path, index=False)
    return rows


WORDS = {SUPPORTED: "gains", CONTRADICTED: "loses", NO_EFFECT: "equal", UNDECIDED: "undecided"}


def table(rows: pd.DataFrame, shares: dict[str, float]) -> str:
    """A line per task: both means, the paired difference with its 95% interval, the time."""
    body = []
    for task in TASKS:
        own = rows[rows["task"] == task]
        paired = own.pivot(index="seed", columns="way", values="normalised").dropna()
        if len(paired.columns) < 2 or paired.empty:
            continue
        other = own[own["way"] == "windows"]["acting_otherwise"].mean()
        sides = (paired[way].to_numpy() for way in ("segments", "windows"))
        effect = Effect("segments over windows", *sides, paired=True)
        mean, low, high = effect.interval()
        env, _, length = TASKS[task]
        chosen = CHOSEN[env, length]
        m = chosen["segment_length"]
        body.append(
            [
                task,
                f"{chosen['batch_size'] // m} x {m}",
                f"{paired['windows'].mean():.3f} (worst {paired['windows'].min():.3f})",
                f"{other:.3f}",
                f"{paired['segments'].mean():.3f} (worst {paired['segments'].min():.3f})",
                f"{mean:+.3f} [{low:+.3f}, {high:+.3f}]",
                f"{shares[task]:.2f}" if task in shares else "not measured",
                WORDS[effect.verdict()],
            ]
        )
    header = ["task", "segments", "windows", "windows, carry", "segments", "difference", "time", ""]
    return markdown_table(header, body)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument(
        "--search", action="store_true", help="test candidates on seeds that are not reported"
    )
    parser.add_argument(
        "--report", action="store_true", help="no training: write the table, with new times"
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS), metavar="T")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    tiny: dict[str, Any] = {}
    if options.quick:
        tiny = {"total_steps": 260, "learning_starts": 250, "hidden_size": 4, "eval_every": 260}
        options.tasks, options.seeds = options.tasks[:1], 1
    if options.search:
        search(options.out / "segments_search.csv", options.tasks, tiny)
        return 0
    if options.report:
        rows = kept(options.out / "segments_returns.parquet")
    else:
        rows = compare(options.out, options.tasks, options.seeds, tiny)
    shares = {}
    if not options.quick:
        for task in options.tasks:
            env, disturbance, length = TASKS[task]
            if disturbance in ("ar1-slip", "hidden"):
                shares[task] = cost(task, CHOSEN[env, length], seconds=1.5, repeats=5)
    text = table(rows, shares)
    facts = provenance(
        agent=AGENT,
        width=WIDTH,
        episodes=EPISODES,
        difference="of paired seeds, mean and 95% t interval",
        time="of a step with segments, as a share of the windows', in turns on the rover",
        settings={"rover": ROVER, "pendulum": PENDULUM},
    )
    write_results(options.out, "segments_returns", rows, text, facts)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
