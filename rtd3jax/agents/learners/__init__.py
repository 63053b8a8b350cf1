"""Learners: they train an agent's networks on batches from its replay."""

from rtd3jax.agents.learners.base import register_learner
from rtd3jax.agents.learners.td3 import make_td3

register_learner("td3", make_td3)
