"""Controllers of a rover's speed and yaw rate that need no training."""

from typing import Any

from rtd3jax.envs.controllers import PIDPolicy, pid_policy
from rtd3jax.envs.interface import describe
from rtd3jax.protocols import EnvironmentLike


def plain_params(env: EnvironmentLike) -> Any:
    """The rover's own parameters; ``env`` may be disturbed."""
    params = env.default_params
    return getattr(params, "env", params)


def constant_command(env: EnvironmentLike) -> tuple[Any, Any]:
    """The target as a constant command, which is exact without slip; ``env`` may be disturbed."""
    params = plain_params(env)
    return params.target_speed, params.target_yaw_rate


def target_pi(env: EnvironmentLike, kp: float, ki: float) -> PIDPolicy | None:
    """Feed-forward of the target, and a PI controller of both errors.

    The result is None if an error is not observed. The controller ignores the first observation:
    the rover is then at rest, which no command has caused.
    """
    if describe(env, env.default_params).observation_size != 2:
        return None
    return pid_policy(env, kp=kp, ki=ki, feedforward=constant_command(env), ignored=1)
