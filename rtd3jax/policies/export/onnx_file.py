"""The ONNX format: ``(observation, state...) -> (action, next state...)``, any batch size.

The graph only uses standard operators of opset 17, so that old runtimes support it.
"""

import json
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import Any

import numpy as np

from rtd3jax.errors import UserError
from rtd3jax.policies.export.model import Model, check_portable

_OPSET = 17
_IR_VERSION = 8
METADATA = "rtd3jax"
"""The file's metadata entry that holds the header as JSON."""


def onnx_bytes(model: Model) -> bytes:
    """The serialised graph.

    Inputs: ``observation`` [B, O] and the parts of `Model.state_shapes`, each with a batch axis.
    Outputs: ``action`` [B, *action_shape] and ``next_...`` for each part.

    Raises:
        UserError: when the package onnx is missing, or the format does not support the model's
            memory or encoder.
    """
    check_portable(model, "onnx")
    try:
        import onnx
    except ImportError as error:
        raise UserError("ONNX files need the package onnx: pip install 'rtd3jax[onnx]'") from error
    graph = _Graph(onnx.helper, model.arrays)
    _build(graph, model)

    def value(name: str, shape: Sequence[int]) -> Any:
        return onnx.helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, ["batch", *shape])

    states = model.state_shapes
    proto = onnx.helper.make_model(
        onnx.helper.make_graph(
            graph.nodes,
            "policy",
            [value("observation", [model.observation_size])]
            + [value(name, shape) for name, shape in states.items()],
            [value("action", model.action_shape)]
            + [value(f"next_{name}", shape) for name, shape in states.items()],
            [onnx.numpy_helper.from_array(a, name) for name, a in graph.constants.items()],
        ),
        opset_imports=[onnx.helper.make_opsetid("", _OPSET)],
        ir_version=_IR_VERSION,
        producer_name="rtd3jax",
    )
    onnx.helper.set_model_props(proto, {METADATA: json.dumps(model.header())})
    onnx.checker.check_model(proto, full_check=True)
    return proto.SerializeToString()


class _Graph:
    """Nodes in the order of their addition, and their constants."""

    def __init__(self, helper: ModuleType, arrays: dict[str, np.ndarray]):
        self._helper = helper
        self._arrays = arrays
        self.nodes: list[Any] = []
        self.constants: dict[str, np.ndarray] = {}

    def add(self, operator: str, inputs: Sequence[str], *outputs: str, **attributes: object) -> str:
        """Add a node; return the name of its first output."""
        names = outputs or (f"{operator.lower()}_{len(self.nodes)}",)
        self.nodes.append(self._helper.make_node(operator, inputs, names, **attributes))
        return names[0]

    def weight(self, name: str) -> str:
        """The name of a folded array."""
        self.constants[name] = self._arrays[name]
        return name

    def integers(self, *values: int) -> str:
        """The name of a vector of integers."""
        name = "integers_" + "_".join(map(str, values))
        self.constants[name] = np.asarray(values, np.int64)
        return name

    def linear(self, layer: str, x: str) -> str:
        """Apply a layer to ``x`` [B, inputs]."""
        return self.add("Gemm", [x, self.weight(f"{layer}_kernel"), self.weight(f"{layer}_bias")])

    def join(self, parts: Sequence[str]) -> str:
        """Concatenate parts [B, ...] along the last axis."""
        return parts[0] if len(parts) == 1 else self.add("Concat", parts, axis=1)


def _build(graph: _Graph, model: Model) -> None:
    features = []
    observation = _normalised_observation(graph, model)
    length = model.history_length
    carry: list[str] = []
    if model.memory:
        carry = [*_CARRIES[model.cell]]
        if not model.has_running_carry:
            pads = graph.integers(0, 1, 0, 0, 0, 0)  # a zero row: the carry that starts here
            carry = [graph.add("Pad", [part, pads]) for part in carry]
        if model.memory_has_current:
            carry = _feed(graph, model, carry, observation)
        if model.has_running_carry:
            features.append(carry[0])
        else:
            features.append(_row(graph, carry[0], length))
            carry = [_rows(graph, part, length) for part in carry]
    if model.current:
        parts = graph.join(_named(model.current, observation=observation))
        features.append(graph.add("Relu", [graph.linear("current", parts)]))
    head = graph.add("Relu", [graph.linear("head", graph.join(features))])
    token = graph.add("Tanh", [graph.linear("output", head)], "action_token")
    scaled = graph.add("Mul", [token, graph.weight("action_half_range")])
    flat = graph.add("Add", [scaled, graph.weight("action_centre")])
    flat = graph.add("Max", [flat, graph.weight("action_low")])
    flat = graph.add("Min", [flat, graph.weight("action_high")])
    graph.add("Reshape", [flat, graph.integers(-1, *model.action_shape)], "action")
    if "centre_token" in model.arrays:
        token = graph.add("Add", [token, graph.weight("centre_token")], "shifted_action_token")
    if model.memory and not model.memory_has_current:
        carry = _feed(graph, model, carry, observation, token)
    following = {"previous_action": token}
    if model.memory:
        following |= dict(zip(_CARRIES[model.cell], carry, strict=True))
    for name in model.state_shapes:
        graph.add("Identity", [following[name]], f"next_{name}")


