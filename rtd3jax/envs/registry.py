"""Environments by name, with a disturbance by name and parameters by name."""

import ast
import dataclasses
import math
import numbers
import re
import sys
from collections.abc import Callable
from typing import Any

import gymnax

from rtd3jax.envs.compat.gymnax import make_gymnax
from rtd3jax.envs.disturbed import (
    CHANNELS,
    Disturbed,
    DisturbedParams,
    check_fit,
    disturb,
    sequence,
)
from rtd3jax.envs.entry import check_gymnax
from rtd3jax.envs.pendulum.environment import Pendulum
from rtd3jax.envs.processes.disturbances import DampedSine, GaussianNoise, Hidden, Pulses, Sine
from rtd3jax.envs.processes.faults import Delay, Dropout, GainDrift, OrnsteinUhlenbeck, Quantisation
from rtd3jax.envs.processes.process import Nothing, Process, require
from rtd3jax.envs.rover.environment import Rover
from rtd3jax.envs.rover.slip import Ar1Slip, SineSlip
from rtd3jax.errors import UserError, nearest

_PROCESSES: dict[str, dict[str, Process]] = {
    "pendulum": {
        "none": Nothing(),
        "temporal-bias": Pulses(),
        "temporal-sine": Sine(
            amplitude_min=1.0,
            amplitude_max=1.0,
            period_min=70.0,
            period_max=70.0,
            elements=(0, 1),
        ),
        "random-sine": Sine(),
        "noise": GaussianNoise(),
        "hidden": Hidden(),
        "combined-sine": Sine(waves=2),
        "damped-sine": DampedSine(),
    },
    "rover": {
        "none": Nothing(),
        "ar1-slip": Ar1Slip(),
        "ar1-slip-high-variance": Ar1Slip(sigma=0.10),
        "ar1-slip-fast": Ar1Slip(rho=0.90),
        "ar1-slip-slow": Ar1Slip(rho=0.98),
        "sine-slip": SineSlip(),
    },
}

_OWN_CHANNEL = {"pendulum": "observation", "rover": "slip"}
"""Where a world's own processes act."""

_FAULTS: dict[str, tuple[str, Process]] = {
    "dropout": ("observation", Dropout()),
    "delay": ("observation", Delay()),
    "quantisation": ("observation", Quantisation()),
    "ornstein-uhlenbeck": ("observation", OrnsteinUhlenbeck()),
    "action-delay": ("action", Delay()),
    "gain-drift": ("action", GainDrift()),
}

FAULTS: tuple[str, ...] = tuple(_FAULTS)
"""The disturbances that fit any world, a gymnax id included; not the paper's."""

ENVIRONMENTS: tuple[str, ...] = tuple(_PROCESSES)
"""The paper's worlds. Every gymnax id can be made too."""

DISTURBANCES: dict[str, tuple[str, ...]] = {
    env: (*ids, *_FAULTS) for env, ids in _PROCESSES.items()
}
"""The disturbances of each world: its own (paper, Sections 5.2 and 8.4), then ``FAULTS``. They can
be joined by ``+``: ``ar1-slip+dropout``."""

_constructors: dict[str, Callable[..., Any]] = {}
_registered: dict[str, tuple[Any, dict[str, tuple[str, Process]]]] = {}
_registrants: dict[str, str] = {}
"""The module that registered each id: a notebook's cell that runs again may do it again."""


def make(env_id: str, disturbance: str = "none", **parameters: Any) -> Any:
    """Make an environment whose ``default_params`` carry the disturbance and the parameters.

    ``disturbance`` is an id, or several joined by ``+``, of which those that disturb the same thing
    act in that order. A parameter is a field of a disturbance, else of the environment's
    parameters; the pendulum also has ``reward_from`` ("state" or "observation"; the default is
    "observation" for ``noise`` alone, as the paper has it [choice]). ``env_id`` is one of
    ``ENVIRONMENTS``, a registered id, or a gymnax id.
    """
    if env_id in _constructors:
        return _constructors[env_id](disturbance, **parameters)
    if env_id in _registered:
        return _disturbed(env_id, _registered[env_id][0], disturbance, parameters)
    if env_id in _PROCESSES or env_id in gymnax.registered_envs:
        base = {"pendulum": Pendulum, "rover": Rover}.get(env_id, lambda: make_gymnax(env_id))()
        return _disturbed(env_id, base, disturbance, parameters)
    known = (*ENVIRONMENTS, *_constructors, *_registered, *gymnax.registered_envs)
    raise UserError(f"unknown environment {env_id!r}{nearest(env_id, known)}")


