"""An environment as `register` keeps it, and the checks of its parts."""

import dataclasses
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from rtd3jax.envs.description import Description, Drawing
from rtd3jax.envs.disturbed import CHANNELS, disturb, sequence
from rtd3jax.envs.entry import own_parameters
from rtd3jax.envs.interface import describe
from rtd3jax.envs.parameters import settable
from rtd3jax.envs.processes.faults import (
    Delay,
    Dropout,
    GainDrift,
    OrnsteinUhlenbeck,
    Quantisation,
)
from rtd3jax.envs.processes.process import NoDisturbance, Process
from rtd3jax.envs.stress import SIGNAL_STRESSES, Stress, factor_stress
from rtd3jax.errors import UserError, nearest, short_reason
from rtd3jax.protocols import EnvironmentLike

FAULT_PROCESSES: dict[str, tuple[str, Process]] = {
    "dropout": ("observation", Dropout()),
    "delay": ("observation", Delay()),
    "quantisation": ("observation", Quantisation()),
    "ornstein-uhlenbeck": ("observation", OrnsteinUhlenbeck()),
    "action-delay": ("action", Delay()),
    "gain-drift": ("action", GainDrift()),
}

FAULTS: tuple[str, ...] = tuple(FAULT_PROCESSES)
"""Disturbances that fit any environment, also one of gymnax; they are not in the paper."""

NONE: dict[str, tuple[str, Process]] = {"none": ("observation", NoDisturbance())}

NO_BASELINES = ("random", "ceiling", "upper bound")
"""Names that a baseline cannot have, because a study uses them for something else."""


@dataclasses.dataclass(frozen=True)
class Registered:
    """An environment, or a function that makes one, registered under one id.

    Attributes:
        env: the environment without disturbances and with its own parameters.
        construct: the function, which itself applies disturbances and parameters; None if ``env``
            is given.
        disturbances: channel and process of each disturbance of this environment, by name.
        registrant: the module that registered the entry; this module may register it again, as a
            notebook's cell does when it runs twice.
        positive: parameters of the environment that must be greater than zero.
        reward_from_observation: disturbances under which the observation determines the reward.
        with_params: a function that makes the environment with given default parameters.
        description: baselines, ceiling, drawing and stresses.
    """

    env: EnvironmentLike | None
    construct: Callable[..., Any] | None
    disturbances: Mapping[str, tuple[str, Process]]
    registrant: str
    positive: tuple[str, ...] = ()
    reward_from_observation: tuple[str, ...] = ()
    with_params: Callable[[Any], Any] | None = None
    description: Description = Description()


def check_extras(env_id: str, env: EnvironmentLike, entry: Registered) -> None:
    """Raise UserError if an argument of `register` does not fit the environment."""
    named, description = entry.disturbances, entry.description
    params = own_parameters(env)
    fields = list(settable(params))
    wanted = entry.positive
    if description.drawing is not None:
        if not isinstance(description.drawing, Drawing):
            raise UserError(
                f"{env_id!r}: drawing must be an rtd.Drawing, not {description.drawing!r}"
            )
        seconds = description.drawing.step_seconds
        wanted += (*description.drawing.constants, *([] if seconds is None else [seconds]))
    for name in wanted:
        if name not in fields:
            raise UserError(f"{env_id!r} has no parameter {name!r}{nearest(name, fields)}")
    for name in entry.reward_from_observation:
        if name not in named:
            raise UserError(f"{env_id!r} has no disturbance {name!r}{nearest(name, named)}")
        if not hasattr(env, "observed_reward"):
            raise UserError(f"{env_id!r}: a reward from the observation needs observed_reward")
    functions: dict[str, Any] = {"ceiling": description.ceiling, "with_params": entry.with_params}
    functions = {name: value for name, value in functions.items() if value is not None}
    functions |= {f"baseline {name!r}": value for name, value in description.baselines.items()}
    for name, value in functions.items():
        if not callable(value):
            raise UserError(f"{env_id!r}: {name} must be a function, not {value!r}")
    for name in description.baselines:
        if not re.fullmatch(r"[\w.-]+", name) or name in NO_BASELINES:
            raise UserError(
                f"{env_id!r}: a baseline cannot be called {name!r}; choose another name of "
                "letters, digits, '-', '.' and '_'"
            )


def with_defaults(env_id: str, entry: Registered, params: object) -> EnvironmentLike:
    """The environment that ``with_params`` makes with the default parameters ``params``.

    Raises:
        UserError: if it cannot be made, or is not equal to the registered environment: what is
            known of an environment, such as its ceiling, is found by this equality.
    """
    assert entry.with_params is not None
    try:
        env = entry.with_params(params)
    except UserError:
        raise
    except Exception as error:  # a user's function may raise any error
        raise UserError(f"{env_id!r}: with_params failed: {short_reason(error)}") from error
    if env != entry.env:
        raise UserError(
            f"{env_id!r}: with_params makes an environment that is not equal to the registered "
            f"one, so its ceiling and drawing would be lost: let {type(entry.env).__name__} "
            "inherit from rtd.ValueIdentity, without numeric parameters in its identity"
        )
    return env


def factor_stresses(
    env_id: str, params: object, positive: Iterable[str], stresses: tuple[Stress, ...]
) -> tuple[Stress, ...]:
    """A stress for each positive float; UserError if two stresses have the same name."""
    for stress in stresses:
        if not isinstance(stress, Stress):
            raise UserError(f"{env_id!r}: stresses must be rtd.Stress, not {stress!r}")
    floats = [name for name in positive if isinstance(getattr(params, name), float)]
    factors = tuple(factor_stress(name) for name in floats)
    names = [stress.name for stress in (*SIGNAL_STRESSES, *stresses, *factors)]
    for name in names:
        if names.count(name) > 1:
            raise UserError(f"{env_id!r}: two stresses are called {name!r}; rename one of them")
    return factors


def _check_default(env_id: str, channel: str, process: Process) -> None:
    """Raise UserError for a process that ``make`` would remove from the default parameters."""
    if not isinstance(sequence(process), NoDisturbance):
        raise UserError(
            f"{env_id!r}: the default parameters have a {type(process).__name__} as {channel}, "
            "which rtd.make would remove, because disturbances replace it: give it a name in "
            "disturbances, and make rtd.NoDisturbance() the default"
        )


def named_processes(
    env_id: str, env: EnvironmentLike, disturbances: Mapping[str, Any], tried: bool
) -> dict[str, tuple[str, Process]]:
    """Channel and process of each name; if ``tried``, each is traced with the environment."""
    named = dict(NONE)
    for name, value in disturbances.items():
        if not re.fullmatch(r"[\w.-]+", name) or name in (*named, *FAULT_PROCESSES):
            raise UserError(
                f"{env_id!r}: a disturbance cannot be called {name!r}; choose another name of "
                "letters, digits, '-', '.' and '_'"
            )
        pair = value if isinstance(value, tuple) else ("observation", value)
        if len(pair) != 2:
            raise UserError(
                f"{env_id!r}: {name} must be a process or a pair (channel, process), not {value!r}"
            )
        channel, process = pair
        params = own_parameters(env)
        if channel in CHANNELS or not isinstance(getattr(params, channel, None), Process):
            if tried:
                disturb(env, process, channel)
        elif not isinstance(process, Process):
            raise UserError(f"{env_id!r}: {name} needs a process, not {process!r}")
        else:
            process.validate()
            _check_default(env_id, channel, getattr(params, channel))
            if tried:
                describe(env, params.replace(**{channel: process}))
        named[name] = channel, process
    return named
