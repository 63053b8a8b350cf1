"""Tests of the Parquet tables."""

import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rtd3jax.errors import UserError
from rtd3jax.study.results import CURVES, EPISODES, key_columns, read_table, write_table


def curve_row(seed=0, step=0, value=1.5, **changes):
    row = {
        "env": "pendulum",
        "disturbance": "none",
        "algorithm": "td3",
        "history_length": 0,
        "seed": seed,
        "step": step,
        "return": value,
        "true_return": value,
    }
    return {**row, **changes}


def test_rows_come_back_as_written(tmp_path):
    rows = [curve_row(seed=0, step=10, value=-2.5), curve_row(seed=1, step=10, value=4.0)]
    write_table(tmp_path / "curves.parquet", rows, CURVES)
    assert read_table(tmp_path / "curves.parquet").to_dict("records") == rows


def test_a_table_is_accepted_with_its_columns_in_any_order(tmp_path):
    rows = [curve_row(seed=3)]
    table = pa.Table.from_pylist(rows)
    write_table(tmp_path / "t.parquet", table.select(table.column_names[::-1]), CURVES)
    assert read_table(tmp_path / "t.parquet").to_dict("records") == rows


def test_the_file_has_exactly_the_schema(tmp_path):
    write_table(tmp_path / "t.parquet", [curve_row()], CURVES)
    assert pq.read_schema(tmp_path / "t.parquet").equals(CURVES)


def test_array_scalars_are_accepted(tmp_path):
    row = curve_row(seed=np.int32(2), value=np.array(0.5, np.float32), step=np.int64(7))
    write_table(tmp_path / "t.parquet", [row], CURVES)
    assert read_table(tmp_path / "t.parquet")["return"].tolist() == [0.5]


def test_an_empty_table_keeps_its_columns(tmp_path):
    write_table(tmp_path / "t.parquet", [], EPISODES)
    assert list(read_table(tmp_path / "t.parquet").columns) == EPISODES.names


def test_nan_returns_survive(tmp_path):
    write_table(tmp_path / "t.parquet", [curve_row(value=float("nan"))], CURVES)
    assert read_table(tmp_path / "t.parquet")["return"].isna().tolist() == [True]


def test_keys_are_the_columns_that_are_not_measurements():
    lane = ["env", "disturbance", "algorithm", "history_length", "seed"]
    assert key_columns(CURVES) == [*lane, "step"]


def test_rows_are_sorted_by_their_keys_as_numbers(tmp_path):
    rows = [curve_row(seed=seed, step=step) for seed in (10, 9) for step in (100, 20)]
    write_table(tmp_path / "t.parquet", rows, CURVES)
    table = read_table(tmp_path / "t.parquet")
    got = list(zip(table["seed"], table["step"], strict=True))
    assert got == [(9, 20), (9, 100), (10, 20), (10, 100)]


def test_the_order_of_completion_does_not_change_a_byte(tmp_path):
    rows = [curve_row(seed=seed, step=step, value=seed) for seed in range(5) for step in range(9)]
    write_table(tmp_path / "a.parquet", rows, CURVES)
    shuffled = [rows[i] for i in np.random.default_rng(0).permutation(len(rows))]
    write_table(tmp_path / "b.parquet", shuffled, CURVES)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_a_chunked_table_gives_the_same_bytes_as_rows(tmp_path):
    rows = [curve_row(seed=seed) for seed in range(6)]
    chunks = pa.concat_tables([pa.Table.from_pylist([row]) for row in rows])
    write_table(tmp_path / "a.parquet", rows, CURVES)
    write_table(tmp_path / "b.parquet", chunks, CURVES)
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_repeated_keys_are_refused(tmp_path):
    with pytest.raises(UserError, match="repeat"):
        write_table(tmp_path / "t.parquet", [curve_row(value=1), curve_row(value=2)], CURVES)


@pytest.mark.parametrize(
    "row",
    [
        {key: value for key, value in curve_row().items() if key != "step"},
        curve_row(extra=1),
        curve_row(seed="first"),
        curve_row(history_length=2**40),
        curve_row(algorithm=None),
        curve_row(value=None),
    ],
    ids=["column missing", "column unknown", "text seed", "too large", "no key", "no value"],
)
def test_rows_that_do_not_fit_are_refused(tmp_path, row):
    with pytest.raises(UserError):
        write_table(tmp_path / "t.parquet", [row], CURVES)


@pytest.mark.parametrize("broken", ["fsync", "replace"])
def test_an_interrupted_write_leaves_the_old_file(tmp_path, monkeypatch, broken):
    path = tmp_path / "t.parquet"
    write_table(path, [curve_row(value=1.0)], CURVES)
    before = path.read_bytes()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, broken, interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_table(path, [curve_row(value=2.0)], CURVES)
    assert path.read_bytes() == before


def test_an_interrupted_write_leaves_no_temporary_file(tmp_path, monkeypatch):
    def interrupt(*_):
        raise OSError("disk full")

    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(OSError):
        write_table(tmp_path / "t.parquet", [curve_row()], CURVES)
    assert list(tmp_path.iterdir()) == []


def test_contents_reach_the_disk_before_the_name(tmp_path, monkeypatch):
    calls = []
    fsync, replace = os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda fd: (calls.append("fsync"), fsync(fd)))
    monkeypatch.setattr(os, "replace", lambda a, b: (calls.append("replace"), replace(a, b)))
    write_table(tmp_path / "t.parquet", [curve_row()], CURVES)
    assert calls[:2] == ["fsync", "replace"]


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(UserError, match="gone.parquet"):
        read_table(tmp_path / "gone.parquet")


def test_a_file_that_is_not_parquet_is_refused(tmp_path):
    (tmp_path / "t.parquet").write_bytes(b"not a table at all")
    with pytest.raises(UserError, match="cannot be read as a Parquet file"):
        read_table(tmp_path / "t.parquet")


def test_a_truncated_file_is_refused(tmp_path):
    path = tmp_path / "t.parquet"
    write_table(path, [curve_row()], CURVES)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(UserError):
        read_table(path)


def test_damage_inside_the_data_is_noticed(tmp_path):
    path = tmp_path / "t.parquet"
    # Incompressible values, so that the middle of the file is their page.
    values = np.random.default_rng(0).normal(size=2_000)
    write_table(path, [curve_row(step=i, value=v) for i, v in enumerate(values)], CURVES)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(UserError):
        read_table(path)


def test_other_columns_are_refused(tmp_path):
    pq.write_table(pa.table({"env": ["pendulum"], "loss": [1.0]}), tmp_path / "t.parquet")
    with pytest.raises(UserError, match="loss"):
        read_table(tmp_path / "t.parquet")


def test_the_wrong_one_of_our_tables_is_refused_when_a_schema_is_given(tmp_path):
    write_table(tmp_path / "t.parquet", [curve_row()], CURVES)
    with pytest.raises(UserError, match="episode"):
        read_table(tmp_path / "t.parquet", EPISODES)
