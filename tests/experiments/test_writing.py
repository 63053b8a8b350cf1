"""Tests the places to which experiments write."""

import argparse
import pathlib

import pytest

from experiments.writing import QUICK, RESULTS, parse


@pytest.fixture
def parser():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover"))
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    return parser


def test_a_full_run_writes_to_the_results(parser):
    options = parse(parser, [])
    assert (options.run, options.out) == (pathlib.Path("runs/rover"), RESULTS)


def test_a_quick_run_does_not_write_to_the_results(parser):
    options = parse(parser, ["--quick"])
    assert (options.run, options.out) == (QUICK / "rover", QUICK)


def test_a_quick_run_writes_where_it_is_told(parser, tmp_path):
    options = parse(parser, ["--quick", "--out", str(tmp_path), "--run", str(tmp_path / "run")])
    assert (options.run, options.out) == (tmp_path / "run", tmp_path)


def test_a_quick_search_writes_another_table():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "search.csv")
    assert parse(parser, ["--quick"]).out == QUICK / "search.csv"


def test_a_quick_run_is_refused_in_the_results(parser, capsys):
    with pytest.raises(SystemExit):
        parse(parser, ["--quick", "--out", str(RESULTS / ".." / "results")])
    assert "choose another --out" in capsys.readouterr().err
