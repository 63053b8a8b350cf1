"""Computes how many lanes fit in memory, and the time of ten thousand lanes.

Usage: python experiments/sizing.py [--quick] [--out DIR]

The bytes are those of the memory plan (`rtd3jax.study.memory_plan`), and the seed-steps per second
are those of the benchmark (results/benchmarks/measurements.csv). The script writes sizing.md and
.parquet.
"""

import argparse
import pathlib
import sys

import pandas as pd

from rtd3jax.study.cells import Grid, cell_jobs, make_cells
from rtd3jax.study.memory_plan import job_bytes, lanes_at_once

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

AGENTS = ("td3", "h-td3", "lstm-td3-1ha1hc", "lstm-td3")
LENGTHS = (1, 10, 20)
REPLAYS = (100_000, 1_000_000)
GIB = 2**30
MEMORY = {"map": 24 * GIB, "vmap": 80 * GIB}
"""Bytes of memory, by strategy: a machine with two cores (`map`), and an accelerator (`vmap`)."""
LANES, STEPS = 10_000, 100_000
MACHINES = (1, 10, 100)


def measured(bench: pathlib.Path) -> tuple[pd.Series, str]:
    """Median seed-steps per second by agent and length, and the name of the machine."""
    table = pd.read_csv(bench)
    ours = table[table["measurement"] == "rtd3jax float32"]
    rates = ours.groupby(["agent", "history_length"])["value"].median()
    return rates, str(table["machine"].iloc[0])


def rows_of(rates: pd.Series) -> list[dict]:
    """A row per agent, length and replay."""
    rows = []
    for agent in AGENTS:
        for length in LENGTHS if agent != "td3" else (0,):
            for replay in REPLAYS:
                grid = Grid("rover", ("ar1-slip",), (agent,), (length or 1,))
                cells = make_cells([grid], {"replay_capacity": replay, "total_steps": STEPS})
                fit = {s: cell_jobs(cells, range(1), s) for s in MEMORY}
                state, working = next(iter(job_bytes(fit["map"]).values()))
                rate = rates.get((agent, length))
                rows.append(
                    {
                        "agent": agent,
                        "history_length": length,
                        "replay": replay,
                        "mib_kept": state / 2**20,
                        "mib_working": working / 2**20,
                        "lanes_in_24_gib_map": lanes_at_once(fit["map"], "map", 2, MEMORY["map"]),
                        "lanes_in_80_gib_vmap": lanes_at_once(
                            fit["vmap"], "vmap", 1, MEMORY["vmap"]
                        ),
                        **{
                            f"hours_on_{count}": None
                            if rate is None
                            else LANES * STEPS / rate / count / 3600
                            for count in MACHINES
                        },
                    }
                )
    return rows


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="not to the results")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    bench = RESULTS / "benchmarks" / "measurements.csv"
    rates, machine = (pd.Series(dtype=float), "none yet") if not bench.exists() else measured(bench)
    rows = rows_of(rates)

    def number(value: float | None, places: int = 0) -> str:
        return "–" if value is None else f"{value:,.{places}f}"

    header = ["agent", "l", "replay", "MiB kept", "MiB working", "lanes in 24 GiB (`map`)"]
    header += ["lanes in 80 GiB (`vmap`)", *(f"hours on {count}" for count in MACHINES)]
    text = markdown_table(
        header,
        [
            [
                row["agent"],
                str(row["history_length"] or "–"),
                number(row["replay"]),
                number(row["mib_kept"], 1),
                number(row["mib_working"], 1),
                number(row["lanes_in_24_gib_map"]),
                number(row["lanes_in_80_gib_vmap"]),
                *(number(row[f"hours_on_{count}"], 1) for count in MACHINES),
            ]
            for row in rows
        ],
    )
    facts = provenance(
        hours=f"computed: {LANES:,} lanes of {STEPS:,} steps, on that many of the measured machine",
        measured_on=machine,
        lanes="computed from the memory plan",
    )
    write_results(options.out, "sizing", pd.DataFrame(rows), text, facts)
    print(text)


if __name__ == "__main__":
    main()
