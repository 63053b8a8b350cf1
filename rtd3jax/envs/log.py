"""Reads a recorded log as sequences of numbers without gaps."""

import math
import os
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rtd3jax.errors import UserError, nearest, short_reason
from rtd3jax.system.files import user_path

if TYPE_CHECKING:  # importing pandas takes a second
    import pandas as pd

EPISODE = "episode"
"""The column that numbers the episodes, if the caller names none."""

MOST_ROWS = 100_000_000
"""Rows of an interpolated sequence, at most: 800 MB for each element."""

SHORT = 8
"""Values of an array, at most, that may be meant as a row: more are an episode of one element."""

_TIME = re.compile(r"time|stamp|clock|(^|[^a-z])(t|s|secs?|seconds|ms|us|ns)([^a-z]|$)")
"""Names, in lower case, of columns that hold the time if their values increase."""


def read_log(
    log: object,
    columns: Sequence[str] | str | None = None,
    episode: str | None = None,
    period: float | None = None,
    step: float | None = None,
) -> list[np.ndarray]:
    """The sequences of a log without gaps, in the log's order: float64 [T, N] each.

    Args:
        log: a CSV or Parquet file, a pandas table, an array [T], [T, N] or [E, T, N] of E episodes,
            or a list of arrays [T, N], one for each episode.
        columns: columns of a file or table, one for each element of the signal, in that order; by
            default all columns except the episode's. A column of times must then be left out.
        episode: the column of a file or table that numbers the episodes: a new value begins a new
            episode. By default "episode", if there is such a column.
        period: time in s between two samples of the log, which must be equally spaced.
        step: time in s between two steps of the environment. If ``step`` is a multiple of
            ``period``, every k-th sample is taken. Otherwise the samples are interpolated linearly
            within each sequence, which makes them smoother. The samples are not smoothed before
            this, so parts of the signal with a period of less than two steps are aliased.

    A row in which any element is NaN, empty or masked is a gap. The sequences before and after a
    gap are separate, and the gap is not filled.

    Raises:
        UserError: for a file that cannot be read, missing columns, values that are not finite
            numbers, or a log without rows.
    """
    return [part for whole in read_episodes(log, columns, episode, period, step) for part in whole]


def read_episodes(
    log: object,
    columns: Sequence[str] | str | None = None,
    episode: str | None = None,
    period: float | None = None,
    step: float | None = None,
) -> list[list[np.ndarray]]:
    """The sequences of each episode without gaps; the arguments and errors of `read_log`.

    Episodes without a row with a number in every column are left out.
    """
    what = "the recording"
    if isinstance(log, str | os.PathLike):
        what = str(log)
        log = _read_table(log)
    if hasattr(log, "columns") and hasattr(log, "iloc"):
        episodes = _episodes_of_table(what, log, columns, episode)
    else:
        for name, value in (("columns", columns), ("episode", episode)):
            if value is not None:
                raise UserError(
                    f"{name}={value!r} is for a file or a table; an array has no names of columns"
                )
        episodes = _episodes_of_arrays(what, log)
    stretches = [parts for whole in episodes if (parts := _without_gaps(what, whole))]
    if not stretches:
        raise UserError(f"{what} has no row with a number in every column")
    if len({part.shape[1] for parts in stretches for part in parts}) > 1:
        raise UserError(
            f"{what} has episodes with different numbers of elements; give every episode the same"
        )
    if rows_per_step(period, step) == 1.0 or period is None or step is None:
        return stretches
    return [[_resampled(part, period, step) for part in parts] for parts in stretches]


def rows_per_step(period: float | None, step: float | None) -> float:
    """Rows of a log in one step of the environment: ``step / period``, or 1 without both.

    Raises:
        UserError: if only one of them is given, or one is not a possible number of seconds.
    """
    if (period is None) != (step is None):
        raise UserError(
            "pass both period= (of the log, in s) and step= (of the environment, in s), or neither"
        )
    if period is None or step is None:
        return 1.0
    for name, value in (("period", period), ("step", step)):
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise UserError(f"{name} must be a number of seconds, not {value!r}")
        if not 0 < value < np.inf:
            raise UserError(f"{name} must be finite and greater than zero, not {value!r}")
    rows = float(step / period)
    # 0.3 / 0.1 is not quite 3.
    return float(round(rows)) if math.isclose(rows, round(rows), rel_tol=1e-9) else rows


