"""Tests that imports follow the order of layers."""

import ast
import pathlib

import pytest

import rtd3jax

ROOT = pathlib.Path(rtd3jax.__file__).parent
LAYERS = {
    "errors": 0,
    "protocols": 0,
    "system": 1,
    "registries": 2,
    "config": 3,
    "envs": 4,
    "agents": 4,
    "policies": 5,
    "evaluation": 6,
    "identification": 7,
    "training": 7,
    "study": 8,
    "policies.load": 9,
    "cli": 10,
    "sweep": 11,
    "report": 11,
    "transfer": 11,
    "stress": 11,
    "compare": 11,
    "export": 11,
    "__main__": 11,
}
"""The height of each folder and module. `policies.load` opens run directories: it is above `study`,
and so above the folder that it lies in."""


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
    """The layer's name: the module's first part below the package, or its own entry."""
    name = module.partition(".")[2]
    return name if name in LAYERS else name.partition(".")[0]


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
        "rtd3jax.envs.rover": "import rtd3jax.training.train\nfrom rtd3jax import Config",
        "rtd3jax.training.train": "",
    }
    graph = graph_of(planted)
    assert upward("rtd3jax.study.launch", graph["rtd3jax.study.launch"]) == ["rtd3jax.sweep"]
    wrong = upward("rtd3jax.envs.rover", graph["rtd3jax.envs.rover"])
    assert wrong == ["rtd3jax", "rtd3jax.training.train"]
    assert circle(graph) == ["rtd3jax.study.hosts", "rtd3jax.study.launch", "rtd3jax.sweep"]


def reached(graph, module):
    """All that the module imports, and what that imports in turn."""
    found, todo = set(), [module]
    while todo:
        new = graph.get(todo.pop(), set()) - found
        found |= new
        todo += new
    return found


def test_to_load_a_policy_draws_on_no_pictures_or_page():
    """gymnax imports matplotlib; a run directory that is opened for a policy asks for no more."""
    needed = reached(GRAPH, "rtd3jax.policies.load")
    assert "rtd3jax.study.lane_files" in needed
    drawing = {"rtd3jax.study.figures", "rtd3jax.study.derive", "rtd3jax.study.report.page"}
    assert not needed & drawing
    assert "rtd3jax.study.figures" in reached(GRAPH, "rtd3jax.study.finish")


def untyped(found):
    """How many parameters functions have, and those that are typed ``Any``."""
    count, vague = 0, []
    for module, source in found.items():
        for node in ast.walk(ast.parse(source)):
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                continue
            given = node.args
            parameters = [*given.posonlyargs, *given.args, *given.kwonlyargs]
            parameters += [p for p in (given.vararg, given.kwarg) if p is not None]
            for parameter in parameters:
                if parameter.arg in ("self", "cls"):
                    continue
                count += 1
                if parameter.annotation and ast.unparse(parameter.annotation) == "Any":
                    vague.append(f"{module}.{node.name}({parameter.arg})")
    return count, vague


def test_few_parameters_are_typed_any():
    """`rtd3jax.protocols` has types for an environment and a policy of anyone's."""
    count, vague = untyped(sources())
    assert len(vague) <= 0.03 * count, vague
    planted = "def play(policy: Any, seed: int, *, env: Any = None, **more: Any): ..."
    found = ["m.play(policy)", "m.play(env)", "m.play(more)"]
    assert untyped({"m": planted}) == (4, found)


def test_few_modules_lie_at_the_root():
    commands = {path.stem for path in (ROOT / "cli").glob("*.py")}
    modules = {path.stem for path in ROOT.glob("*.py")} - commands - {"__init__", "__main__"}
    assert len(modules) <= 6, modules


def test_public_names_exist():
    assert all(hasattr(rtd3jax, name) for name in rtd3jax.__all__)
