"""Tests that logs are read without gaps, and that every error is one line."""

import numpy as np
import pandas as pd
import pytest

from rtd3jax.envs.log import read_log
from rtd3jax.errors import UserError

NAN = float("nan")


def test_arrays_of_every_shape():
    one = np.arange(6.0)
    assert [part.shape for part in read_log(one)] == [(6, 1)]
    assert [part.shape for part in read_log(one.reshape(3, 2))] == [(3, 2)]
    parts = read_log(np.arange(12).reshape(2, 3, 2))
    np.testing.assert_array_equal(parts[1], [[6, 7], [8, 9], [10, 11]])
    assert [len(part) for part in read_log([np.zeros((4, 2)), np.ones((7, 2))])] == [4, 7]
    assert read_log([[1, 2], [3, 4]])[0].tolist() == [[1, 2], [3, 4]]
    assert read_log([1, 2, 3])[0].tolist() == [[1.0], [2.0], [3.0]]


def test_gaps_split_a_log_and_nothing_is_filled_in():
    log = np.array([[0, 0], [1, 1], [NAN, 2], [3, 3], [4, NAN], [5, 5], [6, 6]])
    assert [part[:, 0].tolist() for part in read_log(log)] == [[0, 1], [3], [5, 6]]


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_files_with_episodes(tmp_path, ending):
    frame = pd.DataFrame({"episode": [4, 4, 4, 7, 7], "left": range(5), "right": [0, 1, NAN, 3, 4]})
    path = tmp_path / f"log.{ending}"
    frame.to_csv(path, index=False) if ending == "csv" else frame.to_parquet(path)
    parts = read_log(path)
    assert [part.tolist() for part in parts] == [[[0, 0], [1, 1]], [[3, 3], [4, 4]]]
    assert [part.tolist() for part in read_log(str(path), "left")] == [[[0], [1], [2]], [[3], [4]]]
    swapped = read_log(path, ["right", "left"], episode="episode")
    assert swapped[1].tolist() == [[3, 3], [4, 4]]


def test_another_rate_is_interpolated_within_each_stretch():
    log = np.array([0.0, 1.0, 4.0, 9.0, NAN, 100.0, 101.0])
    fine = read_log(log, period=0.1, step=0.05)
    assert fine[0].ravel().tolist() == pytest.approx([0, 0.5, 1, 2.5, 4, 6.5, 9])
    assert fine[1].ravel().tolist() == pytest.approx([100, 100.5, 101])
    coarse = read_log(log[:4], period=0.1, step=0.15)
    assert coarse[0].ravel().tolist() == pytest.approx([0, 2.5, 9])
    assert read_log(log, period=0.1, step=0.1)[0].shape == (4, 1)


def test_a_multiple_of_the_period_takes_rows_as_they_are():
    log = np.random.default_rng(0).normal(size=(10, 2))
    for step in (0.3, 0.1 + 0.2):  # neither is a multiple of 0.1 in floating point
        (rows,) = read_log(log, period=0.1, step=step)
        np.testing.assert_array_equal(rows, log[::3])


@pytest.mark.parametrize(
    ("content", "arguments", "match"),
    [
        ("", {}, "is empty"),
        ("left,right\n", {}, "no row with a number in every column"),
        ("left,right\n1,\n,2\n", {}, "no row with a number in every column"),
        ("left,right\n1,n.a.!\n", {}, "column 'right' has 'n.a.!' in row 0"),
        (
            "left,right\n1,2\n",
            {"columns": ["lefd"]},
            r"'lefd'; did you mean 'left'\? \(it has: left",
        ),
        ("left,right\n1,2\n", {"episode": "run"}, r"no column 'run' \(it has: left, right\)"),
        ("episode\n1\n", {}, "no column besides the episode"),
        ("episode,a\n", {}, "has no row"),
        ("episode,a\n1,0\n2,0\n1,0\n", {}, "episode 1 continues in row 2, after rows of another"),
        ("episode,a\n1,0\n,0\n", {}, "has empty rows"),
        ("a\n1\ninf\n", {}, "is infinite in row 1"),
        ("a\n1e39\n", {}, "too large for float32"),
        ("a\nTrue\nFalse\n", {}, "column 'a' holds bool"),
        ("a\n1\n2\n", {"period": 0.1}, "pass both period="),
        ("a\n1\n2\n", {"period": 1.0, "step": 1e-9}, "turns 2 rows into 1e.09 rows"),
        ("a\n1\n2\n", {"period": 0.1, "step": 0.0}, "step must be finite and greater than zero"),
        ("a\n1\n2\n", {"period": "1", "step": 1}, "period must be a number of seconds"),
        ('a\n"1\n2', {}, "cannot be read as a table|which is not a number"),
    ],
)
def test_what_is_wrong_with_a_file_is_one_line(tmp_path, content, arguments, match):
    path = tmp_path / "log.csv"
    path.write_text(content)
    with pytest.raises(UserError, match=match) as raised:
        read_log(path, **arguments)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("log", "match"),
    [
        (np.zeros((2, 2, 2, 2)), "has shape"),
        (np.zeros((3, 0)), "no elements"),
        (np.zeros((0, 2)), "no row"),
        ([], "no row"),
        ([np.zeros((3, 2)), np.zeros((3, 1))], "different numbers of elements"),
        ("log.txt", "neither a .csv nor a .parquet"),
        ("nowhere.csv", "cannot be read"),
        (["a", "b"], "does not hold numbers"),
        (np.array([1 + 2j]), "does not hold numbers"),
        (np.array([True, False]), "does not hold numbers"),
        (None, "does not hold numbers"),
        (3.0, "has shape"),
        (object(), "does not hold numbers"),
    ],
)
def test_what_is_no_log_is_one_line(log, match):
    with pytest.raises(UserError, match=match) as raised:
        read_log(log)
    assert "\n" not in str(raised.value)


