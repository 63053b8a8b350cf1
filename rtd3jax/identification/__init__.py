"""Fits processes to logs: estimates, their standard errors, and plots."""
