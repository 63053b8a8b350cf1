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
    "registries": 1,
    "config": 2,
    "envs": 3,
    "agents": 3,
    "deploy": 4,
    "fit": 5,
    "policy": 5,
    "value_iteration": 5,
    "pendulum_belief": 6,
    "pendulum_filter": 7,
    "evaluate": 6,
    "saved": 6,
    "play_gymnasium": 6,
    "ceilings": 7,
    "training": 7,
    "study": 8,
    "load": 9,
    "sweep": 9,
    "report": 9,
    "transfer": 9,
    "export": 10,
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
