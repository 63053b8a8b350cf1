"""Imports a user's modules by name, for the option ``--import``."""

import contextlib
import importlib
import os
import sys
from collections.abc import Sequence

from rtd3jax.errors import UserError


def import_modules(modules: Sequence[str]) -> None:
    """Import modules that register environments, agents or memories.

    Args:
        modules: their names; modules in the working directory are found too.

    Raises:
        UserError: when a module cannot be imported.
    """
    for module in modules:
        here = os.getcwd()
        sys.path.insert(0, here)
        try:
            importlib.import_module(module)
        except (ImportError, TypeError, ValueError) as error:
            name = str(module).removesuffix(".py").rpartition(os.sep)[2]
            hint = f"; give a module's name: --import {name}" if name and name != module else ""
            raise UserError(f"--import {module or repr('')}: {error}{hint}") from error
        finally:
            # Not the first entry, which the module may have put there itself.
            with contextlib.suppress(ValueError):
                sys.path.remove(here)
