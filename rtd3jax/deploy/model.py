"""An actor as plain arrays, folded for play, and the recurrence that all exported forms share.

Reading a sliding window anew at every step costs ``l`` dependent products. The same numbers come
from ``l`` LSTM carries side by side, each begun at another step, which one product advances
together. Between steps t-1 and t, row j - 1 of the state (j = 1..l) holds the carry after the
tokens t-j..t-1. Step t puts a zero row in front, feeds its token to all rows, and drops the last.

Rows that would have begun before the episode begin at its first token instead, with a zero carry:
what does not exist leaves no trace. So **a state of zeros is the start of an episode**, and neither
a counter nor a mask is needed. No row is ever older than the window.

Tokens hold actions in half ranges about the centre of the environment's range: the tanh of the
output. Only the action that leaves is in the environment's units.

Shapes: ``B`` batch, ``l`` history length, ``H`` width, ``O`` and ``A`` sizes of an observation and
a flat action, ``D`` of a token.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

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
        about: JSON-ready facts that travel with the file.
    """

    memory: tuple[str, ...]
    memory_has_current: bool
    current: tuple[str, ...]
    history_length: int
    observation_size: int
    action_shape: tuple[int, ...]
    arrays: dict[str, np.ndarray]
    about: dict[str, Any]

    @property
    def width(self) -> int:
        """H."""
        return self.arrays["head_bias"].size

    @property
    def action_size(self) -> int:
        """A."""
        return self.arrays["output_bias"].size

    @property
    def state_shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the state's parts for one episode, in the order in which files list them."""
        shapes: dict[str, tuple[int, ...]] = {}
        if self.memory:
            shapes["hidden"] = shapes["cell"] = (self.history_length, self.width)
        if "previous_action" in (*self.memory, *self.current):
            shapes["previous_action"] = (self.action_size,)
        return shapes

    def header(self) -> dict[str, Any]:
        """``about`` and what a player must know: the parts of the state, which starts as zeros."""
        return {
            **self.about,
            "memory": list(self.memory),
            "memory_has_current": self.memory_has_current,
            "current": list(self.current),
            "state": {name: list(shape) for name, shape in self.state_shapes.items()},
            "initial_state": "zeros",
        }


def fold(actor: Mapping[str, Any], low: Any, high: Any, centre_token: Any) -> dict[str, np.ndarray]:
    """An actor's parameters as float32 arrays: biases merged, gates in the order of `GATES`.

    Args:
        actor: nested parameters of a trained actor.
        low: [A], the action's lower bound.
        high: [A], its upper bound.
        centre_token: [A], what tokens hold for an action at the centre; left out where it is zero.
    """
    arrays = {}
    for layer in ("encoder", "current", "head", "output"):
        if layer in actor:
            arrays[f"{layer}_kernel"] = actor[layer]["kernel"]
            arrays[f"{layer}_bias"] = actor[layer]["bias"]
    if "lstm" in actor:
        lstm = {name: np.asarray(value) for name, value in actor["lstm"].items()}
        arrays["input_kernel"] = _reorder(lstm["input_kernel"])
        arrays["input_bias"] = _reorder(lstm["input_bias"] + lstm["recurrent_bias"])
        arrays["recurrent_kernel"] = _reorder(lstm["recurrent_kernel"])
    low, high = np.asarray(low, np.float32), np.asarray(high, np.float32)
    arrays["action_centre"] = np.float32(0.5) * (high + low)
    arrays["action_half_range"] = np.float32(0.5) * (high - low)
    if np.any(centre_token):
        arrays["centre_token"] = centre_token
    return {name: np.array(value, np.float32, order="C") for name, value in arrays.items()}


def _reorder(array: np.ndarray) -> np.ndarray:
    parts = dict(zip(_TRAINED_GATES, np.split(array, 4, axis=-1), strict=True))
    return np.concatenate([parts[gate] for gate in GATES], axis=-1)
