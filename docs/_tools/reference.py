"""The reference: a page on which every public name stands, with its docstring."""

import ast

from links import ROOT

_GROUPS = {
    "Training and studies": ("config", "training", "study"),
    "Environments": ("envs",),
    "Processes from a log": ("identification",),
    "Policies": ("policies",),
    "Evaluation": ("evaluation",),
    "Agents": ("agents",),
    "Errors": ("errors",),
}
"""Folders and modules of the package under each heading. A test misses the names of any other."""


def public_names() -> dict[str, str]:
    """Every name of ``rtd3jax.__all__``, and the module that it is imported from."""
    tree = ast.parse((ROOT / "rtd3jax" / "__init__.py").read_text("utf-8"))
    origin, public = {}, []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            origin.update({alias.name: node.module or "" for alias in node.names})
        elif isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            public = ast.literal_eval(node.value)
    return {name: origin[name] for name in public}


def page() -> str:
    """The page's text, for mkdocstrings."""
    parts = ["# API reference", "Everything here is a name of `import rtd3jax as rtd`."]
    names = public_names()
    for title, folders in _GROUPS.items():
        parts.append(f"## {title}")
        for name in sorted(names, key=str.lower):
            if names[name].split(".")[1] in folders:
                parts.append(f"::: {names[name]}.{name}")
    return "\n\n".join(parts) + "\n"
