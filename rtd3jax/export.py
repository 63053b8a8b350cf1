"""Entry point of ``python -m rtd3jax.export``; `rtd3jax.cli.export` holds the command."""

import sys

from rtd3jax.cli.export import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
