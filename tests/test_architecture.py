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
    "switches": 1,
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


def imported(source, modules):
    """Modules of the package that ``source`` imports, wherever in it, for types alone or not."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        names = []
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            # ``from package import name``: a module of that name, or something in the package.
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            while name and name not in modules:
                name = name.rpartition(".")[0]
            found |= {name} - {""}
    return found


def layer_of(module):
    """The layer's name: the module's first part below the package."""
    return module.split(".")[1] if "." in module else ""


def upward(module, imports):
    """Those of its imports that run against the arrow: the package itself is above all."""
    own = layer_of(module)
    height = {**LAYERS, "": max(LAYERS.values()) + 1}
    return sorted(
        name for name in imports if layer_of(name) != own and height[layer_of(name)] >= height[own]
    )


def circle(graph):
    """Modules that import each other in a circle; none where there is no circle."""
    left = {module: set(imports) & set(graph) - {module} for module, imports in graph.items()}
    while free := {module for module, imports in left.items() if not imports}:
        left = {m: imports - free for m, imports in left.items() if m not in free}
    return sorted(left)


def sources():
    """Every module's source by its name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path.read_text("utf-8")
    return found


def graph_of(found):
    """What each module imports. A folder's own module gathers its parts, and is left out."""
    folders = {m for m in found if any(other.startswith(f"{m}.") for other in found)}
    return {m: imported(text, found) for m, text in found.items() if m not in folders}


GRAPH = graph_of(sources())


@pytest.mark.parametrize("module", GRAPH)
def test_imports_run_one_way(module):
    assert upward(module, GRAPH[module]) == []


def test_no_modules_import_each_other():
    assert circle(GRAPH) == []


def test_the_checks_can_fail():
    planted = {
        "rtd3jax": "",
        "rtd3jax.sweep": "from rtd3jax.study.hosts import relaunch",
        "rtd3jax.study": "",
        "rtd3jax.study.hosts": "from rtd3jax.study import launch",
        "rtd3jax.study.launch": "def main():\n    from rtd3jax import sweep",
        "rtd3jax.envs.rover": "import rtd3jax.training.run\nfrom rtd3jax import Config",
        "rtd3jax.training.run": "",
    }
    graph = graph_of(planted)
    assert upward("rtd3jax.study.launch", graph["rtd3jax.study.launch"]) == ["rtd3jax.sweep"]
    wrong = upward("rtd3jax.envs.rover", graph["rtd3jax.envs.rover"])
    assert wrong == ["rtd3jax", "rtd3jax.training.run"]
    assert circle(graph) == ["rtd3jax.study.hosts", "rtd3jax.study.launch", "rtd3jax.sweep"]


def test_public_names_exist():
    assert all(hasattr(rtd3jax, name) for name in rtd3jax.__all__)
