"""Entry point of ``python -m rtd3jax.compare``; `rtd3jax.cli.compare` holds the command."""

import sys

from rtd3jax.cli.compare import main

__all__ = ["main"]

if __name__ == "__main__":
    sys.exit(main())
