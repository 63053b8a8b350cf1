"""Modules that register worlds, for the commands that are told to import them."""

import importlib
import os
import sys

from rtd3jax.errors import UserError


def import_worlds(module: str) -> None:
    """Import what registers worlds (``--import``); found in the working directory too."""
    sys.path.insert(0, os.getcwd())
    try:
        importlib.import_module(module)
    except ImportError as error:
        raise UserError(f"--import {module}: {error}") from error
    finally:
        sys.path.pop(0)