def test_files_that_are_something_else(tmp_path):
    (tmp_path / "odd.parquet").write_bytes(b"no table at all")
    (tmp_path / "odd.csv").write_bytes(bytes(range(128, 256)))
    (tmp_path / "folder.csv").mkdir()
    for name in ("odd.parquet", "odd.csv", "folder.csv"):
        with pytest.raises(UserError, match="cannot be read"):
            read_log(tmp_path / name)
    with pytest.raises(UserError, match="column 'a' holds complex128"):
        read_log(pd.DataFrame({"a": [1j, 2j]}))
    with pytest.raises(UserError, match="columns=.* is for a file or a table"):
        read_log(np.zeros((3, 2)), columns=["left"])


def test_a_column_whose_name_holds_the_word_episode():
    table = pd.DataFrame({"episode": [0, 0, 1, 1], "episode_slip": [0.1, 0.2, 0.3, 0.4]})
    lengths = [
        [len(part) for part in read_log(table, columns=columns)]
        for columns in ("episode_slip", ["episode_slip"])
    ]
    assert lengths == [[2, 2], [2, 2]]


@pytest.mark.parametrize("rows", ["left,right\n0.1,0.9,\n0.2,0.8,\n", "a\n0,1\n0,2\n"])
def test_rows_with_more_cells_than_names_are_refused(rows, tmp_path):
    """pandas would read the first cells as an index, and each column from its neighbour."""
    (tmp_path / "log.csv").write_text(rows)
    with pytest.raises(UserError, match="rows with more cells than its line of column names"):
        read_log(tmp_path / "log.csv")


def test_a_column_without_a_name_is_not_taken_for_an_element(tmp_path):
    pd.DataFrame({"left": [0.1, 0.2], "right": [0.3, 0.1]}).to_csv(tmp_path / "log.csv")
    with pytest.raises(UserError, match="column without a name.*columns="):
        read_log(tmp_path / "log.csv")
    (episode,) = read_log(tmp_path / "log.csv", columns=["left", "right"])
    np.testing.assert_array_equal(episode, [[0.1, 0.3], [0.2, 0.1]])


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("time_s", np.arange(6) * 0.02 + np.tile([0.0, 0.001], 3)),
        ("t", np.arange(6) * 0.02),
        ("header.stamp", np.arange(6) + 1.7e9),
        ("Time [ms]", [0, 20, 40, 60, NAN, 100]),
        ("row", np.arange(12)),
        ("count", np.arange(20) % 10),  # from zero in each of the two episodes
    ],
)
def test_a_column_of_times_is_no_sensor(name, values):
    noise = np.random.default_rng(0).normal(size=len(values))
    table = pd.DataFrame({name: values, "left": noise, "right": 0.1})
    if name == "count":
        table["episode"] = np.repeat([0, 1], 10)
    with pytest.raises(UserError, match=r"choose the elements with columns=\['left', 'right'\]"):
        read_log(table)
    assert read_log(table, columns=["left", "right"])[0].shape[1] == 2
    assert read_log(table, columns=[name, "left"])[0].shape[1] == 2  # named, so it is meant


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("left", np.arange(6)),  # a ramp of few rows
        ("left", np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 50))),  # with noise
        ("t", np.random.default_rng(0).normal(size=50)),  # a temperature
        ("time", np.ones(50)),
    ],
)
def test_other_columns_are_sensors(name, values):
    assert read_log(pd.DataFrame({name: values}))[0].shape == (len(values), 1)


def test_rows_in_a_list_are_not_taken_for_episodes():
    rows = [np.array([0.1 * k, 0.2]) for k in range(20)]
    for log in (rows, [row[:1] for row in rows]):
        with pytest.raises(UserError, match=r"np.stack\(log\) .* each episode as an array") as one:
            read_log(log)
        assert "\n" not in str(one.value)
    assert read_log(np.stack(rows))[0].shape == (20, 2)
    assert len(read_log([np.arange(9.0)] * 20)) == 20
    assert len(read_log([np.arange(8.0)] * 8)) == 8
    assert [part.shape for part in read_log(list(np.arange(5.0)))] == [(5, 1)]


def test_masked_values_are_gaps():
    values = np.ma.masked_greater(np.array([[0, 1], [2, 3], [9, 4], [5, 6]]), 8)
    for log in (values, [values], values.astype(np.float32)):
        assert [part.tolist() for part in read_log(log)] == [[[0, 1], [2, 3]], [[5, 6]]]
