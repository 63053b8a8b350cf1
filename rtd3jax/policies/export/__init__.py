"""A trained actor in forms that run without the trainer."""
