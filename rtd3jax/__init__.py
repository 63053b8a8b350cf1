"""Recurrent TD3 agents for plants whose disturbance is hidden and evolves."""

from rtd3jax.agents.networks import count_parameters
from rtd3jax.ceilings import Ceiling, bayes_policy, ceiling
from rtd3jax.config import ALGORITHMS, Config
from rtd3jax.deploy.stablehlo_file import load_stablehlo
from rtd3jax.envs.registry import DISTURBANCES, ENVIRONMENTS, make, register
from rtd3jax.errors import UserError
from rtd3jax.evaluate import evaluate
from rtd3jax.load import load_policy
from rtd3jax.policy import Policy, constant_policy, random_policy
from rtd3jax.training.run import Failure, Run, train

__all__ = [
    "ALGORITHMS",
    "DISTURBANCES",
    "ENVIRONMENTS",
    "Ceiling",
    "Config",
    "Failure",
    "Policy",
    "Run",
    "UserError",
    "bayes_policy",
    "ceiling",
    "constant_policy",
    "count_parameters",
    "evaluate",
    "load_policy",
    "load_stablehlo",
    "make",
    "random_policy",
    "register",
    "train",
]