_CARRIES: dict[str | None, tuple[str, ...]] = {
    "lstm": ("hidden", "cell"),
    "gru": ("hidden",),
    "min-gru": ("hidden",),
}


def _normalised_observation(graph: _Graph, model: Model) -> str:
    """The normalised observation."""
    if "observation_mean" not in model.arrays:
        return "observation"
    limit = graph.weight("observation_limit")
    centred = graph.add("Sub", ["observation", graph.weight("observation_mean")])
    scaled = graph.add("Mul", [centred, graph.weight("observation_scale")])
    return graph.add("Clip", [scaled, graph.add("Neg", [limit]), limit])


def _named(parts: Sequence[str], **names: str) -> list[str]:
    """Names of the values of these parts of a token."""
    return [names.get(part, part) for part in parts]


def _feed(
    graph: _Graph, model: Model, carry: list[str], observation: str, action: str = ""
) -> list[str]:
    """The carries [B, rows, H] after the step's token; a running carry is [B, H].

    ``action`` is for tokens that contain the action.
    """
    parts = _named(model.memory, observation=observation, action=action)
    token = graph.add("Relu", [graph.linear("encoder", graph.join(parts))])
    token = graph.linear("input", token)
    if not model.has_running_carry:
        token = graph.add("Unsqueeze", [token, graph.integers(1)])
    cells: dict[str | None, Callable[..., list[str]]] = {
        "lstm": _lstm,
        "gru": _gru,
        "min-gru": _min_gru,
    }
    return cells[model.cell](
        graph, model.width, token, *carry, axis=1 if model.has_running_carry else 2
    )


def _lstm(graph: _Graph, width: int, token: str, hidden: str, cell: str, *, axis: int) -> list[str]:
    kernel = graph.weight("recurrent_kernel")
    if axis == 1:
        gates = graph.add("Gemm", [hidden, kernel, token])
    else:
        gates = graph.add("Add", [graph.add("MatMul", [hidden, kernel]), token])
    graph.add("Split", [gates, graph.integers(3 * width, width)], "ifo", "g", axis=axis)
    sigmoids = graph.add("Sigmoid", ["ifo"])
    graph.add("Split", [sigmoids, graph.integers(width, width, width)], "i", "f", "o", axis=axis)
    kept = graph.add("Mul", ["f", cell])
    added = graph.add("Mul", ["i", graph.add("Tanh", ["g"])])
    cell = graph.add("Add", [kept, added])
    return [graph.add("Mul", ["o", graph.add("Tanh", [cell])]), cell]


def _gru(graph: _Graph, width: int, token: str, hidden: str, *, axis: int) -> list[str]:
    recurrent = graph.add("MatMul", [hidden, graph.weight("recurrent_kernel")])
    recurrent = graph.add("Add", [recurrent, graph.weight("recurrent_bias")])
    sizes = graph.integers(2 * width, width)
    graph.add("Split", [token, sizes], "token_gates", "token_candidate", axis=axis)
    graph.add("Split", [recurrent, sizes], "carry_gates", "carry_candidate", axis=axis)
    gates = graph.add("Sigmoid", [graph.add("Add", ["token_gates", "carry_gates"])])
    graph.add("Split", [gates, graph.integers(width, width)], "reset", "update", axis=axis)
    kept = graph.add("Mul", ["reset", "carry_candidate"])
    candidate = graph.add("Tanh", [graph.add("Add", ["token_candidate", kept])])
    change = graph.add("Mul", ["update", graph.add("Sub", [hidden, candidate])])
    return [graph.add("Add", [candidate, change])]


def _min_gru(graph: _Graph, width: int, token: str, hidden: str, *, axis: int) -> list[str]:
    graph.add("Split", [token, graph.integers(width, width)], "gate", "candidate", axis=axis)
    gate = graph.add("Sigmoid", ["gate"])
    change = graph.add("Sub", [graph.add("Tanh", ["candidate"]), hidden])
    return [graph.add("Add", [hidden, graph.add("Mul", [gate, change])])]


def _row(graph: _Graph, rows: str, index: int) -> str:
    """Row ``index`` of [B, rows, H]: [B, H]."""
    one = graph.add(
        "Slice",
        [rows, graph.integers(index), graph.integers(index + 1), graph.integers(1)],
    )
    return graph.add("Squeeze", [one, graph.integers(1)])


def _rows(graph: _Graph, rows: str, count: int) -> str:
    """The first ``count`` rows."""
    return graph.add("Slice", [rows, graph.integers(0), graph.integers(count), graph.integers(1)])
