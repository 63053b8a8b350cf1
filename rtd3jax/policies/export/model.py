"""An actor as plain arrays, and the recurrence that all export formats share.

To read a sliding window at every step takes ``l`` sequential products. The same numbers follow from
``l`` carries, each of which started at another step; one product advances all of them. Between
steps t-1 and t, row j - 1 of the state (j = 1..l) holds the carry after the tokens t-j..t-1. Step t
inserts a zero row at the front, feeds its token to all rows, and removes the last row. A row that
would start before the episode starts at the episode's first token instead, with a zero carry. So
**a state of zeros is the start of an episode**, and neither a counter nor a mask is needed. No row
is older than the window.

A policy with a running carry only has this carry, without an axis of rows, and reads one token per
step, for any history length. Its state at the start of an episode is zero too.

Tokens hold actions in half ranges from the centre of the environment's range: the tanh of the
output. Only the returned action is in the environment's units.

Shapes: ``B`` batch, ``l`` history length, ``H`` width, ``O`` and ``A`` sizes of an observation and
a flat action, ``D`` of a token.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.agents.memory import GRU, LSTM, Memory, MinGRU
from rtd3jax.agents.memory.base import Params
from rtd3jax.agents.networks import Linear, Network
from rtd3jax.agents.normalise import LIMIT, Normaliser
from rtd3jax.config import Acting
from rtd3jax.errors import UserError
from rtd3jax.registries import MEMORIES

GATES = "ifog"
"""Order of the gates in a folded model: the three sigmoids are adjacent."""

_TRAINED_GATES = "ifgo"


@dataclasses.dataclass(frozen=True)
class Model:
    """The data of an actor that the export formats need.

    Attributes:
        memory: parts of a token of the recurrent stream, from ``observation``, ``previous_action``
            and ``action``; empty without this stream.
        memory_has_current: whether the recurrent stream ends with the current token, so that the
            action is computed from the carries after this token.
        current: parts of the input of the feed-forward stream; empty without this stream.
        history_length: l.
        observation_size: O.
        action_shape: shape of the environment's action, A elements.
        arrays: the arrays from `fold`.
        metadata: JSON-ready facts for the header of the file.
        cell: the name of the memory; None without a memory.
        network: the actor as a module, for the format that traces it.
        params: the actor's parameters.
        acting: ``window`` or ``carry``, as in the policy.
    """

    memory: tuple[str, ...]
    memory_has_current: bool
    current: tuple[str, ...]
    history_length: int
    observation_size: int
    action_shape: tuple[int, ...]
    arrays: dict[str, np.ndarray]
    metadata: dict[str, Any]
    cell: str | None
    network: Network
    params: Params
    acting: Acting = "window"

    @property
    def has_running_carry(self) -> bool:
        """Whether the policy acts with a running carry from the start of the episode."""
        return self.acting == "carry"

    @property
    def width(self) -> int:
        """H, the width of every layer."""
        return self.network.head.outputs

    @property
    def action_size(self) -> int:
        """A, the number of elements of an action."""
        return self.network.output.outputs

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parts of the state for one episode, in the order of the files."""
        shapes: dict[str, tuple[int, ...]] = {}
        for name, shape in carry_shapes(self.network).items():
            shapes[name] = shape if self.has_running_carry else (self.history_length, *shape)
        if "previous_action" in (*self.memory, *self.current):
            shapes["previous_action"] = (self.action_size,)
        return shapes

    def header(self) -> dict[str, Any]:
        """``metadata``, and the arrays of the player's state, which starts as zeros."""
        return {
            **self.metadata,
            "memory": list(self.memory),
            "memory_has_current": self.memory_has_current,
            "current": list(self.current),
            "cell": self.cell,
            "state": {name: list(shape) for name, shape in self.state_shapes.items()},
            "initial_state": "zeros",
        }


