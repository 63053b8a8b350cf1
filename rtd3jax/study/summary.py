"""The summary of a study as Markdown."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rtd3jax.study.results import CELL, is_trained, reference_names
from rtd3jax.study.statistics import Summary, seed_means, summarise

MISSING = "missing"


def summary_markdown(
    config_lines: Mapping[str, object],
    seeds: Mapping[tuple, Sequence[int]],
    episodes: pd.DataFrame,
    failures: Sequence[Mapping],
    ceilings: Mapping[tuple[str, str], Mapping[str, Any]] | None = None,
) -> str:
    """Summarise a study.

    ``config_lines`` maps names of settings to values, in the order of the summary. ``seeds`` are
    the seeds of each cell (env, disturbance, algorithm, history length) of the study. ``episodes``
    has the columns of EPISODES. Each of ``failures`` has the entries env, disturbance, algorithm,
    history_length, seed, step and reason. ``ceilings`` are the known ceilings of
    `rtd3jax.study.ceilings`.

    Every cell of the study gets a row, so a cell whose seeds were all lost is visible.
    """
    lanes = seed_means(episodes)
    lines = ["# Study summary", "", "## Configuration", ""]
    lines += [f"- {_cell_text(name)}: {_cell_text(value)}" for name, value in config_lines.items()]
    lines += ["", "## Final returns", ""]
    lines += [
        "Over seeds: mean ± standard deviation, and the interquartile mean (IQM) with its 95 % "
        "bootstrap interval. Seeds are finished / planned. Best IQM first. Reference policies "
        "are not trained; their deviation is over episodes. The ceiling is the best possible mean, "
        "or an upper bound of it, with its standard error.",
        "",
    ]
    tasks = {cell[:2] for cell in seeds}
    tasks |= set(zip(lanes["env"], lanes["disturbance"], strict=True))
    for task in sorted(tasks):
        lines += _task_section(task, seeds, lanes, episodes, (ceilings or {}).get(task, {}))
    if not tasks:
        lines += ["No results.", ""]
    lines += ["## Lanes lost", ""] + _failure_lines(failures)
    if diverged := _diverged_lines(episodes[is_trained(episodes)]):
        lines += ["", "## Lanes without a mean return", "", *diverged]
    return "\n".join(lines) + "\n"


def _task_section(
    task: tuple[str, str],
    seeds: Mapping[tuple, Sequence[int]],
    lanes: pd.DataFrame,
    episodes: pd.DataFrame,
    best: Mapping[str, Any],
) -> list[str]:
    """Heading and table of one (env, disturbance)."""
    of_task = _select(lanes, task)
    # The returns are equal if the reward is not computed from disturbed quantities.
    differs = not np.allclose(of_task["return"], of_task["true_return"], equal_nan=True)
    header = ["algorithm", "l", "seeds", "mean ± std", "IQM [low, high]"]
    header += ["true-state return"] if differs else []
    lines = [f"### {_cell_text(task[0])}, {_cell_text(task[1])}", ""]
    lines += [
        markdown_row(header),
        markdown_row(["---", "---:", "---:", "---:", "---:", "---:"][: len(header)]),
    ]

    rows = []
    for cell, planned in seeds.items():
        if cell[:2] != task:
            continue
        _, _, algorithm, length = cell
        chosen = of_task["algorithm"].eq(algorithm) & of_task["history_length"].eq(length)
        summary = summarise(of_task.loc[chosen, "return"])
        true = summarise(of_task.loc[chosen, "true_return"])
        finished = f"{summary.n} / {len(planned)}"
        if summary.n == 0:
            entries = [algorithm, length, finished, MISSING, MISSING]
        else:
            entries = [algorithm, length, finished, _spread(summary), _interval(summary)]
        entries += [_spread(true) if true.n else MISSING] if differs else []
        order = (summary.n == 0, -summary.iqm if summary.n else 0.0, algorithm, length)
        rows.append((order, entries))
    lines += [markdown_row(entries) for _, entries in sorted(rows, key=lambda row: row[0])]

    references = _select(episodes, task)
    references = references[~is_trained(references)]
    for name in reference_names(references):
        played = references[references["algorithm"] == name]
        entries = [f"{name} (reference)", "–", "–", _over_episodes(played["return"]), "–"]
        entries += [_over_episodes(played["true_return"])] if differs else []
        lines.append(markdown_row(entries))
    if best.get("mean") is not None:
        name = "ceiling" if best["kind"] == "exact" else "ceiling (an upper bound)"
        error = f" ± {number(best['error'])}" if best["error"] else ""
        value = f"{number(best['mean'])}{error}"
        of_truth = differs and best["measure"] == "true_return"
        entries = [name, "–", "–", "–" if of_truth else value, "–"]
        entries += [value if of_truth else "–"] if differs else []
        lines.append(markdown_row(entries))
    return [*lines, ""]


def _failure_lines(failures: Sequence[Mapping]) -> list[str]:
    """One list item per failed lane, in the order of cells."""
    if not failures:
        return ["none"]
    lines = []
    for failure in failures:
        lane = _lane_text(*(failure.get(name, "?") for name in (*CELL, "seed")))
        step = _cell_text(failure.get("step", "?"))
        reason = _cell_text(failure.get("reason", "reason unknown"))
        lines.append(f"- {lane}, step {step}: {reason}")
    return sorted(lines)


def _diverged_lines(episodes: pd.DataFrame) -> list[str]:
    """One list item per trained lane with final episodes whose return is not a number."""
    lines = []
    for lane, rows in episodes.groupby([*CELL, "seed"]):
        if without := _without_number(rows["return"]):
            lines.append(
                f"- {_lane_text(*lane)}: {without} of {len(rows)} final episodes have a return "
                "that is not finite, so the lane is left out of the table"
            )
    return lines


def _lane_text(
    env: object, disturbance: object, algorithm: object, length: object, seed: object
) -> str:
    """A lane in words, for the lists below the tables."""
    parts = (env, disturbance, algorithm, f"l = {length}", f"seed {seed}")
    return ", ".join(map(_cell_text, parts))


def _over_episodes(returns: pd.Series) -> str:
    """The returns of a reference; a mean without its diverged episodes would be too high."""
    if without := _without_number(returns):
        return f"{without} of {len(returns)} episodes diverged"
    return _spread(summarise(returns))


def _without_number(returns: pd.Series) -> int:
    return int((~np.isfinite(returns.astype(np.float64))).sum())


def _select(table: pd.DataFrame, task: tuple[str, str]) -> pd.DataFrame:
    return table[table["env"].eq(task[0]) & table["disturbance"].eq(task[1])]


def _spread(summary: Summary) -> str:
    if summary.n == 0:
        return MISSING
    if math.isnan(summary.std):
        return number(summary.mean)
    return f"{number(summary.mean)} ± {number(summary.std)}"


def _interval(summary: Summary) -> str:
    if math.isnan(summary.iqm_low):
        return number(summary.iqm)
    return f"{number(summary.iqm)} [{number(summary.iqm_low)}, {number(summary.iqm_high)}]"


def number(value: float) -> str:
    """A number as text: one decimal from 100 to a million, else four significant digits."""
    if 100 <= abs(value) < 1e6:
        return f"{value:.1f}"
    return f"{value:.4g}"


def markdown_row(entries: Sequence[object]) -> str:
    """A row of a Markdown table."""
    return "| " + " | ".join(_cell_text(entry) for entry in entries) + " |"


def _cell_text(value: object) -> str:
    """Text on one line that cannot end a table cell."""
    return " ".join(str(value).split()).replace("|", "\\|")
