"""The commands: ``python -m rtd3jax.NAME`` runs the module of this name."""
