"""Tests the places to which experiments write."""

import argparse
import pathlib
import re

import pytest

from experiments.writing import QUICK, RESULTS, parse

ROOT = RESULTS.parent


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


def test_the_study_of_a_quick_run_is_where_its_results_are(parser, tmp_path):
    assert parse(parser, ["--quick", "--out", str(tmp_path)]).run == tmp_path / "rover"


def test_a_quick_search_writes_another_table():
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS / "search.csv")
    assert parse(parser, ["--quick"]).out == QUICK / "search.csv"


@pytest.mark.parametrize(
    "given", [["--out", RESULTS], ["--out", RESULTS / "benchmarks"], ["--run", "runs/rover"]]
)
def test_a_quick_run_is_refused_in_the_places_of_full_runs(parser, given, capsys):
    with pytest.raises(SystemExit):
        parse(parser, ["--quick", *map(str, given)])
    assert f"choose another {given[0]}" in capsys.readouterr().err


def test_every_script_that_can_be_quick_obeys():
    scripts = [path for path in ROOT.rglob("*.py") if '"--quick"' in path.read_text()]
    writing = [path for path in scripts if re.search(r'"--(out|run)".*default=', path.read_text())]
    assert len(writing) > 20
    careless = [path.name for path in writing if "parse(parser, arguments" not in path.read_text()]
    assert careless == ["from_a_log.py"], "its places are not those of a full run"
