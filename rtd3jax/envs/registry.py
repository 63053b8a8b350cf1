"""The registry: makes environments from the names of environment, disturbance and parameters."""

import ast
import dataclasses
import functools
import math
import numbers
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import gymnax

from rtd3jax.envs.compat.from_gymnasium import PREFIX, from_gymnasium
from rtd3jax.envs.compat.gymnax import make_gymnax
from rtd3jax.envs.description import Description, Drawing
from rtd3jax.envs.disturbed import (
    CHANNELS,
    Disturbed,
    DisturbedParams,
    acting_processes,
    check_composable,
    check_processes,
    disturb,
    sequence,
    warn_if_it_begins_too_late,
)
from rtd3jax.envs.entry import check_gymnax, own_parameters
from rtd3jax.envs.interface import describe
from rtd3jax.envs.processes.faults import (
    Delay,
    Dropout,
    GainDrift,
    OrnsteinUhlenbeck,
    Quantisation,
)
from rtd3jax.envs.processes.mixture import Mixture
from rtd3jax.envs.processes.process import NoDisturbance, Process, require
from rtd3jax.envs.stress import SIGNAL_STRESSES, Stress, factor_stress
from rtd3jax.errors import UserError, nearest
from rtd3jax.protocols import EnvironmentLike

_FAULTS: dict[str, tuple[str, Process]] = {
    "dropout": ("observation", Dropout()),
    "delay": ("observation", Delay()),
    "quantisation": ("observation", Quantisation()),
    "ornstein-uhlenbeck": ("observation", OrnsteinUhlenbeck()),
    "action-delay": ("action", Delay()),
    "gain-drift": ("action", GainDrift()),
}

FAULTS: tuple[str, ...] = tuple(_FAULTS)
"""Disturbances that fit any environment, also one of gymnax; they are not in the paper."""

NO_BASELINES = ("random", "ceiling", "upper bound")
"""Names that a baseline cannot have, because a study uses them for something else."""


@dataclasses.dataclass(frozen=True)
class _Entry:
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


_NONE: dict[str, tuple[str, Process]] = {"none": ("observation", NoDisturbance())}
_entries: dict[str, _Entry] = {}


def make(env_id: str, disturbance: str = "none", **parameters: Any) -> Any:
    """Make an environment whose ``default_params`` hold the disturbance and the parameters.

    Args:
        env_id: one of ``ENVIRONMENTS``, a registered id, a gymnax id, or a Gymnasium id after
            ``gymnasium:``.
        disturbance: a name, or several names joined by ``+``. Disturbances of one channel act in
            the order of the names. ``/`` separates alternatives, of which each episode draws one
            (see `rtd3jax.Mixture`; with ``weights=(2,1)``, it draws the first twice as often).
        **parameters: fields of a disturbance, or else of the environment's parameters. An
            environment with ``observed_reward`` also has ``reward_from`` ("state" or
            "observation"). Its default is "state"; for the pendulum's ``noise`` it is
            "observation", as in Section 5.2 of the paper [choice].

    Raises:
        UserError: for an unknown id, disturbance or parameter, or an impossible value.
    """
    entry = _entries.get(env_id)
    if entry is None and env_id in gymnax.registered_envs:
        remake = functools.partial(make_gymnax, env_id)
        entry = _Entry(make_gymnax(env_id), None, _NONE, "gymnax", with_params=remake)
    if entry is None and env_id.startswith(PREFIX):
        entry = _Entry(from_gymnasium(env_id.removeprefix(PREFIX)), None, _NONE, "gymnasium")
    if entry is None:
        hint = nearest(env_id, (*_entries, *gymnax.registered_envs))
        raise UserError(
            f"unknown environment {env_id!r}"
            f"{hint or '; import the module that registers it (--import in a command)'}"
        )
    if entry.construct is not None:
        return entry.construct(disturbance, **parameters)
    return _disturbed(env_id, entry, disturbance, parameters)


