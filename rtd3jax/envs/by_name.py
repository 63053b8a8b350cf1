"""Makes a registered environment with the disturbances and parameters that a name states."""

from typing import Any

from rtd3jax.envs.disturbed import (
    CHANNELS,
    Disturbed,
    DisturbedParams,
    check_processes,
    sequence,
    warn_if_it_begins_too_late,
)
from rtd3jax.envs.parameters import assign, settable
from rtd3jax.envs.processes.mixture import Mixture
from rtd3jax.envs.processes.process import NoDisturbance, Process, require
from rtd3jax.envs.registered import FAULT_PROCESSES, Registered, with_defaults
from rtd3jax.errors import UserError, nearest


def disturbed_by_name(
    env_id: str, entry: Registered, disturbance: str, parameters: dict[str, Any]
) -> Any:
    """The environment of ``entry`` under ``disturbance``, with ``parameters``.

    Each parameter goes to the named disturbance that has it, or else to the environment.

    Raises:
        UserError: for an unknown disturbance or parameter, or an impossible value.
    """
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
    *assigned, params = assign(what, (*processes, *mixture, base.default_params), rest, also)
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
        base = with_defaults(env_id, entry, params)
        if all(isinstance(on(channel), NoDisturbance) for channel in CHANNELS):
            return base
    acting = {channel: on(channel) for channel in CHANNELS}
    env = Disturbed(base, reward_from, DisturbedParams(env=params, **acting))
    check_processes(env)
    warn_if_it_begins_too_late(env)
    return env


def _lookup(env_id: str, entry: Registered, names: list[str]) -> list[tuple[str, Process]]:
    """Channel and process of each named disturbance."""
    known = {**entry.disturbances, **FAULT_PROCESSES}
    for name in names:
        if name not in known:
            raise UserError(
                f"unknown disturbance {name!r} of {env_id}{nearest(name, known)} "
                f"(known: {', '.join(known)})"
            )
    return [known[name] for name in names]


def _check_owners(
    what: str, names: list[str], processes: tuple[Process, ...], parameters: dict[str, Any]
) -> None:
    """Raise UserError for a parameter that several of the disturbances have."""
    for name in parameters:
        owners = [n for n, p in zip(names, processes, strict=True) if name in settable(p)]
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
