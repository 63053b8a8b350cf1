"""``python -m rtd3jax``: list the commands, environments, agents and memories by name."""

import argparse
import ast
import pathlib
import pkgutil
import platform
import sys
import textwrap
from collections.abc import Iterable, Iterator, Sequence

from rtd3jax.cli.common import replace_unprintable
from rtd3jax.envs.builtin import LISTED
from rtd3jax.envs.registered import FAULTS
from rtd3jax.registries import AGENTS, MEMORIES
from rtd3jax.study.presets import PRESETS
from rtd3jax.system.versions import versions_of

_WIDTH = 79
_FOLDER = str(pathlib.Path(__file__).parent / "cli")
_PACKAGES = ("rtd3jax", "jax", "flax", "gymnax")
_MARK = "``python -m rtd3jax."
"""The docstring of a command's module begins with this, its name, "``: " and its purpose."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the list and return the exit status 0; bad input exits with status 2."""
    replace_unprintable()
    parser = argparse.ArgumentParser(
        prog="python -m rtd3jax",
        description="List what this installation of rtd3jax offers, by name.",
        allow_abbrev=False,
    )
    versions = [f"{name} {version}" for name, version in versions_of(_PACKAGES).items()]
    parser.add_argument("--version", action="version", version=versions[0])
    parser.parse_args(arguments)
    print(", ".join([*versions, f"Python {platform.python_version()}"]))
    print("\n".join(_lines()))
    return 0


def _lines() -> Iterator[str]:
    yield "\nCommands, such as python -m rtd3jax.sweep --help:"
    for name, purpose in commands().items():
        yield f"  {name:10}{purpose}"
    yield f"\nPresets of the sweep: {', '.join(PRESETS)}"
    yield "\nEnvironments, and the disturbances of each:"
    for env, disturbances in LISTED.items():
        yield from _listed(env, (name for name in disturbances if name not in FAULTS))
    yield from _listed("any", FAULTS)
    yield "  rtd3jax.make also makes gymnax's ids, and Gymnasium's as gymnasium:ID;"
    yield "  rtd3jax.register adds others."
    yield ""
    yield from _listed("Agents", AGENTS, indent="")
    yield from _listed("Memories", MEMORIES, indent="")


def commands() -> dict[str, str]:
    """The purpose of each command by its name, from the docstring of its module.

    No module is imported.
    """
    found = {}
    for module in pkgutil.iter_modules([_FOLDER], "rtd3jax.cli."):
        spec = module.module_finder.find_spec(module.name, None)
        get_source = getattr(spec.loader, "get_source", None) if spec is not None else None
        source = get_source(module.name) if get_source is not None else None
        text = ast.get_docstring(ast.parse(source or "")) or ""
        if text.startswith(_MARK):
            name, _, rest = text.removeprefix(_MARK).partition("``")
            found[name.split()[0]] = rest.lstrip(" :").split("\n")[0].rstrip(".")
    return found


def _listed(title: str, names: Iterable[str], indent: str = "  ") -> list[str]:
    """``title: name, name, ...``, wrapped to the width of a terminal."""
    hanging = indent + "  "
    return textwrap.wrap(
        f"{title}: {', '.join(names)}",
        _WIDTH,
        initial_indent=indent,
        subsequent_indent=hanging,
        break_on_hyphens=False,
    )


if __name__ == "__main__":
    sys.exit(main())
