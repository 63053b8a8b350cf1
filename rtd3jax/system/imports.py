"""Imports a user's modules by name, as ``--import`` asks."""

import importlib
import os
import sys
from collections.abc import Sequence

from rtd3jax.errors import UserError


def import_modules(modules: Sequence[str]) -> None:
    """Import modules that register environments, agents or memories.

    Args:
        modules: their names; a module of the working directory is found too.

    Raises:
        UserError: when a module cannot be imported.
    """
    for module in modules:
        sys.path.insert(0, os.getcwd())
        try:
            importlib.import_module(module)
        except ImportError as error:
            raise UserError(f"--import {module}: {error}") from error
        finally:
            sys.path.pop(0)
