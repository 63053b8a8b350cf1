"""Entry point of ``python -m rtd3jax.transfer``; `rtd3jax.cli.transfer` holds the command."""

import sys

from rtd3jax.cli.transfer import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
