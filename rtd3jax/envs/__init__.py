"""Environments, and the hidden processes that disturb them."""

import rtd3jax.envs.builtin  # noqa: F401  (registers the paper's environments)
