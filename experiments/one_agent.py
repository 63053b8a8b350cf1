"""One agent, trained once, under structured disturbances and under noise, with five seeds.

Usage: python experiments/one_agent.py [--quick] [--run DIR] [--seeds N] [--out DIR] [--report]
                                       [--agents A ...]

The script trains the agent of `--preset robust`, whose critics read the undisturbed observation, or
other agents with the same settings. Each episode of the training draws its disturbance from a
mixture. Policies are tested in 1,000 episodes of each condition, some of which are not in the
mixture. The script writes one_agent.md, .parquet and .json. If you repeat the command, it only
trains what is missing; `--report` trains nothing, and without the run directory it reads the table
again.

Returns are normalised: 0 is the uniform random policy, 1 the fully observed optimum. Under noise,
they are also divided by the return of a Bayes filter that knows the process
(experiments/filter_reference.py).
"""

import argparse
import pathlib
import sys
from typing import Any

import pandas as pd

import rtd3jax as rtd
from rtd3jax.study import presets
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.transfer import transfer

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from one_agent_search import NOISY, STRUCTURED, reference  # noqa: E402
from pendulum import normalised  # noqa: E402
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

AGENTS = (presets.ROBUST_AGENT,)
EPISODES, SEEDS = 1_000, 5
CONDITIONS = (*STRUCTURED, *NOISY)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/one_agent"))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--agents", nargs="+", default=list(AGENTS))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--report", action="store_true", help="train nothing")
    options = parse(parser, arguments)
    fields, episodes = dict(presets.ROBUST_SETTINGS), EPISODES
    length, conditions = presets.ROBUST_HISTORY_LENGTH, CONDITIONS
    if options.quick:
        fields |= {"total_steps": 240, "hidden_size": 4, "learning_starts": 100, "eval_every": 240}
        fields |= {"batch_size": 10, "eval_episodes": 1}
        options.seeds, episodes, length = 1, 2, 3
        conditions = CONDITIONS[0], CONDITIONS[-1]
    cells = [
        rtd.Cell(
            "pendulum",
            presets.ROBUST_DISTURBANCE,
            rtd.Config(agent, length, **fields),
        )
        for agent in options.agents
    ]
    if not options.report:
        study = rtd.Study(cells, seeds=range(options.seeds), out=options.run)
        lost = study.run(quiet=options.quick, page=not options.quick)
        print(*lost, sep="\n", file=sys.stderr)
    known_lanes = options.out / "one_agent.parquet"
    if options.report and known_lanes.exists() and not options.run.exists():
        lanes = pd.read_parquet(known_lanes)  # the filter's returns may have changed since
    else:
        returns = transfer(RunDirectory.open(options.run), conditions, episodes, write=False)
        lane = ["algorithm", "tested_on", "seed"]
        lanes = returns.groupby(lane, as_index=False)["true_return"].mean()
        lanes["normalised"] = normalised(lanes, "tested_on")
    known = lanes["tested_on"].map(reference())  # NaN without noise
    lanes["of_the_filter"] = lanes["normalised"] / known
    text = table(lanes)
    facts: dict[str, Any] = provenance(
        trained_on=presets.ROBUST_DISTURBANCE,
        history_length=length,
        settings=fields,
        seeds=lanes.groupby("algorithm")["seed"].nunique().to_dict(),
        episodes=episodes,
    )
    write_results(options.out, "one_agent", lanes, text, facts)
    print(text)
    return 0


def table(lanes: pd.DataFrame) -> str:
    """Mean ± std over seeds for each condition and agent, and the worst of each kind."""

    def cell(values: pd.Series) -> str:
        spread = f" ± {values.std():.3f}" if len(values) > 1 else ""
        return f"{values.mean():.3f}{spread} (worst {values.min():.3f})"

    agents = list(dict.fromkeys(lanes["algorithm"]))
    body = []
    for condition in (name for name in CONDITIONS if name in set(lanes["tested_on"])):
        own = lanes[lanes["tested_on"] == condition]
        column = "of_the_filter" if condition in NOISY else "normalised"
        what = f"{condition}, of the filter's return" if condition in NOISY else condition
        body.append([what, *(cell(own[own["algorithm"] == a][column]) for a in agents)])
    structured = lanes[lanes["tested_on"].isin(STRUCTURED)]
    worst = structured.groupby(["algorithm", "seed"])["normalised"].min()
    body.append(["the worst structured condition of each seed", *(cell(worst[a]) for a in agents)])
    return markdown_table(["tested on", *agents], body)


if __name__ == "__main__":
    sys.exit(main())
