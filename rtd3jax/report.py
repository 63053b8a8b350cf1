"""Entry point of ``python -m rtd3jax.report``; `rtd3jax.cli.report` holds the command."""

import sys

from rtd3jax.cli.report import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
