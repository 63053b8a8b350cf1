"""The registry: makes environments from the names of environment, disturbance and parameters."""

import dataclasses
import functools
import sys
from collections.abc import Callable, Iterable, Mapping
from typing import Any, cast

import gymnax
import jax
import numpy as np

from rtd3jax.envs.by_name import disturbed_by_name
from rtd3jax.envs.compat.from_gymnasium import PREFIX, from_gymnasium
from rtd3jax.envs.compat.gymnax import make_gymnax
from rtd3jax.envs.description import Description, Drawing
from rtd3jax.envs.disturbed import (
    Disturbed,
    DisturbedParams,
    acting_processes,
    check_composable,
)
from rtd3jax.envs.entry import check_gymnax, own_parameters
from rtd3jax.envs.interface import environment_name
from rtd3jax.envs.parameters import parse_disturbance
from rtd3jax.envs.processes.process import Process
from rtd3jax.envs.registered import (
    FAULT_PROCESSES,
    NONE,
    Registered,
    check_extras,
    factor_stresses,
    named_processes,
    with_defaults,
)
from rtd3jax.envs.stress import Stress
from rtd3jax.envs.words import in_words
from rtd3jax.errors import UserError, nearest
from rtd3jax.protocols import EnvironmentLike

_entries: dict[str, Registered] = {}


def make(env_id: str, disturbance: str = "none", **parameters: Any) -> Any:
    """Make an environment whose ``default_params`` hold the disturbance and the parameters.

    Args:
        env_id: one of ``ENVIRONMENTS``, a registered id, a gymnax id, or a Gymnasium id after
            ``gymnasium:``.
        disturbance: a name, or several names joined by ``+``. Disturbances of one channel act in
            the order of the names. ``/`` separates alternatives, of which each episode draws one
            (see `rtd3jax.Mixture`; with ``weights=(2,1)``, it draws the first twice as often).
            Parameters may follow, as in the commands: ``noise:sigma=1.0,reward_from=state``.
        **parameters: fields of a disturbance, or else of the environment's parameters. An
            environment with ``observed_reward`` also has ``reward_from`` ("state" or
            "observation"). Its default is "state"; for the pendulum's ``noise`` it is
            "observation", as in Section 5.2 of the paper [choice].

    Raises:
        UserError: for an unknown id, disturbance or parameter, or an impossible value.
    """
    if not isinstance(env_id, str):
        if callable(getattr(env_id, "reset", None)) and not isinstance(env_id, type):
            raise UserError(
                f"make takes the name of an environment, and this {environment_name(env_id)} is "
                "an environment already: use rtd.disturb(env, process) to disturb it"
            )
        raise UserError(f"an environment's name is a string such as 'rover', not {env_id!r}")
    disturbance, own = parse_disturbance(disturbance)
    if twice := sorted(own.keys() & parameters.keys()):
        raise UserError(f"{twice[0]!r} is given twice: in the disturbance and as an argument")
    parameters |= own
    entry = _entries.get(env_id)
    if entry is None and env_id in gymnax.registered_envs:
        remake = functools.partial(make_gymnax, env_id)
        entry = Registered(make_gymnax(env_id), None, NONE, "gymnax", with_params=remake)
    if entry is None and env_id.startswith(PREFIX):
        entry = Registered(from_gymnasium(env_id.removeprefix(PREFIX)), None, NONE, "gymnasium")
    if entry is None:
        hint = nearest(env_id, (*_entries, *gymnax.registered_envs))
        raise UserError(
            f"unknown environment {env_id!r}"
            f"{hint or '; import the module that registers it (--import in a command)'}"
        )
    if entry.construct is not None:
        return entry.construct(disturbance, **parameters)
    return disturbed_by_name(env_id, entry, disturbance, parameters)


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
            process and acts inside the dynamics. Without a disturbance of this channel, ``make``
            sets the parameter to ``NoDisturbance()``, so this must be its default.
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
            example its class; this environment must be equal to ``env`` (`rtd3jax.ValueIdentity`).
            With this function, ``make`` returns an unwrapped environment if no channel of `disturb`
            is disturbed. Without it, ``make`` always wraps the environment.
        try_disturbances: whether to trace the environment with each disturbance now, and to call
            ``with_params``, to find errors.
        replace: whether to replace an entry of another module. The ids of this package and of
            gymnax cannot be replaced.

    Raises:
        UserError: for an id or a name that is taken, an ``env`` that is not an environment, or an
            argument that does not fit it.
    """
    module = sys._getframe(1).f_globals.get("__name__", "")
    if not isinstance(env_id, str) or not env_id:
        raise UserError(f"an environment id must be a non-empty string, not {env_id!r}")
    is_environment = callable(getattr(env, "reset", None)) and callable(getattr(env, "step", None))
    if isinstance(env, type) or not (is_environment or callable(env)):
        raise UserError(f"{env_id!r} must be an environment or a function, not {env!r}")
    if not isinstance(disturbances, Mapping | None):
        raise UserError(f"{env_id!r}: disturbances must be a dict, not {disturbances!r}")
    _check_free(env_id, module, replace)
    description = Description(dict(baselines or {}), ceiling, drawing, tuple(stresses))
    entry = Registered(
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
        if disturbances is not None or entry != Registered(None, None, {}, module):
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
    named = named_processes(env_id, env, disturbances or {}, try_disturbances)
    entry = dataclasses.replace(entry, env=env, disturbances=named)
    check_extras(env_id, env, entry)
    if with_params is not None and try_disturbances:
        with_defaults(env_id, entry, own_parameters(env))
    factors = factor_stresses(env_id, own_parameters(env), entry.positive, description.stresses)
    description = dataclasses.replace(description, stresses=(*description.stresses, *factors))
    # Another id of a registered environment takes the parts that are not given from its entry.
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

    Several ids may stand for equal environments with other default parameters, because parameters
    do not matter for equality. The description is then that of the id whose default parameters
    differ the least from those of ``env``; of ids with the same ones, that of the first in the
    registry, so that a later id does not change what an earlier one means. Only ``env_id`` can tell
    such ids apart.
    """
    if env_id in _entries:
        return _entries[env_id].description
    base = env.base if isinstance(env, Disturbed) else env
    known = [e for e in _entries.values() if e.env is not None and e.env == base]
    if len(known) > 1:
        params = getattr(env, "default_params", None)
        params = params.env if isinstance(params, DisturbedParams) else params
        known = sorted(known, key=lambda entry: _differences(entry.env, params))
    return known[0].description if known else Description()


def _differences(env: EnvironmentLike | None, params: object) -> int:
    """How many of ``params`` differ from the default parameters of ``env``."""
    own = getattr(env, "default_params", None)
    one, other = (dict(jax.tree_util.tree_leaves_with_path(tree)) for tree in (own, params))
    options = in_words(own, numbers=False) != in_words(params, numbers=False)
    return options + sum(
        not (path in one and path in other and np.array_equal(one[path], other[path]))
        for path in one.keys() | other.keys()
    )


def disturbances_of(env_id: str) -> tuple[str, ...]:
    """Names of the disturbances of a registered environment: its own, then ``FAULTS``."""
    return (*_entries[env_id].disturbances, *FAULT_PROCESSES)


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
