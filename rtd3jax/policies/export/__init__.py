"""Exports trained actors to formats that run without the trainer."""
