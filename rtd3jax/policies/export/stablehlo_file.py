"""The StableHLO format: a portable XLA program for any batch size and later versions of JAX.

The file is a safetensors file with one array of bytes, ``program``, and the policy's header.
"""

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.agents.memory.base import Params
from rtd3jax.errors import UserError, short_reason
from rtd3jax.policies.export.model import Model, carry_shapes
from rtd3jax.system.files import array_bytes, read_arrays

PLATFORMS = ("cpu", "cuda", "rocm", "tpu")
"""Platforms on which the program can run."""

FORMAT = 1
_KIND = "stablehlo"

State = dict[str, jax.Array]


def stablehlo_bytes(model: Model) -> bytes:
    """The file with ``(state, observation [B, O]) -> (action [B, *action_shape], state)``.

    Raises:
        UserError: when the package flatbuffers is missing.
    """
    _require_flatbuffers()
    # The constants are made here, because their order would not be fixed in the traced function.
    params = jax.tree.map(jnp.asarray, model.params)
    arrays = {name: jnp.asarray(array) for name, array in model.arrays.items()}
    (batch,) = jax.export.symbolic_shape("batch")

    def spec(shape: tuple[int, ...]) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct((batch, *shape), jnp.float32)

    def policy_step(state: State, observation: jax.Array) -> tuple[jax.Array, State]:
        # Otherwise accelerators would round the factors of float32 products to fewer bits.
        with jax.default_matmul_precision("highest"):
            return play(model, params, arrays, state, observation)

    with _no_source_locations():
        exported = jax.export.export(jax.jit(policy_step), platforms=PLATFORMS)(
            {name: spec(shape) for name, shape in model.state_shapes.items()},
            spec((model.observation_size,)),
        )
        program = np.frombuffer(bytes(exported.serialize()), np.uint8)
    header = {**model.header(), "kind": _KIND, "format": FORMAT}
    return array_bytes({"program": program}, header)


def play(
    model: Model, params: Params, arrays: State, state: State, observation: jax.Array
) -> tuple[jax.Array, State]:
    """The recurrence of `rtd3jax.policies.export.model` for ``observation`` [B, O].

    It works for any memory and any layers. The rows of carries are a batch for the memory's method
    ``step``.
    """
    network, variables = model.network, {"params": params}
    parts = {"observation": _normalised(observation, arrays)}
    if "previous_action" in state:
        parts["previous_action"] = state["previous_action"]
    batch = observation.shape[0]

    def feed(carry: list[jax.Array]) -> list[jax.Array]:
        token = jnp.concatenate([parts[part] for part in model.memory], axis=-1)
        encoded = network.apply(variables, token[None], method="encode")[0]
        rows = carry[0].shape[1]
        repeated = jnp.repeat(encoded, rows, axis=0)
        flat = [part.reshape(batch * rows, *part.shape[2:]) for part in carry]
        after = network.apply(
            variables,
            jax.tree.unflatten(structure, flat),
            repeated,
            method=lambda m, c, x: m.memory.step(c, x),
        )
        return [part.reshape(batch, rows, *part.shape[1:]) for part in jax.tree.leaves(after)]

    names = list(carry_shapes(network))
    carry: list[jax.Array] = []
    feature = None
    if model.memory:
        structure = jax.tree.structure(jax.eval_shape(lambda: network.zero_carry(1)))
        carry = [
            state[n][:, None] if model.has_running_carry else _with_zero_row(state[n])
            for n in names
        ]
        if model.memory_has_current:
            carry = feed(carry)
        last = jax.tree.unflatten(structure, [part[:, -1] for part in carry])
        feature = network.apply(variables, last, method=lambda m, c: m.memory.read(c))
        if not model.has_running_carry:
            carry = [part[:, :-1] for part in carry]
    current = None
    if model.current:
        current = jnp.concatenate([parts[part] for part in model.current], axis=-1)
    token = jnp.tanh(
        jnp.asarray(network.apply(variables, feature, current, method="from_features"))
    )
    action = arrays["action_centre"][None, :] + arrays["action_half_range"][None, :] * token
    action = jnp.clip(action, arrays["action_low"][None, :], arrays["action_high"][None, :])
    if "centre_token" in arrays:
        token = token + arrays["centre_token"][None, :]
    parts["action"] = token
    if model.memory and not model.memory_has_current:
        carry = feed(carry)
    if model.has_running_carry:
        carry = [part[:, 0] for part in carry]
    following = {"previous_action": token, **dict(zip(names, carry, strict=True))}
    action = action.reshape(-1, *model.action_shape)
    return action, {name: following[name] for name in model.state_shapes}


