"""Environments of gymnax, Gymnasium and Brax, and ours for Gymnasium."""