def _read_table(path: str | os.PathLike) -> "pd.DataFrame":
    """The table of a CSV or Parquet file."""
    import pandas as pd

    from rtd3jax.system.parquet import read_parquet

    file = user_path(path)
    kind = file.suffix.lower()
    if kind not in (".csv", ".parquet", ".pq"):
        raise UserError(f"{path} is neither a .csv nor a .parquet file: write the log as either")
    try:
        if file.is_file() and file.stat().st_size == 0:
            raise UserError(f"{path} is empty: it needs a line of column names and rows of numbers")
        if kind != ".csv":
            return read_parquet(path).to_pandas()
        with file.open("rb") as handle:
            table = pd.read_csv(handle)
        if not isinstance(table.index, pd.RangeIndex):
            raise UserError(
                f"{path} has rows with more cells than its line of column names (a comma at the "
                "end of the rows, or commas as decimal signs?): write as many cells in each"
            )
        return table
    except UserError:
        raise
    except OSError as error:
        reason = error.strerror or short_reason(error)
        raise UserError(f"{path} cannot be read ({reason})") from error
    except Exception as error:  # pandas and Arrow raise many types of errors
        raise UserError(f"{path} cannot be read as a table ({short_reason(error)})") from error


def _episodes_of_table(
    what: str, table: "pd.DataFrame", columns: Sequence[str] | str | None, episode: str | None
) -> list[np.ndarray]:
    """The columns [T, N] of each episode of a table."""
    there = [str(name) for name in table.columns]
    table = table.set_axis(there, axis="columns")
    if len(set(there)) < len(there):
        raise UserError(f"{what} has columns with equal names: {', '.join(there)}; rename them")
    chosen = [columns] if isinstance(columns, str) else columns
    may_be_time = False
    if episode is None and EPISODE in there and EPISODE not in (chosen or ()):
        episode = EPISODE
    if chosen is None:
        if any(name.startswith("Unnamed: ") for name in there):  # pandas's name for an empty header
            raise UserError(
                f"{what} has a column without a name, perhaps the numbers of the rows: choose the "
                f"elements with columns=[...] (it has: {', '.join(there)})"
            )
        chosen = [name for name in there if name != episode]
        may_be_time = True
    for name in [*chosen, *([] if episode is None else [episode])]:
        if name not in there:
            raise UserError(
                f"{what} has no column {name!r}{nearest(str(name), there)} "
                f"(it has: {', '.join(there)})"
            )
    if table.empty and chosen:
        raise UserError(f"{what} has no row with a number in every column")
    if not chosen:
        raise UserError(f"{what} has no column besides the episode's (it has: {', '.join(there)})")
    numbers = [_numbers(what, name, table[name]) for name in chosen]
    values = np.stack(numbers, axis=1)
    found = [values] if episode is None else _divided(what, values, table[episode], episode)
    if may_be_time:
        _refuse_time(what, chosen, found)
    return found


def _divided(what: str, values: np.ndarray, column: "pd.Series", episode: str) -> list[np.ndarray]:
    """The rows [T, N] of each episode, which ``column`` numbers; ``episode`` is its name."""
    labels = column.to_numpy()
    if column.isna().any():
        raise UserError(f"{what}: column {episode!r} has empty rows; give every row an episode")
    begins = [0, *(np.flatnonzero(labels[1:] != labels[:-1]) + 1)] if len(labels) else []
    seen = set()
    for place, begin in enumerate(begins):
        label = labels[begin]
        if label in seen:
            raise UserError(
                f"{what}: episode {label} continues in row {begins[place]}, after rows of another "
                f"episode; sort the rows by {episode!r}"
            )
        seen.add(label)
    return [values[a:b] for a, b in zip(begins, [*begins[1:], len(values)], strict=True)]


def _refuse_time(what: str, names: Sequence[str], episodes: Sequence[np.ndarray]) -> None:
    """Raise UserError for a column that is certainly the time or a counter, and no sensor.

    Its values increase in every row of every episode. Besides, its name says so and most steps are
    nearly equal, or all steps of a longer log are equal.
    """
    for place, name in enumerate(names):
        columns = [rows[:, place] for rows in episodes]
        steps = np.concatenate([np.diff(column[np.isfinite(column)]) for column in columns])
        if steps.size < 2 or np.min(steps) <= 0.0:
            continue
        regular = np.mean(np.abs(steps / np.median(steps) - 1.0) < 0.5) > 0.5
        equal = steps.size > SHORT and np.ptp(steps) <= 1e-6 * np.mean(steps)
        if equal or (regular and _TIME.search(name.lower())):
            others = [other for other in names if other != name]
            raise UserError(
                f"{what}: column {name!r} increases by {np.median(steps):.4g} in every row, like "
                f"the time or a counter: choose the elements with columns={others or [name]!r}"
            )


