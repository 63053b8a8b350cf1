"""Entry point of ``python -m rtd3jax.sweep``; `rtd3jax.cli.sweep` holds the command."""

import sys

from rtd3jax.cli.sweep import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
