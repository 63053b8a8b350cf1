"""Processes from logs: estimates, how sure they are, and pictures of both."""
