"""An actor as plain arrays, folded for play, and the recurrence that all exported forms share.

Reading a sliding window anew at every step costs ``l`` dependent products. The same numbers come
from ``l`` carries side by side, each begun at another step, which one product advances
together. Between steps t-1 and t, row j - 1 of the state (j = 1..l) holds the carry after the
tokens t-j..t-1. Step t puts a zero row in front, feeds its token to all rows, and drops the last.

Rows that would have begun before the episode begin at its first token instead, with a zero carry:
what does not exist leaves no trace. So **a state of zeros is the start of an episode**, and neither
a counter nor a mask is needed. No row is ever older than the window.

A policy that acts with a running carry has that one alone, without an axis of rows: one token a
step, whatever the history length. Zeros are the start there too.

Tokens hold actions in half ranges about the centre of the environment's range: the tanh of the
output. Only the action that leaves is in the environment's units.

Shapes: ``B`` batch, ``l`` history length, ``H`` width, ``O`` and ``A`` sizes of an observation and
a flat action, ``D`` of a token.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from rtd3jax.agents.memory.base import Params
from rtd3jax.agents.networks import Linear, Network
from rtd3jax.agents.normalise import LIMIT, Normaliser
from rtd3jax.errors import UserError

GATES = "ifog"
"""Order of the gates in a folded model: the three sigmoids stand together."""

_TRAINED_GATES = "ifgo"


@dataclasses.dataclass(frozen=True)
class Model:
    """What an exported form needs.

    Attributes:
        memory: parts of a token of the recurrent stream, of ``observation``, ``previous_action``
            and ``action``; empty for none.
        memory_has_current: whether that stream ends with the current token, so that the action
            is computed from the carries after this step's token and not before it.
        current: parts of the feed-forward stream's input; empty for none.
        history_length: l.
        observation_size: O.
        action_shape: shape of the environment's action, A elements.
        arrays: of `fold`.
        metadata: JSON-ready facts that travel with the file.
        cell: the name of its memory; None without one.
        network: the actor as a module, for the form that traces it.
        params: its parameters.
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
    acting: str = "window"

    @property
    def runs_on(self) -> bool:
        """Whether the carry runs on from the episode's start."""
        return self.acting == "carry"

    @property
    def width(self) -> int:
        """H."""
        return self.network.head.outputs

    @property
    def action_size(self) -> int:
        """A."""
        return self.network.output.outputs

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the state's parts for one episode, in the order in which files list them."""
        shapes: dict[str, tuple[int, ...]] = {}
        for name, shape in carry_shapes(self.network).items():
            shapes[name] = shape if self.runs_on else (self.history_length, *shape)
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
    """An actor's parameters as float32 arrays: an LSTM's biases merged, its gates as in `GATES`.

    Args:
        actor: nested parameters of a trained actor.
        cell: the name of its memory; None without one.
        low: [A], the action's lower bound.
        high: [A], its upper bound.
        centre_token: [A], what tokens hold for an action at the centre; left out where it is zero.
        normaliser: of observations; left out where there is none.
    """
    arrays: dict[str, ArrayLike] = {}
    for layer in ("encoder", "current", "head", "output"):
        if set(actor.get(layer, ())) == {"kernel", "bias"}:
            arrays[f"{layer}_kernel"] = actor[layer]["kernel"]
            arrays[f"{layer}_bias"] = actor[layer]["bias"]
    memory = {name: np.asarray(value) for name, value in actor.get("memory", {}).items()}
    if cell == "lstm":
        arrays["input_kernel"] = _reorder(memory["input_kernel"])
        arrays["input_bias"] = _reorder(memory["input_bias"] + memory["recurrent_bias"])
        arrays["recurrent_kernel"] = _reorder(memory["recurrent_kernel"])
    elif cell == "gru":
        arrays |= memory
    elif cell == "min-gru":
        arrays |= {f"input_{name}": array for name, array in memory.items()}
    low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
    arrays["action_centre"] = np.float32(0.5) * (high + low)
    arrays["action_half_range"] = np.float32(0.5) * (high - low)
    if np.any(centre_token):
        arrays["centre_token"] = centre_token
    if normaliser is not None:
        arrays["observation_mean"] = normaliser.mean
        arrays["observation_scale"] = normaliser.scale
        arrays["observation_limit"] = LIMIT
    return {name: np.array(value, np.float32, order="C") for name, value in arrays.items()}


def _reorder(array: np.ndarray) -> np.ndarray:
    parts = dict(zip(_TRAINED_GATES, np.split(array, 4, axis=-1), strict=True))
    return np.concatenate([parts[gate] for gate in GATES], axis=-1)


PORTABLE = ("lstm", "gru", "min-gru")
"""Memories that the forms numpy and ONNX know; StableHLO takes any."""


def carry_shapes(network: Network) -> dict[str, tuple[int, ...]]:
    """The parts of a memory's carry for one episode: their names and shapes."""
    carry = jax.eval_shape(lambda: network.zero_carry(1))
    leaves = jax.tree_util.tree_leaves_with_path(carry)
    if len(leaves) == 1:
        return {"hidden": leaves[0][1].shape[1:]}
    return {
        jax.tree_util.keystr(path, simple=True, separator="_"): leaf.shape[1:]
        for path, leaf in leaves
    }


def check_portable(model: Model, form: str) -> None:
    """Raise UserError where ``form`` does not know the model's memory or one of its layers."""
    if model.cell is not None and model.cell not in PORTABLE:
        raise UserError(
            f"the form {form} knows the memories {', '.join(PORTABLE)}, not {model.cell!r}; "
            "export the policy as stablehlo"
        )
    layers = (model.network.encoder, model.network.current)
    if any(layer is not None and not isinstance(layer, Linear) for layer in layers):
        raise UserError(
            f"the form {form} does not know this agent's encoder; export the policy as stablehlo"
        )
