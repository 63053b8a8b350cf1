"""Reads saved policies: checks their arrays and headers, and restores the policies."""

import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.memory.base import Params
from rtd3jax.agents.networks import NetworkSpec, init_network, part_sizes
from rtd3jax.agents.normalise import Normaliser
from rtd3jax.config import ACTINGS, Acting
from rtd3jax.envs.interface import Interface
from rtd3jax.errors import UserError
from rtd3jax.policies.trained import CARRY_FORMAT, FORMAT, KIND, NORMALISED_FORMAT, Policy
from rtd3jax.registries import AGENTS, MEMORIES
from rtd3jax.system.files import flatten, read_arrays, unflatten

_FORMATS = (1, FORMAT, CARRY_FORMAT, NORMALISED_FORMAT)
_ACTIONS = ("action", "previous_action")
_OLD_NAME = re.compile(r"^lstm\.")
"""Prefix of the memory's arrays in files of versions whose only memory was the LSTM."""


def read_policy(path: str | os.PathLike) -> Policy:
    """The policy that `Policy.save` wrote.

    Raises:
        UserError: when the file is missing, damaged, of another kind or of a newer format, or when
            its arrays do not agree with its header.
    """
    arrays, metadata = read_arrays(path)
    if isinstance(metadata, dict) and "cell" in metadata and "seed" in metadata:
        parents = Path(path).resolve().parents
        run = parents[2] if len(parents) > 2 and (parents[2] / "config.json").exists() else None
        where = "its run directory" if run is None else repr(str(run))
        raise UserError(
            f"{path} is a lane of a run directory, not a saved policy: load it with "
            f"load_policy({where}, algorithm=..., seed={metadata['seed']})"
        )
    if not isinstance(metadata, dict) or metadata.get("kind") != KIND:
        raise UserError(f"{path} is not a saved policy")
    if metadata.get("format") not in _FORMATS:
        raise UserError(
            f"{path} has format {metadata.get('format')}, and this version of rtd3jax reads up to "
            f"{NORMALISED_FORMAT}: use the version that wrote the file, or a newer version"
        )
    interface, facts = _header(path, metadata)
    normaliser = under_prefix(arrays, "normaliser")
    if (metadata["format"] == NORMALISED_FORMAT) != bool(normaliser):
        raise UserError(f"{path} is damaged: its arrays do not agree with its format")
    actor = {name: array for name, array in arrays.items() if not name.startswith("normaliser.")}
    return restore_policy(path, actor, interface, normaliser=normaliser, **facts)


def restore_policy(
    path: str | os.PathLike,
    actor: Mapping[str, np.ndarray],
    interface: Interface,
    *,
    algorithm: str,
    history_length: int,
    width: int,
    memory: str = "lstm",
    acting: Acting = "window",
    format: int = FORMAT,
    centre_token: np.ndarray | None = None,
    normaliser: Mapping[str, np.ndarray] | None = None,
) -> Policy:
    """The policy from an actor's arrays under dotted names.

    Args:
        path: the file of the arrays, for messages.
        actor: the arrays.
        interface: sizes and bounds of the policy's environment.
        algorithm: the name of the agent.
        history_length: l; 0 for td3.
        width: H.
        memory: the name of the recurrent cell.
        acting: ``window`` or ``carry``, as in the policy.
        format: the format of the file; an actor of format 1 is converted.
        centre_token: [A], as in the policy; zero by default.
        normaliser: ``mean`` and ``scale`` [O] of the normaliser; None or empty without one.

    Raises:
        UserError: when an array is missing, unexpected, not finite, or of another shape or type.
    """
    spec = AGENTS[algorithm].actor
    sizes = part_sizes(interface.observation_size, interface.action_size)
    network = make_part(AGENTS[algorithm], "actor", memory, *interface.sizes, width)
    shapes = jax.eval_shape(lambda: init_network(jax.random.key(0), network))
    actor = {_OLD_NAME.sub("memory.", name): array for name, array in actor.items()}
    expected = flatten(
        jax.tree.map(lambda leaf: np.broadcast_to(np.float32(0), leaf.shape), shapes)
    )
    for name in sorted(expected.keys() ^ actor.keys()):
        what = "lacks the array" if name in expected else "has an unexpected array:"
        raise UserError(f"{path} does not fit {algorithm}: it {what} {name}")
    for name, like in expected.items():
        array = actor[name]
        if array.shape != like.shape:
            kind = "for another environment or width" if name.endswith("kernel") else "damaged"
            raise UserError(
                f"{path} does not fit {algorithm} with {interface.observation_size} observation "
                f"elements, {interface.action_size} action elements and width {width}: {name} has "
                f"shape {list(array.shape)}, not {list(like.shape)}; the policy is {kind}"
            )
        if array.dtype != np.float32:
            raise UserError(f"{path}: {name} is {array.dtype}, not float32")
        if not np.all(np.isfinite(array)):
            raise UserError(f"{path}: the weights are not finite ({name})")
    bounds = Bounds(jnp.asarray(interface.action_low), jnp.asarray(interface.action_high))
    if centre_token is None:
        centre_token = np.zeros(interface.action_size, np.float32)
    tree = unflatten(actor)
    if format == 1:
        tree = _in_half_ranges(tree, spec, sizes, np.asarray(bounds.half_range))
        centre_token = np.asarray(bounds.centre / bounds.half_range)
    return Policy(
        actor=jax.tree.map(jnp.asarray, tree),
        bounds=bounds,
        history_length=jnp.int32(history_length),
        centre_token=jnp.asarray(centre_token),
        algorithm=algorithm,
        window_tokens=history_length,
        observation_size=interface.observation_size,
        action_shape=interface.action_shape,
        memory=memory,
        acting=acting,
        normaliser=_normaliser(path, normaliser, interface.observation_size),
    )


