"""A trained policy that only needs numpy.

    player = Player()
    player.reset()                       # at the start of every episode
    action = player.step(observation)    # once per control step

`HEADER` describes the policy. For each of the last steps, the player keeps the carry of the agent's
memory that started at this step. One product advances all carries, and the last row has read the
whole window. A policy with a running carry from the start of the episode only has this carry.
Carries of zeros are the start of an episode.
"""

import base64
from typing import Any

import numpy as np

HEADER: dict[str, Any] = {}
WEIGHTS = ""


class Player:
    """The policy with the state of one episode; use a separate player for each plant.

    Args:
        metadata: the header of the policy; `HEADER` by default.
        weights: the arrays in base64, float32 and little-endian, in the order of the header.
    """

    def __init__(self, metadata: dict[str, Any] = HEADER, weights: str = WEIGHTS) -> None:
        self.metadata = metadata
        self.observation_size: int = metadata["observation_size"]
        self.action_shape: tuple[int, ...] = tuple(metadata["action_shape"])
        arrays = _unpack(metadata["arrays"], weights)
        self._linear = {
            name: (arrays[f"{name}_kernel"], arrays[f"{name}_bias"])
            for name in ("encoder", "current", "head", "output")
            if f"{name}_kernel" in arrays
        }
        self._centre, self._half_range = arrays["action_centre"], arrays["action_half_range"]
        self._low, self._high = arrays["action_low"], arrays["action_high"]
        self._centre_token = arrays.get("centre_token")
        self._mean = arrays.get("observation_mean")
        if self._mean is not None:
            self._scale, self._limit = arrays["observation_scale"], arrays["observation_limit"]
        self._runs_on: bool = metadata["acting"] == "carry"
        self._length: int = 1 if self._runs_on else metadata["history_length"]
        self._with_current: bool = metadata["memory_has_current"]
        if metadata["memory"]:
            width = arrays["head_bias"].size
            self._advance = {"lstm": self._lstm, "gru": self._gru, "min-gru": self._min_gru}[
                metadata["cell"]
            ]
            # sigmoid(x) = tanh(x / 2) / 2 + 1/2: with halved weights, one tanh computes all gates.
            gates = {"lstm": (0.5, 0.5, 0.5, 1.0), "gru": (0.5, 0.5, 1.0), "min-gru": (0.5, 1.0)}
            half = np.repeat(np.array(gates[metadata["cell"]], np.float32), width)
            self._input = arrays["input_kernel"] * half, arrays["input_bias"] * half
            if "recurrent_kernel" in arrays:
                self._recurrent = arrays["recurrent_kernel"] * half
                self._recurrent_bias = arrays.get("recurrent_bias", np.float32(0.0)) * half
            # Row 0 is always zero: the carry that starts at a step. A running carry has no row 0.
            self._first = 0 if self._runs_on else 1
            self._rows = 1 if self._runs_on else self._length + self._with_current
            self._gates = np.empty((self._rows, half.size), np.float32)
            self._hidden = np.zeros((self._length + self._first, width), np.float32)
            self._cell = np.zeros((self._length + self._first, width), np.float32)
        self.reset()

    def reset(self) -> None:
        """Begin an episode: the next step is its first step."""
        self._previous_action = np.zeros_like(self._centre)
        if self.metadata["memory"]:
            self._hidden[:] = 0.0
            self._cell[:] = 0.0

    def step(self, observation: Any) -> np.ndarray:
        """The action of shape `action_shape`, in the environment's units, for ``observation`` [O].

        Raises:
            ValueError: when the observation has another size or is not finite; the state then stays
                unchanged.
        """
        observation = np.asarray(observation, np.float32)
        if observation.shape != (self.observation_size,):
            raise ValueError(
                f"the policy expects observations of shape ({self.observation_size},), "
                f"not {observation.shape}"
            )
        if not np.isfinite(observation).all():
            raise ValueError(f"the observation {observation} is not finite")
        if self._mean is not None:
            observation = (observation - self._mean) * self._scale
            observation = np.minimum(np.maximum(observation, -self._limit), self._limit)
        parts = {"observation": observation, "previous_action": self._previous_action}
        features = []
        if self.metadata["memory"]:
            features.append(self._feed(parts) if self._with_current else self._hidden[-1].copy())
        if self.metadata["current"]:
            features.append(self._relu("current", _join(parts, self.metadata["current"])))
        head = self._relu("head", features[0] if len(features) == 1 else np.concatenate(features))
        kernel, bias = self._linear["output"]
        token = np.tanh(head @ kernel + bias)
        action = self._centre + self._half_range * token
        action = np.minimum(np.maximum(action, self._low), self._high)
        if self._centre_token is not None:
            token = token + self._centre_token
        if self.metadata["memory"] and not self._with_current:
            self._feed({**parts, "action": token})
        self._previous_action = token
        return action.reshape(self.action_shape)

    def _feed(self, parts: dict[str, np.ndarray]) -> np.ndarray:
        """Advance all carries with the step's token; return the output of the oldest carry."""
        kernel, bias = self._input
        token = self._relu("encoder", _join(parts, self.metadata["memory"])) @ kernel + bias
        hidden = self._advance(token, self._hidden[: self._rows])
        self._hidden[self._first :] = hidden[: self._length]
        return hidden[-1]

    def _lstm(self, token: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        width = hidden.shape[1]
        gates = np.matmul(hidden, self._recurrent, out=self._gates)
        gates += token
        np.tanh(gates, out=gates)
        sigmoids = gates[:, : 3 * width]
        sigmoids *= 0.5
        sigmoids += 0.5
        i, f, o, g = (gates[:, k * width : (k + 1) * width] for k in range(4))
        cell = f * self._cell[: self._rows] + i * g
        self._cell[self._first :] = cell[: self._length]
        return o * np.tanh(cell)

    def _gru(self, token: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        width = hidden.shape[1]
        recurrent = np.matmul(hidden, self._recurrent, out=self._gates)
        recurrent += self._recurrent_bias
        gates = 0.5 * np.tanh(token[: 2 * width] + recurrent[:, : 2 * width]) + np.float32(0.5)
        reset, update = gates[:, :width], gates[:, width:]
        candidate = np.tanh(token[2 * width :] + reset * recurrent[:, 2 * width :])
        return candidate + update * (hidden - candidate)

    def _min_gru(self, token: np.ndarray, hidden: np.ndarray) -> np.ndarray:
        width = hidden.shape[1]
        squashed = np.tanh(token)
        gate = 0.5 * squashed[:width] + np.float32(0.5)
        return hidden + gate * (squashed[width:] - hidden)

    def _relu(self, layer: str, x: np.ndarray) -> np.ndarray:
        kernel, bias = self._linear[layer]
        return np.maximum(x @ kernel + bias, np.float32(0.0))


def _join(parts: dict[str, np.ndarray], names: list[str]) -> np.ndarray:
    return parts[names[0]] if len(names) == 1 else np.concatenate([parts[n] for n in names])


def _unpack(shapes: dict[str, list[int]], weights: str) -> dict[str, np.ndarray]:
    flat = np.frombuffer(base64.b64decode(weights), "<f4").astype(np.float32)
    arrays, begin = {}, 0
    for name, shape in shapes.items():
        end = begin + int(np.prod(shape))
        arrays[name] = flat[begin:end].reshape(shape)
        begin = end
    return arrays
