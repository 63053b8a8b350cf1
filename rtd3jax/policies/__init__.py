"""Policies for use outside the trainer: trained policies, and baselines without training.

All have the same interface: ``state = policy.init()``, then at each step
``action, state = policy.step(state, observation)``.
"""
