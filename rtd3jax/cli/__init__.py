"""The commands: a module for each, which `python -m rtd3jax.NAME` runs."""