def register(
    env_id: str,
    world: Any,
    disturbances: dict[str, Process | tuple[str, Process]] | None = None,
    *,
    replace: bool = False,
) -> None:
    """Let ``make`` and the sweep know a world by name.

    Args:
        env_id: a new id, or one that the calling module itself registered, which is replaced: a
            notebook's cell may run again.
        world: a gymnax >= 1.0 environment, to which ``make`` then gives parameters and disturbances
            as it does to ours; or a function ``(disturbance, **parameters)`` that returns one and
            sees to both itself.
        disturbances: of an environment, beside "none" and ``FAULTS``: the name of each, and its
            process of the observation or its (channel, process), as `disturb` takes them.
        replace: what another module registered under this id. Ours and gymnax's stay.

    Raises:
        UserError: for an id or a name that is taken, or what is no world.
    """
    module = sys._getframe(1).f_globals.get("__name__", "")
    if not isinstance(env_id, str) or not env_id:
        raise UserError(f"an environment id must be a non-empty string, not {env_id!r}")
    is_environment = callable(getattr(world, "reset", None)) and callable(
        getattr(world, "step", None)
    )
    if isinstance(world, type) or not (is_environment or callable(world)):
        raise UserError(f"the world {env_id!r} must be an environment or a function, not {world!r}")
    if env_id in _PROCESSES or env_id in gymnax.registered_envs:
        raise UserError(f"environment {env_id!r} exists already; choose another id")
    if env_id in {*_constructors, *_registered} and not replace:
        registrant = _registrants.get(env_id)
        if registrant != module:
            raise UserError(
                f"environment {env_id!r} exists already, registered by {registrant}; choose "
                "another id, or give replace=True"
            )
    if is_environment:
        check_gymnax(world)
        named = _named_processes(env_id, world, disturbances or {})
        _constructors.pop(env_id, None)
        _registered[env_id] = world, named
    elif disturbances is not None:
        raise UserError(f"{env_id!r}: disturbances are for an environment, not for a function")
    else:
        _registered.pop(env_id, None)
        _constructors[env_id] = world
    _registrants[env_id] = module


def _named_processes(
    env_id: str, world: Any, disturbances: dict[str, Any]
) -> dict[str, tuple[str, Process]]:
    """Channel and process of each name, each tried on the world."""
    named: dict[str, tuple[str, Process]] = {"none": ("observation", Nothing())}
    for name, value in disturbances.items():
        if not re.fullmatch(r"[\w.-]+", name) or name in (*named, *_FAULTS):
            raise UserError(
                f"{env_id!r}: a disturbance cannot be called {name!r}; choose another name of "
                "letters, digits, '-', '.' and '_'"
            )
        channel, process = value if isinstance(value, tuple) else ("observation", value)
        disturb(world, process, channel)
        named[name] = channel, process
    return named


def parse_disturbance(text: str) -> tuple[str, dict[str, Any]]:
    """Read ``"noise:sigma=1.0,reward_from=state"`` as an id and its parameters.

    Values are Python literals where they can be (``elements=(0,1)``), else strings.
    """
    disturbance, _, rest = text.strip().partition(":")
    if not disturbance:
        raise UserError(f"disturbance {text!r} has no id; write for example noise:sigma=1.0")
    parameters: dict[str, Any] = {}
    # A comma within parentheses belongs to a value.
    for item in re.split(r",(?![^(]*\))", rest) if rest.strip() else []:
        name, equals, value = (part.strip() for part in item.partition("="))
        if not (name and equals and value):
            raise UserError(f"disturbance {text!r}: {item.strip()!r} is not of the form name=value")
        if name in parameters:
            raise UserError(f"disturbance {text!r} gives {name!r} twice")
        try:
            parameters[name] = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            parameters[name] = value
    return disturbance.strip(), parameters


def _known(env_id: str) -> dict[str, tuple[str, Process]]:
    """Channel and process of every disturbance of a world, by name."""
    if env_id in _registered:
        own = _registered[env_id][1]
    else:
        processes = _PROCESSES.get(env_id, {"none": Nothing()})
        channel = _OWN_CHANNEL.get(env_id, "observation")
        own = {name: (channel, process) for name, process in processes.items()}
    return {**own, **_FAULTS}


def _lookup(env_id: str, disturbance: str) -> list[tuple[str, Process]]:
    """Channel and process of each part of ``disturbance``."""
    known = _known(env_id)
    for name in disturbance.split("+"):
        if name not in known:
            raise UserError(
                f"unknown disturbance {name!r} of {env_id}{nearest(name, known)} "
                f"(known: {', '.join(known)})"
            )
    return [known[name] for name in disturbance.split("+")]


