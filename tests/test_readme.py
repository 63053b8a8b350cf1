"""The Python of the README and of docs/ runs as it stands."""

import pathlib
import re

import pytest

from rtd3jax.envs import registry

ROOT = pathlib.Path(__file__).parent.parent
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
    if path.stem == "bring_a_world":
        assert set(names["episodes"]["algorithm"]) == {"td3", "random", "half-power"}
        assert names["returns"].shape == (2,)


def test_the_guides_promises_about_length():
    """A plant in 30 to 40 lines, a disturbance in about 15."""
    plant, process = BLOCK.findall((ROOT / "docs" / "bring_a_world.md").read_text())[:2]
    assert 30 <= len(plant.splitlines()) <= 45 and len(process.splitlines()) <= 16
