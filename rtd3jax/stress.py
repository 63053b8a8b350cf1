"""Entry point of ``python -m rtd3jax.stress``; `rtd3jax.cli.stress` holds the command."""

import sys

from rtd3jax.cli.stress import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