def _disturbed(env_id: str, base: Any, disturbance: str, parameters: dict[str, Any]) -> Any:
    """``base`` with the named disturbance, and ``parameters`` shared out among them."""
    names = disturbance.split("+")
    channels, processes = zip(*_lookup(env_id, disturbance), strict=True)
    rest, reward_from = dict(parameters), "state"
    also: tuple[str, ...] = ()
    if env_id == "pendulum":
        reward_from = rest.pop("reward_from", "observation" if "noise" in names else "state")
        also = ("reward_from",)
    what = f"{env_id} with {disturbance}"
    _check_owners(what, names, processes, rest)
    assigned = _assign(what, (*processes, base.default_params), rest, also)
    processes, params = assigned[:-1], assigned[-1]
    for process in processes:
        process.validate()
    for name in _POSITIVE.get(env_id, ()):
        require(params, name, above=0)
    if hasattr(params, "max_steps_in_episode"):
        require(params, "max_steps_in_episode", low=1)

    def on(channel: str) -> Process:
        return sequence(*(p for p, c in zip(processes, channels, strict=True) if c == channel))

    if env_id == "rover":
        params = params.replace(slip=on("slip"))
        base = Rover(params)
    elif env_id in gymnax.registered_envs:
        base = make_gymnax(env_id, params)
    bare = env_id == "rover" or env_id in gymnax.registered_envs
    if bare and all(isinstance(on(channel), Nothing) for channel in CHANNELS):
        return base
    fields = {field: on(channel) for channel, field in CHANNELS.items()}
    env = Disturbed(base, reward_from, DisturbedParams(env=params, **fields))
    check_fit(env)
    return env


_POSITIVE = {
    "pendulum": ("max_speed", "max_torque", "dt", "m", "l"),
    "rover": ("wheelbase", "max_speed", "max_yaw_rate"),
}
"""Parameters that must be greater than zero."""


def _check_owners(
    what: str, names: list[str], processes: tuple[Process, ...], parameters: dict[str, Any]
) -> None:
    """Raise UserError for a parameter that several of the joined disturbances have."""
    for name in parameters:
        owners = [n for n, p in zip(names, processes, strict=True) if name in _settable(p)]
        if len(owners) > 1:
            raise UserError(
                f"{what}: {name!r} could be that of {' or '.join(owners)}; "
                "join such disturbances with rtd.disturb"
            )


def _assign(
    what: str, owners: tuple[Any, ...], parameters: dict[str, Any], also: tuple[str, ...] = ()
) -> tuple[Any, ...]:
    """Give each parameter to the first owner that has it; return the changed owners.

    ``also`` names parameters that are known but handled elsewhere, for the hint in the message.
    """
    changes: list[dict[str, Any]] = [{} for _ in owners]
    fields = [_settable(owner) for owner in owners]
    for name, value in parameters.items():
        for owned, change in zip(fields, changes, strict=True):
            if name in owned:
                change[name] = _coerce(what, name, value, owned[name])
                break
        else:
            known = [*(field for owned in fields for field in owned), *also]
            raise UserError(
                f"{what} has no parameter {name!r}{nearest(name, known)} "
                f"(known: {', '.join(known)})"
            )
    return tuple(
        owner.replace(**change) if change else owner
        for owner, change in zip(owners, changes, strict=True)
    )


def _settable(owner: Any) -> dict[str, Any]:
    """The fields that a plain value can set, with their defaults."""
    if not dataclasses.is_dataclass(owner):  # others' parameters can be anything
        return {}
    values = {field.name: getattr(owner, field.name) for field in dataclasses.fields(owner)}
    return {name: v for name, v in values.items() if isinstance(v, bool | int | float | tuple)}


def _coerce(what: str, name: str, value: Any, default: Any) -> Any:
    """Return ``value`` as the kind of thing that ``default`` is, or raise UserError."""
    wrong = f"{what}: {name}={value!r} must be"
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise UserError(f"{wrong} True or False")
        return value
    if isinstance(default, tuple):
        items = value if isinstance(value, list | tuple) else (value,)
        if not all(_is_integer(item) for item in items):
            raise UserError(f"{wrong} a list of whole numbers")
        return tuple(int(item) for item in items)
    if isinstance(default, int):
        if not _is_integer(value):
            raise UserError(f"{wrong} a whole number")
        return int(value)
    if not isinstance(value, numbers.Real) or isinstance(value, bool) or not math.isfinite(value):
        raise UserError(f"{wrong} a finite number")
    return float(value)


def _is_integer(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)