def fold(
    actor: Mapping[str, Any],
    cell: str | None,
    low: ArrayLike,
    high: ArrayLike,
    centre_token: ArrayLike,
    normaliser: Normaliser | None = None,
) -> dict[str, np.ndarray]:
    """An actor's parameters as float32 arrays, with merged LSTM biases and gates as in `GATES`.

    Args:
        actor: nested parameters of a trained actor.
        cell: the name of the memory; None without a memory.
        low: [A], the lower bound of the action.
        high: [A], the upper bound of the action.
        centre_token: [A], the value in tokens for an action at the centre of its range; not among
            the arrays if it is zero.
        normaliser: the normalisation of observations, or None.
    """
    arrays: dict[str, ArrayLike] = {}
    for layer in ("encoder", "current", "head", "output"):
        if set(actor.get(layer, ())) == {"kernel", "bias"}:
            arrays[f"{layer}_kernel"] = actor[layer]["kernel"]
            arrays[f"{layer}_bias"] = actor[layer]["bias"]
    if cell is not None and _is_portable(cell):
        arrays |= _folded(cell, {name: np.asarray(a) for name, a in actor["memory"].items()})
    low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
    arrays["action_centre"] = np.float32(0.5) * high + np.float32(0.5) * low
    arrays["action_half_range"] = np.float32(0.5) * high - np.float32(0.5) * low
    # centre + half range may exceed the bound by a rounding error.
    arrays["action_low"], arrays["action_high"] = low, high
    if np.any(centre_token):
        arrays["centre_token"] = centre_token
    if normaliser is not None:
        arrays["observation_mean"] = normaliser.mean
        arrays["observation_scale"] = normaliser.scale
        arrays["observation_limit"] = LIMIT
    return {name: np.array(value, np.float32, order="C") for name, value in arrays.items()}


def _folded(cell: str, memory: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of one of the memories `PORTABLE`, from its parameters."""
    if cell == "lstm":
        return {
            "input_kernel": _reorder(memory["input_kernel"]),
            "input_bias": _reorder(memory["input_bias"] + memory["recurrent_bias"]),
            "recurrent_kernel": _reorder(memory["recurrent_kernel"]),
        }
    if cell == "gru":
        return memory
    return {f"input_{name}": array for name, array in memory.items()}


def _reorder(array: np.ndarray) -> np.ndarray:
    parts = dict(zip(_TRAINED_GATES, np.split(array, 4, axis=-1), strict=True))
    return np.concatenate([parts[gate] for gate in GATES], axis=-1)


PORTABLE: dict[str, type[Memory]] = {"lstm": LSTM, "gru": GRU, "min-gru": MinGRU}
"""Memories that the formats numpy and ONNX support; StableHLO supports any memory."""


def _is_portable(cell: str) -> bool:
    """Whether the memory ``cell`` is one of `PORTABLE`, and not another module of this name."""
    return cell in PORTABLE and MEMORIES[cell] is PORTABLE[cell]


def carry_shapes(network: Network) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the parts of a memory's carry for one episode."""
    carry = jax.eval_shape(lambda: network.zero_carry(1))
    leaves = jax.tree_util.tree_leaves_with_path(carry)
    if len(leaves) == 1:
        return {"hidden": leaves[0][1].shape[1:]}
    return {
        jax.tree_util.keystr(path, simple=True, separator="_"): leaf.shape[1:]
        for path, leaf in leaves
    }


def check_portable(model: Model, form: str) -> None:
    """Raise UserError if the format ``form`` does not support the model's memory or encoder."""
    if model.cell is not None and not _is_portable(model.cell):
        replaced = ", which another module has replaced here" if model.cell in PORTABLE else ""
        raise UserError(
            f"the format {form} supports the memories {', '.join(PORTABLE)} of this package, not "
            f"{model.cell!r}{replaced}; export the policy as stablehlo"
        )
    layers = (model.network.encoder, model.network.current)
    # A subclass may compute something else from the same parameters.
    if any(layer is not None and type(layer) is not Linear for layer in layers):
        raise UserError(
            f"the format {form} does not support this agent's encoder; export it as stablehlo"
        )