def register(
    env_id: str,
    env: EnvironmentLike | Callable[..., Any],
    disturbances: Mapping[str, Process | tuple[str, Process]] | None = None,
    *,
    positive: Iterable[str] = (),
    reward_from_observation: Iterable[str] = (),
    baselines: Mapping[str, Callable[[Any], Any]] | None = None,
    ceiling: Callable[[Any, int, int], Any] | None = None,
    drawing: Drawing | None = None,
    stresses: Iterable[Stress] = (),
    with_params: Callable[[Any], Any] | None = None,
    try_disturbances: bool = True,
    replace: bool = False,
) -> None:
    """Register an environment under a name, for ``make`` and the sweep.

    Args:
        env_id: a new id, or an id that the calling module has registered, whose entry is then
            replaced: a notebook's cell may run twice.
        env: a gymnax >= 1.0 environment, to which ``make`` applies parameters and disturbances; or
            a function ``(disturbance, **parameters)`` that returns an environment and applies both
            itself. The other arguments are for an environment, not for a function.
        disturbances: the disturbances of this environment besides "none" and ``FAULTS``: each name
            with a process of the observation, or with a pair (channel, process). A channel is one
            that `disturb` takes, or the name of a parameter of the environment that holds a
            process and acts inside the dynamics.
        positive: parameters of the environment that must be greater than zero. `rtd3jax.robustness`
            multiplies each that is a float by 0.5 to 2.
        reward_from_observation: names of disturbances under which the environment's
            ``observed_reward`` computes the reward from the observation that the agent received,
            unless ``make`` is called with ``reward_from``.
        baselines: policies that need no training, by name; see
            `rtd3jax.envs.description.Description`.
        ceiling: the best possible return, for `rtd3jax.ceiling` and a study; see
            `rtd3jax.envs.description.Description`.
        drawing: how the page of a study shows an episode.
        stresses: stresses of this environment for `rtd3jax.robustness`, besides those of any
            environment.
        with_params: a function that makes the environment with given default parameters, for
            example its class. With this function, ``make`` returns an unwrapped environment if no
            channel of `disturb` is disturbed. Without it, ``make`` always wraps the environment.
        try_disturbances: whether to trace the environment with each disturbance now, to find
            errors.
        replace: whether to replace an entry of another module. The ids of this package and of
            gymnax cannot be replaced.

    Raises:
        UserError: for an id or a name that is taken, or an ``env`` that is not an environment.
    """
    module = sys._getframe(1).f_globals.get("__name__", "")
    if not isinstance(env_id, str) or not env_id:
        raise UserError(f"an environment id must be a non-empty string, not {env_id!r}")
    is_environment = callable(getattr(env, "reset", None)) and callable(getattr(env, "step", None))
    if isinstance(env, type) or not (is_environment or callable(env)):
        raise UserError(f"{env_id!r} must be an environment or a function, not {env!r}")
    _check_free(env_id, module, replace)
    description = Description(dict(baselines or {}), ceiling, drawing, tuple(stresses))
    entry = _Entry(
        None,
        None,
        {},
        module,
        tuple(positive),
        tuple(reward_from_observation),
        with_params,
        description,
    )
    if not is_environment:
        if disturbances is not None or entry != _Entry(None, None, {}, module):
            raise UserError(
                f"{env_id!r}: disturbances, baselines and other arguments are for an environment, "
                "not for a function that makes one"
            )
        construct = cast("Callable[..., Any]", env)
        _entries[env_id] = dataclasses.replace(entry, construct=construct)
        return
    check_gymnax(env)
    if isinstance(env, Disturbed) and acting_processes(env.default_params):
        raise UserError(
            f"{env_id!r} is disturbed already, so its undisturbed observations would be unknown: "
            "register the environment itself, and name its processes in disturbances"
        )
    check_composable(env)
    env = cast("EnvironmentLike", env)
    named = _named_processes(env_id, env, disturbances or {}, try_disturbances)
    entry = dataclasses.replace(entry, env=env, disturbances=named)
    _check_extras(env_id, env, entry)
    factors = _factor_stresses(env_id, own_parameters(env), entry.positive, description.stresses)
    description = dataclasses.replace(description, stresses=(*description.stresses, *factors))
    known = next(
        (
            other.description
            for name, other in _entries.items()
            if name != env_id and other.env is not None and other.env == env
        ),
        None,
    )
    if known is not None:
        description = description.or_else(known)
    _entries[env_id] = dataclasses.replace(entry, description=description)


