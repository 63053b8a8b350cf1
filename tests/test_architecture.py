"""Data flows one way: no import runs against the order of the layers."""

import ast
import pathlib

import pytest

import rtd3jax

ROOT = pathlib.Path(rtd3jax.__file__).parent
LAYERS = {
    "errors": 0,
    "files": 1,
    "machine": 1,
    "programs": 1,
    "versions": 1,
    "config": 1,
    "envs": 2,
    "agents": 2,
    "deploy": 2,
    "fit": 3,
    "policy": 3,
    "value_iteration": 3,
    "evaluate": 4,
    "saved": 4,
    "play_gymnasium": 4,
    "ceilings": 5,
    "training": 5,
    "study": 6,
    "load": 7,
    "sweep": 7,
    "report": 7,
    "transfer": 7,
    "export": 8,
}


def against_the_arrow(layer, source):
    """Layers that ``source``, standing in ``layer``, imports though it may not."""
    wrong = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        else:
            continue
        for name in names:
            parts = name.split(".")
            ours = parts[0] == "rtd3jax" and len(parts) > 1 and parts[1] != layer
            if ours and LAYERS[parts[1]] >= LAYERS[layer]:
                wrong.append(parts[1])
    return wrong


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda p: p.stem)
def test_imports_run_one_way(path):
    layer = path.relative_to(ROOT).parts[0].removesuffix(".py")
    if layer != "__init__":
        assert against_the_arrow(layer, path.read_text()) == []


def test_the_check_can_fail():
    assert against_the_arrow("envs", "from rtd3jax.training.run import train") == ["training"]
    assert against_the_arrow("agents", "import rtd3jax.envs.rover") == ["envs"]


def test_public_names_exist():
    assert all(hasattr(rtd3jax, name) for name in rtd3jax.__all__)
