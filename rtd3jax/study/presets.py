"""Presets of the sweep: a quick study, and the paper's studies with tuned settings.

The paper states no hyper-parameters. experiments/rover_search.py and experiments/pendulum_search.py
found these settings, with seeds that no result uses; docs/what_the_paper_leaves_open.md explains
why they help.
"""

from typing import Any

from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.study.cells import Grid

ROVER_STEPS = 80_000
ROVER_HISTORY_LENGTH = 1
ROVER_SETTINGS: dict[str, Any] = {
    "gamma": 0.0,
    "reward_scale": 10.0,
    "critic_learning_rate": 3e-3,
    "actor_learning_rate": 3e-3,
    "final_learning_rate_fraction": 0.0,
    "actor_noise": 0.1,
    "update_every": 4,
    "eval_every": 2_000,
    "precision": "float32",
}
"""The same settings for all agents."""

PENDULUM_STEPS = 30_000
PENDULUM_STEPS_FACTOR = {"h-td3": 2}
PENDULUM_DISTURBANCES = ("temporal-sine", "random-sine", "noise", "hidden")
ACTION_HISTORY_DISTURBANCES = ("none", "temporal-bias", "noise:sigma=1.0")
"""Disturbances under which the paper also compares `lstm-td3` without past actions."""
PENDULUM_HISTORY_LENGTHS = (1, 3, 6, 10, 20)
PENDULUM_SETTINGS: dict[str, Any] = {
    "batch_size": 50,
    "update_every": 2,
    "critic_learning_rate": 3e-3,
    "actor_learning_rate": 1e-3,
    "final_learning_rate_fraction": 0.0,
    "gamma": 0.97,
    "reward_scale": 0.1,
    "tau": 0.01,
    "exploration_noise": 0.2,
}
PENDULUM_OWN_SETTINGS: dict[str, dict[str, Any]] = {
    "h-td3": {
        "update_every": 1,
        "actor_learning_rate": 3e-4,
        "tau": 0.005,
        "exploration_noise": 0.5,
        "replay_capacity": 20_000,
        "policy_delay": 4,
    },
}
"""Settings of h-td3, whose critics read carries that an old version of the actor stored."""

ROBUST_AGENT = "lstm-td3-privileged"
ROBUST_DISTURBANCE = (
    "random-sine/temporal-sine/combined-sine/temporal-bias/noise:weights=(1,1,1,1,2)"
)
ROBUST_HISTORY_LENGTH = 40
ROBUST_SETTINGS: dict[str, Any] = {
    **PENDULUM_SETTINGS,
    "batch_size": 100,
    "hidden_size": 64,
    "replay": "segments",
    "segment_length": 10,
    "burn_in_gradient": False,
    "total_steps": 120_000,
    "eval_every": 4_000,
}
"""One agent for sines, offsets and noise; experiments/one_agent_search.py found these settings."""

_IN_MINUTES: dict[str, Any] = {
    "total_steps": 36_000,
    "hidden_size": 64,
    "update_every": 2,
    "critic_learning_rate": 5e-3,
    "actor_learning_rate": 5e-3,
    "eval_every": 1_000,
}
"""Settings for a rover study of minutes: smaller and shorter trainings, larger learning rates."""

_ROVER = Grid(
    "rover",
    ("ar1-slip", "sine-slip", "none"),
    ALGORITHMS,
    (ROVER_HISTORY_LENGTH,),
    {**ROVER_SETTINGS, "total_steps": ROVER_STEPS},
)


def _pendulum(disturbances: tuple[str, ...], algorithms: tuple[str, ...]) -> Grid:
    settings = {**PENDULUM_SETTINGS, "total_steps": PENDULUM_STEPS}
    own = {
        name: {**fields, "total_steps": PENDULUM_STEPS * PENDULUM_STEPS_FACTOR[name]}
        for name, fields in PENDULUM_OWN_SETTINGS.items()
    }
    return Grid("pendulum", disturbances, algorithms, PENDULUM_HISTORY_LENGTHS, settings, own)


_PENDULUM = (
    _pendulum(PENDULUM_DISTURBANCES, ALGORITHMS),
    _pendulum(ACTION_HISTORY_DISTURBANCES, ("lstm-td3", "lstm-td3-no-action")),
)
PRESETS: dict[str, tuple[Grid, ...]] = {
    "quick": (
        Grid(
            "rover",
            ("ar1-slip",),
            ("td3", "h-td3", "lstm-td3-1ha1hc"),
            (ROVER_HISTORY_LENGTH,),
            {**ROVER_SETTINGS, **_IN_MINUTES},
        ),
    ),
    "rover": (_ROVER,),
    "pendulum": _PENDULUM,
    "paper": (_ROVER, *_PENDULUM),
    "robust": (
        Grid(
            "pendulum",
            (ROBUST_DISTURBANCE,),
            (ROBUST_AGENT,),
            (ROBUST_HISTORY_LENGTH,),
            ROBUST_SETTINGS,
        ),
    ),
}
"""quick: minutes on two cores; rover: the paper's rover table; pendulum: its benchmark figures;
paper: both; robust: one agent for sines, offsets and noise, which the paper leaves open."""
