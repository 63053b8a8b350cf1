"""Tests functions of the page that need no document, with Node.js."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest

from rtd3jax.study.report import page

FOLDER = Path(page.__file__).parent / "page"
SCRIPTS = [name for name in page._SCRIPTS if name != "main"]  # main builds the page
NODE = shutil.which("node")

pytestmark = pytest.mark.skipif(NODE is None, reason="Node.js is not installed")


def value_of(expression, **data):
    """The value of a JavaScript expression in the scripts of a page with this data."""
    data = {"environments": [], "agents": [], "cells": [], **data}
    text = json.dumps(json.dumps(data))
    parts = [f"const document = {{ getElementById: () => ({{ textContent: {text} }}) }};"]
    parts += [(FOLDER / f"{name}.js").read_text("utf-8") for name in SCRIPTS]
    parts += [f"console.log(JSON.stringify({expression}));"]
    command = [NODE, "-"]
    done = subprocess.run(command, input="\n".join(parts).encode(), capture_output=True, check=True)
    return json.loads(done.stdout.decode().replace("\N{MINUS SIGN}", "-"))


def test_a_row_of_the_table_has_the_decimals_of_its_own_return():
    environment = {"env": "rover", "disturbance": "none", "ceiling": None}
    environment["references"] = [{"name": "random", "return": -160.04}]
    final = {"n": 5, "lost": 0, "iqm": -1.3021, "mean": -1.3018, "std": 0.0449}
    final |= {"low": -1.35, "high": -1.25}
    cell = {"environment": 0, "agent": 0, "length": 0, "seeds": 5, "final": {"return": final}}
    rows = "(state.environments.add(0), state.agents.add(0), tableRows())"
    numbers = "tableColumns().slice(4, 8)"  # IQM, interval, mean, std
    trained, random = value_of(
        f"{rows}.map((row) => {numbers}.map((column) => column.text(row)))",
        environments=[environment],
        agents=[{"name": "td3"}],
        cells=[cell],
    )
    assert trained == ["-1.302", "-1.350 to -1.250", "-1.302", "0.045"]
    assert random == ["–", "–", "-160.0", "–"]


@pytest.mark.parametrize(
    ("entry", "words", "whole"),
    [
        ((5, 0, -1.3021, 0.0449), ["-1.302", "± 0.045"], True),
        ((4, 1, -1.3021, 0.0449), ["-1.302", "± 0.045, 1 of 5 lost"], False),
        ((1, 1, -1604.2, None), ["-1,604", "1 of 2 lost"], False),
        ((0, 5, None, None), ["–", "5 of 5 lost"], False),
    ],
)
def test_a_cell_of_the_transfer_matrix_names_its_lost_seeds(entry, words, whole):
    entry = json.dumps(dict(zip(("n", "lost", "mean", "std"), entry, strict=True)))
    assert value_of(f"[transferWords({entry}), isWhole({entry})]") == [words, whole]


@pytest.mark.parametrize(
    ("lengths", "first"),
    [
        ([[0, 1]] + [[0, 1, 3, 6, 10, 20]] * 9, 3),  # the paper: 1 + 5 + 5 panels
        ([[0]] * 12, 12),
        ([list(range(1, 21)), [1]], 1),
    ],
)
def test_a_large_study_opens_with_a_dozen_panels(lengths, first):
    cells = [
        {"environment": index, "length": length}
        for index, own in enumerate(lengths)
        for length in own
    ]
    environments = [{"env": "pendulum", "disturbance": str(index)} for index in range(len(lengths))]
    found = value_of("firstEnvironments()", environments=environments, cells=cells)
    assert found == list(range(first))


def test_the_margin_of_a_stage_fits_its_longest_number():
    texts = "[[0, 2e-9], [0, 4e6]].map((values) => traceAxis({ lines: [{ values }] }).texts)"
    fine, large = value_of(texts)
    assert "0.000000002" in fine and "2,500,000" in large
    # A digit is six pixels wide; five pixels are between a number and its axis.
    assert value_of(f"marginFor({texts}.flat())") >= 6 * len("0.000000002") + 5
    assert value_of("marginFor([])") > 0
