"""Whole episodes of a policy in an environment, and the best return that there can be."""
