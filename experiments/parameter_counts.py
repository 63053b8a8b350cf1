"""Counts the parameters of networks, for the paper's table.

Usage: python experiments/parameter_counts.py [--quick] [--out DIR]

The script writes parameter_counts.md and .parquet, for observations of 3 elements, actions of 1
element, and width 128.
"""

import argparse
import pathlib
import sys

import pandas as pd

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

PAPER = {
    "td3": (17_153, 17_281),
    "lstm-td3": (166_273, 166_401),
    "lstm-td3-1ha1hc": (149_377, 149_377),
    "lstm-td3-1ha2hc": (149_377, 166_017),
    "h-td3": (149_377, 149_377),
}


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="not to the results")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    rows = []
    for algorithm in rtd.ALGORITHMS:
        counts = rtd.count_parameters(algorithm, obs_dim=3, act_dim=1)
        actor, critic = PAPER.get(algorithm, (None, None))
        rows.append(
            {"algorithm": algorithm, **counts, "paper_actor": actor, "paper_critic": critic}
        )

    def number(value: int | None) -> str:
        return "–" if value is None else f"{value:,}"

    text = markdown_table(
        ["agent", "actor", "critic", "paper's actor", "paper's critic"],
        [[row["algorithm"], *map(number, list(row.values())[1:])] for row in rows],
    )
    write_results(options.out, "parameter_counts", pd.DataFrame(rows), text, provenance())
    print(text)


if __name__ == "__main__":
    main()
