"""Recurrent TD3 agents for plants whose disturbance is hidden and evolves."""

import rtd3jax.system.switches  # noqa: F401 - first: it imports gymnax
from rtd3jax.agents.agent import Agent, count_parameters, make_agent
from rtd3jax.agents.learners import register_learner
from rtd3jax.agents.memory import Memory, register_memory
from rtd3jax.agents.networks import NetworkSpec
from rtd3jax.agents.variants import ALGORITHMS, Variant, register_agent
from rtd3jax.config import Config
from rtd3jax.envs.builtin import DISTURBANCES, ENVIRONMENTS
from rtd3jax.envs.check import Finding, check_env, find_problems
from rtd3jax.envs.compat.brax import from_brax
from rtd3jax.envs.compat.from_gymnasium import from_gymnasium
from rtd3jax.envs.compat.gymnasium import register_with_gymnasium, to_gymnasium
from rtd3jax.envs.controllers import function_policy, lqr_policy, pid_policy
from rtd3jax.envs.description import Ceiling, Drawing
from rtd3jax.envs.disturbed import disturb
from rtd3jax.envs.identity import ValueIdentity
from rtd3jax.envs.pendulum.filter import filter_policy
from rtd3jax.envs.processes.disturbances import DampedSine, GaussianNoise, Hidden, Pulses, Sine
from rtd3jax.envs.processes.faults import Delay, Dropout, GainDrift, OrnsteinUhlenbeck, Quantisation
from rtd3jax.envs.processes.mixture import Mixture
from rtd3jax.envs.processes.process import Chain, NoDisturbance, Nothing, Process, Sum
from rtd3jax.envs.processes.recorded import Recorded
from rtd3jax.envs.registry import make, register
from rtd3jax.envs.rover.optimum import bayes_policy
from rtd3jax.envs.stress import Stress
from rtd3jax.errors import UserError
from rtd3jax.evaluation.ceiling import ceiling
from rtd3jax.evaluation.gymnasium import run_in_gymnasium
from rtd3jax.evaluation.plot import plot_episode
from rtd3jax.evaluation.returns import evaluate
from rtd3jax.evaluation.robustness import robustness
from rtd3jax.evaluation.robustness_plot import plot_robustness
from rtd3jax.evaluation.rollout import Trajectory, rollout
from rtd3jax.identification.fit import fit_process
from rtd3jax.identification.result import Estimate, Fit
from rtd3jax.policies.baselines import constant_policy, random_policy
from rtd3jax.policies.export.stablehlo_file import load_stablehlo
from rtd3jax.policies.load import load_policy
from rtd3jax.policies.trained import Policy
from rtd3jax.study.cells import Cell
from rtd3jax.system.versions import versions_of
from rtd3jax.training.result import Failure, Run
from rtd3jax.training.train import train

__all__ = [
    "ALGORITHMS",
    "DISTURBANCES",
    "ENVIRONMENTS",
    "Agent",
    "Ceiling",
    "Cell",
    "Chain",
    "Config",
    "DampedSine",
    "Delay",
    "Drawing",
    "Dropout",
    "Estimate",
    "Failure",
    "Finding",
    "Fit",
    "GainDrift",
    "GaussianNoise",
    "Hidden",
    "Memory",
    "Mixture",
    "NetworkSpec",
    "NoDisturbance",
    "Nothing",
    "OrnsteinUhlenbeck",
    "Policy",
    "Process",
    "Pulses",
    "Quantisation",
    "Recorded",
    "Run",
    "Sine",
    "Stress",
    "Study",
    "Sum",
    "Trajectory",
    "UserError",
    "ValueIdentity",
    "Variant",
    "bayes_policy",
    "ceiling",
    "check_env",
    "constant_policy",
    "count_parameters",
    "disturb",
    "evaluate",
    "filter_policy",
    "fit_process",
    "function_policy",
    "load_policy",
    "load_stablehlo",
    "lqr_policy",
    "find_problems",
    "from_brax",
    "from_gymnasium",
    "make",
    "make_agent",
    "pid_policy",
    "plot_episode",
    "plot_robustness",
    "random_policy",
    "register",
    "register_agent",
    "register_learner",
    "register_memory",
    "robustness",
    "rollout",
    "run_in_gymnasium",
    "to_gymnasium",
    "train",
]

__version__ = versions_of(["rtd3jax"])["rtd3jax"]

register_with_gymnasium()


def __getattr__(name: str) -> object:
    """Import `Study` only when it is used: it imports pandas and matplotlib."""
    if name == "Study":
        from rtd3jax.study.study import Study

        return Study
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
