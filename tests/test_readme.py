"""Runs the Python code of the README and of docs/."""

import dataclasses
import pathlib
import re

import pytest

from rtd3jax.envs import registered, registry
from rtd3jax.envs.builtin import LISTED

ROOT = pathlib.Path(__file__).parent.parent
PACKAGE = ROOT / "rtd3jax"
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"```python\n(.*?)```", re.DOTALL)


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Run a document's blocks in a folder of their own; the names that they leave."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "_entries", dict(registry._entries))

    def run(path):
        names = {"__name__": path.stem}
        for block in BLOCK.findall(path.read_text()):
            exec(compile(block, str(path), "exec"), names)
        return names

    return run


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.stem)
def test_python_blocks_run(path, run):
    names = run(path)
    if path.stem == "README":
        assert names["returns"].shape == (100,) and names["baseline"].shape == (100,)
    if path.stem == "bring_an_environment":
        assert set(names["episodes"]["algorithm"]) == {"td3", "random", "half-power"}
        assert names["returns"].shape == (2,)


def test_the_guides_promises_about_length():
    """A plant in 30 to 40 lines, a disturbance in about 15."""
    plant, process = BLOCK.findall((ROOT / "docs" / "bring_an_environment.md").read_text())[:2]
    assert 30 <= len(plant.splitlines()) <= 45 and len(process.splitlines()) <= 16


@pytest.mark.parametrize("path", [*DOCUMENTS, ROOT / "CONTRIBUTING.md"], ids=lambda path: path.stem)
def test_modules_that_are_named_exist(path):
    named = re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", path.read_text())
    missing = [name for name in named if not any((top / name).is_file() for top in (ROOT, PACKAGE))]
    assert missing == []


def test_where_is_has_twenty_places():
    named = re.findall(r"`((?:[a-z_]+/)+[a-z_]+\.py)`", (ROOT / "CONTRIBUTING.md").read_text())
    assert len(set(named)) >= 20


OTHERWISE = {
    ("combined-sine", "waves"): "`waves=1` (2)",
    ("ar1-slip-fast", "rho"): "(fast 0.9, slow 0.98)",
    ("ar1-slip-slow", "rho"): "(fast 0.9, slow 0.98)",
    ("ar1-slip-high-variance", "sigma"): "(high variance 0.1)",
    ("dry-sand-slope", "slope"): "(with `-slope` 2.0, regolith 5.0)",
    ("mixed-slope", "slope"): "(with `-slope` 2.0, regolith 5.0)",
    ("regolith-slope", "slope"): "(with `-slope` 2.0, regolith 5.0)",
}
"""What the table says of values that differ from those of the row's first name."""


@pytest.mark.parametrize("env", LISTED)
def test_the_table_of_disturbances_has_every_name_and_default(env):
    text = (ROOT / "docs" / "run_a_study.md").read_text().split("## Disturbances\n")[1]
    table = [line for line in text.split("\n## ")[0].splitlines() if line.startswith("| `")]
    named = {**registry._entries[env].disturbances, **registered.FAULT_PROCESSES}
    for name, (_, process) in named.items():
        (row,) = [line for line in table if f"`{name}`" in line.split("|")[1]]
        for field in dataclasses.fields(process):
            value = getattr(process, field.name)
            if isinstance(value, int | float | tuple):
                said = OTHERWISE.get((name, field.name), f"`{field.name}={value!r}`")
                assert said in row, name
