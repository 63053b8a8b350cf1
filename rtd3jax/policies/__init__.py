"""Policies outside the trainer: the trained one, and the references that need no training.

All share one interface: ``state = policy.init()``, then at each step
``action, state = policy.step(state, observation)``.
"""