def _numbers(what: str, name: str, column: "pd.Series") -> np.ndarray:
    """A column as float64 [T]; empty cells become NaN."""
    import pandas as pd

    kind = column.dtype
    if getattr(kind, "kind", "O") in "bcmM":  # booleans, complex numbers, times
        raise UserError(
            f"{what}: column {name!r} holds {kind}, not numbers; exclude it with columns=[...]"
        )
    numbers = pd.to_numeric(column, errors="coerce")
    odd = np.flatnonzero(numbers.isna().to_numpy() & column.notna().to_numpy())
    if odd.size:
        raise UserError(
            f"{what}: column {name!r} has {column.iloc[odd[0]]!r} in row {odd[0]}, which is not "
            "a number; leave the cells of a gap empty, or choose other columns with columns=[...]"
        )
    return numbers.to_numpy(np.float64, na_value=np.nan)


def _episodes_of_arrays(what: str, log: object) -> list[np.ndarray]:
    """The arrays [T, N] of the episodes in an array or in a list of arrays."""
    # As in numpy, a list of lists is a list of rows; a list of arrays is a list of episodes.
    if isinstance(log, list | tuple) and any(getattr(p, "shape", ()) for p in log):
        _refuse_rows(what, log)
        return [one for part in log for one in _episodes_of_arrays(what, _array(what, part))]
    array = _array(what, log)
    if array.ndim == 1:
        array = array[:, None]
    if array.ndim not in (2, 3):
        raise UserError(
            f"{what} has shape {array.shape}; pass [T], [T, N], [E, T, N], or a list of [T, N]"
        )
    if array.shape[-1] == 0:
        raise UserError(f"{what} has no elements: its shape is {array.shape}")
    return [array] if array.ndim == 2 else list(array)


def _refuse_rows(what: str, log: Sequence[object]) -> None:
    """Raise UserError for a list of short arrays [N], which may be rows or episodes."""
    shapes: list[tuple[int, ...]] = [getattr(part, "shape", ()) for part in log]
    if any(len(shape) != 1 for shape in shapes):
        return
    longest = max(shape[0] for shape in shapes)
    if 0 < longest <= SHORT and longest < len(log):
        raise UserError(
            f"{what} is a list of {len(log):,} arrays of {longest} value{'s' * (longest > 1)}, "
            "which may be rows or episodes: pass np.stack(log) if each is a row, or give each "
            "episode as an array [T, N]"
        )


def _array(what: str, values: object) -> np.ndarray:
    try:
        if isinstance(values, np.ma.MaskedArray):
            if values.dtype.kind not in "iuf":
                raise TypeError
            return np.where(np.ma.getmaskarray(values), np.nan, values.data.astype(np.float64))
        array = np.asarray(values)
        if array.dtype.kind not in "iuf" and not _is_narrow_float(array):
            raise TypeError
        return array.astype(np.float64)
    except (TypeError, ValueError):
        raise UserError(
            f"{what} does not hold numbers: pass a CSV or Parquet file, a pandas table, or an "
            f"array of floats, not {type(values).__name__}"
        ) from None


def _is_narrow_float(array: np.ndarray) -> bool:
    """Whether the type is bfloat16 or similar, which numpy classifies as void."""
    return array.dtype.name.startswith(("bfloat", "float"))


def _without_gaps(what: str, values: np.ndarray) -> list[np.ndarray]:
    """The sequences of [T, N] between rows with NaN."""
    most = float(np.finfo(np.float32).max)
    if np.any(np.abs(values) > most):
        row = int(np.flatnonzero(np.any(np.abs(values) > most, axis=1))[0])
        raise UserError(
            f"{what} is infinite in row {row} of an episode, or too large for float32; "
            "leave this row empty"
        )
    whole = ~np.any(np.isnan(values), axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], whole, [False]]).astype(np.int8)))
    return [values[a:b] for a, b in edges.reshape(-1, 2)]


def _resampled(part: np.ndarray, period: float, step: float) -> np.ndarray:
    """A sequence [T, N] at the steps of the environment: every k-th row, or interpolated."""
    every = rows_per_step(period, step)
    if every.is_integer():
        return part[:: int(every)]
    rows = (len(part) - 1) * period / step
    if rows >= MOST_ROWS:
        raise UserError(
            f"step={step} turns {len(part):,} rows into {rows:.3g} rows; check that period and "
            "step are in s"
        )
    have = period * np.arange(len(part))
    # A rounding error must not exclude the last sample.
    want = step * np.arange(int(np.floor(have[-1] / step + 1e-9)) + 1)
    columns = [np.interp(want, have, part[:, k]) for k in range(part.shape[1])]
    return np.stack(columns, axis=1)