def under_prefix(arrays: Mapping[str, np.ndarray], name: str) -> dict[str, np.ndarray]:
    """The arrays whose dotted names begin with ``name``, which is removed from the names."""
    return {n.removeprefix(f"{name}."): a for n, a in arrays.items() if n.startswith(f"{name}.")}


def _normaliser(
    path: str | os.PathLike, arrays: Mapping[str, np.ndarray] | None, size: int
) -> Normaliser | None:
    if not arrays:
        return None
    if set(arrays) != {"mean", "scale"}:
        raise UserError(f"{path} is damaged: its normaliser has {', '.join(arrays)}")
    for name, array in arrays.items():
        sound = array.shape == (size,) and array.dtype == np.float32 and np.isfinite(array).all()
        if not sound:
            raise UserError(
                f"{path} is damaged: its normaliser's {name} is not {size} finite numbers"
            )
    return Normaliser(jnp.asarray(arrays["mean"]), jnp.asarray(arrays["scale"]))


def _in_half_ranges(
    actor: Params, spec: NetworkSpec, sizes: dict[str, int], half_range: np.ndarray
) -> Params:
    """Convert an actor that reads actions in the environment's units to half ranges.

    The weights of actions are multiplied by ``half_range`` [A].
    """
    actor = dict(actor)
    for layer, parts in (("encoder", spec.memory), ("current", spec.current)):
        if parts:
            scales = [half_range if p in _ACTIONS else np.ones(sizes[p]) for p in parts]
            column = np.concatenate(scales).astype(np.float32)[:, None]
            actor[layer] = {**actor[layer], "kernel": column * actor[layer]["kernel"]}
    return actor


def _header(path: str | os.PathLike, metadata: dict[str, Any]) -> tuple[Interface, dict[str, Any]]:
    """Check a file's header; return the interface and the other arguments of `restore_policy`."""
    wrong = f"{path} is damaged: its header's"
    algorithm, memory = metadata.get("algorithm"), metadata.get("memory", "lstm")
    if not isinstance(algorithm, str) or algorithm not in AGENTS:
        raise UserError(
            f"{path}: the agent {algorithm!r} is not known here, only {', '.join(AGENTS)}; "
            "register it with rtd.register_agent before you load the policy"
        )
    if memory not in MEMORIES:
        raise UserError(
            f"{path}: the memory {memory!r} is not known here, only {', '.join(MEMORIES)}; "
            "register it with rtd.register_memory before you load the policy"
        )
    acting = metadata.get("acting", "window")
    if acting not in ACTINGS:
        raise UserError(f"{wrong} acting is {acting!r}, not {' or '.join(ACTINGS)}")
    windowed = AGENTS[algorithm].has_window
    lowest = {"hidden_size": 1, "history_length": windowed}
    for name, least in lowest.items():
        if not _is_count(metadata.get(name), int(least)):
            raise UserError(f"{wrong} {name} is {metadata.get(name)!r}")
    interface = read_interface(path, metadata)
    size = interface.action_size
    centre_token = np.asarray(metadata.get("centre_token", np.zeros(size)), np.float32)
    if centre_token.shape != (size,) or not np.all(np.isfinite(centre_token)):
        raise UserError(f"{wrong} centre_token is not {size} numbers")
    return interface, {
        "format": metadata["format"],
        "centre_token": centre_token,
        "algorithm": algorithm,
        "memory": memory,
        "acting": acting,
        "history_length": metadata["history_length"],
        "width": metadata["hidden_size"],
    }


def read_interface(path: str | os.PathLike, metadata: Mapping[str, Any]) -> Interface:
    """Check and return the sizes and bounds in a file's header.

    Raises:
        UserError: when they are not valid.
    """
    wrong = f"{path} is damaged: its header's"
    if not _is_count(metadata.get("observation_size"), 1):
        raise UserError(f"{wrong} observation_size is {metadata.get('observation_size')!r}")
    shape = metadata.get("action_shape")
    if not isinstance(shape, list) or not all(_is_count(n, 1) for n in shape):
        raise UserError(f"{wrong} action_shape is {shape!r}")
    size = math.prod(shape)
    try:
        low, high = (np.asarray(metadata[f"action_{e}"], np.float32) for e in ("low", "high"))
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{wrong} action bounds are not numbers") from error
    fit = low.shape == high.shape == (size,) and np.all(np.isfinite([low, high]))
    if not fit or not np.all(low < high):
        raise UserError(f"{wrong} action bounds are not {size} pairs of low < high")
    return Interface(metadata["observation_size"], tuple(shape), size, low, high)


def _is_count(value: object, low: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and low <= value < 2**31