def _normalised(observation: jax.Array, arrays: State) -> jax.Array:
    if "observation_mean" not in arrays:
        return observation
    limit = arrays["observation_limit"]
    centred = observation - arrays["observation_mean"][None, :]
    return jnp.clip(centred * arrays["observation_scale"][None, :], -limit, limit)


def _with_zero_row(rows: jax.Array) -> jax.Array:
    """``rows`` [B, l, ...] after a row of zeros, the carry that starts at this step."""
    return jnp.pad(rows, ((0, 0), (1, 0), *[(0, 0)] * (rows.ndim - 2)))


@contextlib.contextmanager
def _no_source_locations() -> Iterator[None]:
    """Keep source locations, and so this machine's paths, out of the program."""
    option = "jax_traceback_in_locations_limit"
    limit = getattr(jax.config, option)
    jax.config.update(option, 0)
    try:
        yield
    finally:
        jax.config.update(option, limit)


def _require_flatbuffers() -> None:
    try:
        import flatbuffers  # noqa: F401, jax.export serialises with it without requiring it
    except ImportError as error:
        raise UserError(
            "StableHLO files need the package flatbuffers: pip install 'rtd3jax[stablehlo]'"
        ) from error


class StableHlo:
    """A policy loaded from a StableHLO file; it takes batches, and can be called under jit.

    Attributes:
        metadata: the file's header.
    """

    def __init__(self, metadata: dict[str, Any], exported: jax.export.Exported):
        self.metadata = metadata
        self.observation_size = int(metadata["observation_size"])
        self._call = jax.jit(exported.call)

    def init(self, batch: int = 1) -> State:
        """The state before the first step of ``batch`` episodes: zeros, [batch, ...]."""
        return {
            name: jnp.zeros((batch, *shape), jnp.float32)
            for name, shape in self.metadata["state"].items()
        }

    def step(self, state: State, observation: ArrayLike) -> tuple[jax.Array, State]:
        """Actions [B, *action_shape] for observations [B, O], and the state after them.

        The program needs float32, so observations of another type are converted.

        Raises:
            UserError: when the observations have another size.
        """
        if isinstance(observation, jax.Array):
            observation = observation.astype(jnp.float32)
        else:
            observation = np.asarray(observation, np.float32)
        if observation.ndim != 2 or observation.shape[1] != self.observation_size:
            raise UserError(
                f"the policy expects observations of shape (batch, {self.observation_size}), "
                f"not {observation.shape}"
            )
        return self._call(state, observation)


def load_stablehlo(path: str | os.PathLike) -> StableHlo:
    """The policy that ``policy.export(path, format="stablehlo")`` wrote.

    Raises:
        UserError: when the file is missing, damaged, of another kind, or of another format; when
            the package flatbuffers is missing.
    """
    _require_flatbuffers()
    arrays, metadata = read_arrays(path)
    if not isinstance(metadata, dict) or metadata.get("kind") != _KIND or "program" not in arrays:
        raise UserError(f"{path} is not a policy in the StableHLO format")
    if metadata.get("format") != FORMAT:
        raise UserError(
            f"{path} has format {metadata.get('format')}, and this version of rtd3jax reads format "
            f"{FORMAT}: use the version that wrote the file, or a newer version"
        )
    try:
        exported = jax.export.deserialize(bytearray(arrays["program"].tobytes()))
    except Exception as error:  # JAX raises many types of errors here
        reason = short_reason(error)
        raise UserError(f"{path} cannot be read by this version of JAX ({reason})") from error
    return StableHlo(metadata, exported)
