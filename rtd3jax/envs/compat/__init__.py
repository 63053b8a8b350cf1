"""Adapters for environments of gymnax, Gymnasium and Brax, and to Gymnasium."""