def description_of(env: EnvironmentLike, env_id: str | None = None) -> Description:
    """The description registered for ``env_id``, or else for an environment equal to ``env``.

    ``env`` may be disturbed. For an environment that is not registered, the description is empty.
    """
    if env_id in _entries:
        return _entries[env_id].description
    base = env.base if isinstance(env, Disturbed) else env
    known = (e.description for e in _entries.values() if e.env is not None and e.env == base)
    return next(known, Description())


def disturbances_of(env_id: str) -> tuple[str, ...]:
    """Names of the disturbances of a registered environment: its own, then ``FAULTS``."""
    return (*_entries[env_id].disturbances, *_FAULTS)


def _check_free(env_id: str, module: str, replace: bool) -> None:
    """Raise UserError if ``module`` may not register ``env_id``."""
    entry = _entries.get(env_id)
    ours = entry is not None and entry.registrant.startswith(f"{_PACKAGE}.")
    if ours or env_id in gymnax.registered_envs:
        raise UserError(f"environment {env_id!r} exists already; choose another id")
    if entry is not None and not replace and entry.registrant != module:
        raise UserError(
            f"environment {env_id!r} exists already, registered by {entry.registrant}; choose "
            "another id, or pass replace=True"
        )


_PACKAGE = __name__.partition(".")[0]


def _check_extras(env_id: str, env: EnvironmentLike, entry: _Entry) -> None:
    """Raise UserError if an argument of `register` does not fit the environment."""
    named, description = entry.disturbances, entry.description
    params = own_parameters(env)
    fields = list(_settable(params))
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


