"""Tidy result tables and their Parquet files.

A table is a list of dict rows or a ``pyarrow.Table``; each file holds a table of one of the schemas
below. Files are replaced atomically. Their content depends on the set of rows, but not on the order
in which lanes ended.
"""

import io
import math
import os
from collections.abc import Iterable, Mapping
from typing import SupportsFloat

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from rtd3jax.errors import UserError
from rtd3jax.system.files import user_path, write_bytes_atomically
from rtd3jax.system.parquet import read_parquet

# Reference policies need no training: uniform random, and the baselines of the environment. Their
# EPISODES rows have history_length 0 and this seed, because neither has a meaning for them.
REFERENCE_SEED = -1

LANE = "lane"
"""The column of later tests (transfer, robustness) with the digest of the tested lane's file."""

# What identifies one experimental cell; a cell plus a seed is one training lane.
CELL = ("env", "disturbance", "algorithm", "history_length")


_LANE = [
    pa.field("env", pa.string(), nullable=False),
    pa.field("disturbance", pa.string(), nullable=False),
    pa.field("algorithm", pa.string(), nullable=False),
    pa.field("history_length", pa.int32(), nullable=False),
    pa.field("seed", pa.int64(), nullable=False),
]


def _schema(index: pa.Field) -> pa.Schema:
    """Schema with the lane columns, one ``index`` column inside the lane, and the returns."""
    return pa.schema(
        [
            *_LANE,
            index,
            # Undiscounted sums of rewards over an episode, in the environment's reward units:
            # as rewarded to the agent, and as computed from the undisturbed state.
            pa.field("return", pa.float32(), nullable=False),
            pa.field("true_return", pa.float32(), nullable=False),
        ]
    )


# Learning curves: one row per lane and evaluation; ``step`` counts environment steps.
CURVES = _schema(pa.field("step", pa.int64(), nullable=False))
# Final evaluation: one row per lane and evaluation episode, numbered from 0.
EPISODES = _schema(pa.field("episode", pa.int32(), nullable=False))
# Metrics of learning: a row per lane, evaluation and metric, averaged since the last evaluation.
METRICS = pa.schema(
    [
        *_LANE,
        pa.field("step", pa.int64(), nullable=False),
        pa.field("metric", pa.string(), nullable=False),
        pa.field("value", pa.float32(), nullable=False),
    ]
)


def key_columns(schema: pa.Schema) -> list[str]:
    """Names of the columns that identify a row: all except the floating-point measurements."""
    return [field.name for field in schema if not pa.types.is_floating(field.type)]


def write_table(
    path: str | os.PathLike, rows: Iterable[Mapping] | pa.Table, schema: pa.Schema
) -> None:
    """Write ``rows`` (dicts or a Table, one entry per column of ``schema``) to a Parquet file.

    Rows are sorted by ``key_columns(schema)``. A missing measurement is NaN, never None.

    Raises:
        UserError: when rows do not fit the schema, an entry is None, or two rows have equal keys:
            their order would not be reproducible.
    """
    table = _as_table(rows, schema)
    for name in schema.names:
        if table[name].null_count:
            raise UserError(f"column {name!r} of {path} has missing entries; write NaN for floats")
    keys = key_columns(schema)
    if table.num_rows:
        table = table.sort_by([(name, "ascending") for name in keys])
        if table.select(keys).group_by(keys).aggregate([]).num_rows != table.num_rows:
            raise UserError(f"rows for {path} repeat the same {', '.join(keys)}")
    buffer = io.BytesIO()
    # One chunk and explicit options, so that equal rows give equal bytes.
    pq.write_table(
        table.combine_chunks(), buffer, compression="zstd", write_page_checksum=True, version="2.6"
    )
    write_bytes_atomically(path, buffer.getvalue())


def frame(rows: Iterable[Mapping], schema: pa.Schema) -> pd.DataFrame:
    """A DataFrame as `read_table` returns it, [rows, columns], of rows in memory."""
    return _as_table(rows, schema).to_pandas()


def read_table(path: str | os.PathLike, schema: pa.Schema | None = None) -> pd.DataFrame:
    """Read a file of ``write_table`` as a DataFrame [rows, columns].

    Without ``schema`` the file may be any of this module's tables.

    Raises:
        UserError: when the file is missing, cannot be read as Parquet, or has other columns.
    """
    path = user_path(path)
    if not path.is_file():
        raise UserError(f"no results table at {path}")
    table = read_parquet(path)
    expected = [CURVES, EPISODES, METRICS] if schema is None else [schema]
    if not any(table.schema.equals(candidate) for candidate in expected):
        wanted = " or ".join(_describe(candidate) for candidate in expected)
        raise UserError(f"{path} has columns {_describe(table.schema)}; expected {wanted}")
    return table.to_pandas()


def _as_table(rows: Iterable[Mapping] | pa.Table, schema: pa.Schema) -> pa.Table:
    """``rows`` as a Table with exactly the columns, types and order of ``schema``."""
    try:
        if isinstance(rows, pa.Table):
            _check_names(rows.column_names, schema)
            return rows.select(schema.names).cast(schema)
        rows = list(rows)
        for row in rows:
            _check_names(row, schema)
        # Column by column rather than Table.from_pylist, which would turn a misspelt column
        # into nulls and does not take zero-dimensional arrays.
        columns = [
            pa.array([_scalar(row[field.name]) for row in rows], field.type) for field in schema
        ]
        return pa.Table.from_arrays(columns, schema=schema)
    except (pa.ArrowException, OverflowError, TypeError) as error:
        raise UserError(f"rows do not fit the columns {_describe(schema)}: {error}") from error


def _check_names(names: Iterable[str], schema: pa.Schema) -> None:
    names = list(names)
    if sorted(names) != sorted(schema.names):
        raise UserError(f"a row has columns {names}; expected {schema.names}")


def _scalar(value):
    """A plain Python value from a NumPy or JAX scalar; other values unchanged."""
    if isinstance(value, str | int | float) and not isinstance(value, np.generic):
        return value
    return value.item() if hasattr(value, "item") else value


def _describe(schema: pa.Schema) -> str:
    return "(" + ", ".join(f"{field.name} {field.type}" for field in schema) + ")"


def is_trained(table: pd.DataFrame) -> pd.Series:
    """Which rows of EPISODES belong to trained agents, not to references: bool [rows]."""
    return table["seed"] >= 0


def reference_names(table: pd.DataFrame) -> list[str]:
    """Names of the references in EPISODES: random first, then alphabetically."""
    names = set(table.loc[~is_trained(table), "algorithm"])
    return sorted(names, key=lambda name: (name != "random", name))


def rounded_number(value: SupportsFloat) -> float | None:
    """A number for JSON, with five significant digits; None for infinity and NaN."""
    value = float(value)
    return float(f"{value:.5g}") if math.isfinite(value) else None