def _factor_stresses(
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


def _named_processes(
    env_id: str, env: EnvironmentLike, disturbances: Mapping[str, Any], tried: bool
) -> dict[str, tuple[str, Process]]:
    """Channel and process of each name; if ``tried``, each is traced with the environment."""
    named = dict(_NONE)
    for name, value in disturbances.items():
        if not re.fullmatch(r"[\w.-]+", name) or name in (*named, *_FAULTS):
            raise UserError(
                f"{env_id!r}: a disturbance cannot be called {name!r}; choose another name of "
                "letters, digits, '-', '.' and '_'"
            )
        channel, process = value if isinstance(value, tuple) else ("observation", value)
        params = own_parameters(env)
        if channel in CHANNELS or not isinstance(getattr(params, channel, None), Process):
            if tried:
                disturb(env, process, channel)
        elif not isinstance(process, Process):
            raise UserError(f"{env_id!r}: {name} needs a process, not {process!r}")
        else:
            process.validate()
            if tried:
                describe(env, params.replace(**{channel: process}))
        named[name] = channel, process
    return named


def parse_disturbance(text: str) -> tuple[str, dict[str, Any]]:
    """Parse ``"noise:sigma=1.0,reward_from=state"`` into a name and its parameters.

    A value is read as a Python literal (``elements=(0,1)``) if possible, else as a string.
    """
    disturbance, _, rest = text.strip().partition(":")
    if not disturbance:
        raise UserError(f"disturbance {text!r} has no name; write for example noise:sigma=1.0")
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


def _lookup(env_id: str, entry: _Entry, names: list[str]) -> list[tuple[str, Process]]:
    """Channel and process of each named disturbance."""
    known = {**entry.disturbances, **_FAULTS}
    for name in names:
        if name not in known:
            raise UserError(
                f"unknown disturbance {name!r} of {env_id}{nearest(name, known)} "
                f"(known: {', '.join(known)})"
            )
    return [known[name] for name in names]


def _disturbed(env_id: str, entry: _Entry, disturbance: str, parameters: dict[str, Any]) -> Any:
    """The entry's environment with its disturbances; each parameter goes to the one that has it."""
    base: Any = entry.env
    alternatives = [alternative.split("+") for alternative in disturbance.split("/")]
    names = [name for alternative in alternatives for name in alternative]
    channels, processes = zip(*_lookup(env_id, entry, names), strict=True)
    rest, reward_from = dict(parameters), "state"
    also: tuple[str, ...] = ()
    if hasattr(base, "observed_reward"):
        if all(set(part) & set(entry.reward_from_observation) for part in alternatives):
            reward_from = "observation"
        reward_from = rest.pop("reward_from", reward_from)
        also = ("reward_from",)
    what = f"{env_id} with {disturbance}"
    _check_owners(what, names, processes, rest)
    mixture = (Mixture(),) if len(alternatives) > 1 else ()
    if mixture:
        _check_one_channel(what, channels, processes)
    *assigned, params = _assign(what, (*processes, *mixture, base.default_params), rest, also)
    processes = tuple(assigned[: len(names)])
    for process in processes:
        process.validate()
    for name in entry.positive:
        require(params, name, above=0)
    if hasattr(params, "max_steps_in_episode"):
        require(params, "max_steps_in_episode", low=1)

    of_each = iter(zip(processes, channels, strict=True))
    alternatives_of = [[next(of_each) for _ in alternative] for alternative in alternatives]

    def on(channel: str) -> Process:
        members = [sequence(*(p for p, c in part if c == channel)) for part in alternatives_of]
        if not mixture or all(isinstance(member, NoDisturbance) for member in members):
            return sequence(*members)
        mixed = assigned[-1].replace(processes=tuple(members))
        mixed.validate()
        return mixed

    for channel in {channel for channel, _ in entry.disturbances.values()} - {*CHANNELS}:
        params = params.replace(**{channel: on(channel)})
    if entry.with_params is not None:
        base = entry.with_params(params)
        if all(isinstance(on(channel), NoDisturbance) for channel in CHANNELS):
            return base
    acting = {channel: on(channel) for channel in CHANNELS}
    env = Disturbed(base, reward_from, DisturbedParams(env=params, **acting))
    check_processes(env)
    warn_if_it_begins_too_late(env)
    return env


def _check_owners(
    what: str, names: list[str], processes: tuple[Process, ...], parameters: dict[str, Any]
) -> None:
    """Raise UserError for a parameter that several of the disturbances have."""
    for name in parameters:
        owners = [n for n, p in zip(names, processes, strict=True) if name in _settable(p)]
        if len(owners) > 1:
            raise UserError(
                f"{what}: {name!r} is a parameter of {' and of '.join(owners)}; "
                "combine such disturbances with rtd.disturb"
            )


def _check_one_channel(
    what: str, channels: tuple[str, ...], processes: tuple[Process, ...]
) -> None:
    """Raise UserError for alternatives that disturb different channels.

    Each channel would draw separately, so an episode would combine parts of several alternatives.
    """
    pairs = zip(channels, processes, strict=True)
    disturbed = {channel for channel, process in pairs if not isinstance(process, NoDisturbance)}
    if len(disturbed) > 1:
        raise UserError(
            f"{what}: alternatives must disturb the same channel, not the "
            f"{' and the '.join(sorted(disturbed))}; train on each of them separately"
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
            if any(hasattr(owner, name) for owner in owners):
                raise UserError(
                    f"{what}: the parameter {name!r} is no plain number or tuple of whole numbers, "
                    f"so it cannot be set by name: pass params=env.default_params.replace(...)"
                )
            known = [*(field for owned in fields for field in owned), *also]
            raise UserError(
                f"{what} has no parameter {name!r}{nearest(name, known)} "
                f"(known: {', '.join(known)})"
            )
    return tuple(
        owner.replace(**change) if change else owner
        for owner, change in zip(owners, changes, strict=True)
    )


def _settable(owner: object) -> dict[str, Any]:
    """The fields that can be set to a number or a tuple, with their defaults."""
    if not dataclasses.is_dataclass(owner):  # an environment's parameters may have any type
        return {}
    values = {field.name: getattr(owner, field.name) for field in dataclasses.fields(owner)}
    return {name: v for name, v in values.items() if isinstance(v, bool | int | float | tuple)}


def _coerce(what: str, name: str, value: object, default: bool | int | float | tuple) -> Any:
    """Convert ``value`` to the type of ``default``, or raise UserError."""
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
        if not isinstance(value, numbers.Integral) or isinstance(value, bool):
            raise UserError(f"{wrong} a whole number")
        return int(value)
    if not isinstance(value, numbers.Real) or isinstance(value, bool) or not math.isfinite(value):
        raise UserError(f"{wrong} a finite number")
    return float(value)


def _is_integer(value: object) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)
