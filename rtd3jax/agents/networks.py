"""Actor and critic: encoder, memory, head (paper, Table 4: "Structure").

Shapes: ``L`` past tokens, ``B`` batch, ``O`` and ``A`` sizes of an observation and an action, ``H``
width.
"""

from typing import Any

import jax
import jax.numpy as jnp

from rtd3jax.agents.lstm import Carry, init_lstm, lstm
from rtd3jax.agents.products import matmul
from rtd3jax.agents.variants import VARIANTS, NetworkSpec
from rtd3jax.agents.windows import Steps, Window
from rtd3jax.config import ALGORITHMS
from rtd3jax.errors import UserError, nearest

Params = dict[str, Any]


def init_network(
    key: jax.Array, spec: NetworkSpec, sizes: dict[str, int], width: int, outputs: int
) -> Params:
    """Parameters of one network.

    Args:
        key: consumed here.
        spec: what the network reads.
        sizes: elements of each part: ``observation``, ``action``, ``previous_action``.
        width: H.
        outputs: elements of its output: A for an actor, 1 for a critic.
    """
    names = ("encoder", "lstm", "current", "head", "output")
    keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
    params: Params = {}
    features = 0
    if spec.memory:
        inputs = sum(sizes[part] for part in spec.memory)
        params["encoder"] = _init_linear(keys["encoder"], inputs, width)
        params["lstm"] = init_lstm(keys["lstm"], width, width)
        features += width
    if spec.current:
        inputs = sum(sizes[part] for part in spec.current)
        params["current"] = _init_linear(keys["current"], inputs, width)
        features += width
    params["head"] = _init_linear(keys["head"], features, width)
    params["output"] = _init_linear(keys["output"], width, outputs)
    return params


def carry_before(params: Params, spec: NetworkSpec, window: Window) -> Carry:
    """The LSTM's carry after the window's past tokens, before the current one."""
    encoded = _encode(params, _past_tokens(spec, window))
    return lstm(params["lstm"], encoded, window.exists, precision=spec.precision)


def apply_network(
    params: Params,
    spec: NetworkSpec,
    window: Window,
    action: jax.Array | None = None,
    carry: Carry | None = None,
) -> jax.Array:
    """The network's output: [B, outputs].

    Args:
        params: of `init_network`.
        spec: what the network reads.
        window: of the step.
        action: [B, A], the current action; critics need it.
        carry: the carry after the past tokens, where it is known already; they are not read then.
    """
    features = []
    if spec.memory:
        features.append(_memory(params, spec, window, action, carry))
    if spec.current:
        current = _current_token(spec.current, window, action)
        features.append(jax.nn.relu(_linear(params["current"], current)))
    head = params["head"]
    hidden = matmul(jnp.concatenate(features, axis=-1), head["kernel"], spec.precision)
    return _linear(params["output"], jax.nn.relu(hidden + head["bias"][None, :]))


def count_parameters(
    algorithm: str, obs_dim: int, act_dim: int, hidden_size: int = 128
) -> dict[str, int]:
    """Numbers of parameters of one actor and one critic, counted from initialised ones.

    ``count_parameters("lstm-td3", obs_dim=3, act_dim=1)`` gives the paper's Table 5.
    """
    if algorithm not in ALGORITHMS:
        raise UserError(f"algorithm {algorithm!r} is unknown{nearest(algorithm, ALGORITHMS)}")
    sizes = part_sizes(obs_dim, act_dim)
    variant = VARIANTS[algorithm]

    def count(spec: NetworkSpec, outputs: int) -> int:
        params = jax.eval_shape(
            lambda: init_network(jax.random.key(0), spec, sizes, hidden_size, outputs)
        )
        return sum(leaf.size for leaf in jax.tree.leaves(params))

    return {"actor": count(variant.actor, act_dim), "critic": count(variant.critic, 1)}


def part_sizes(observation_size: int, action_size: int) -> dict[str, int]:
    """Elements of each part that a token may hold."""
    return {
        "observation": observation_size,
        "action": action_size,
        "previous_action": action_size,
    }


def _memory(
    params: Params,
    spec: NetworkSpec,
    window: Window,
    action: jax.Array | None,
    carry: Carry | None,
) -> jax.Array:
    """The memory's feature [B, H]: the last hidden state."""
    if not spec.memory_has_current:
        return (carry_before(params, spec, window) if carry is None else carry).hidden
    current = _current_token(spec.memory, window, action)[None]
    present = jnp.ones((1, current.shape[1]), bool)
    if carry is not None:
        encoded = _encode(params, current)
        return lstm(params["lstm"], encoded, present, carry, spec.precision).hidden
    tokens = jnp.concatenate((_past_tokens(spec, window), current))
    exists = jnp.concatenate((window.exists, present))
    return lstm(params["lstm"], _encode(params, tokens), exists, precision=spec.precision).hidden


def _past_tokens(spec: NetworkSpec, window: Window) -> jax.Array:
    past: Steps = window.past
    return jnp.concatenate([getattr(past, part) for part in spec.memory], axis=-1)


def _current_token(parts: tuple[str, ...], window: Window, action: jax.Array | None) -> jax.Array:
    values: dict[str, Any] = {
        "observation": window.observation,
        "previous_action": window.previous_action,
        "action": action,
    }
    return jnp.concatenate([values[part] for part in parts], axis=-1)


def _encode(params: Params, tokens: jax.Array) -> jax.Array:
    """Linear-ReLU of every token: [T, B, parts] to [T, B, H]."""
    flat = jax.nn.relu(_linear(params["encoder"], tokens.reshape(-1, tokens.shape[-1])))
    return flat.reshape(*tokens.shape[:2], flat.shape[-1])


def _init_linear(key: jax.Array, inputs: int, outputs: int) -> Params:
    """Uniform in ±1/sqrt(inputs), the initialisation that the parameter counts' stack implies."""
    bound = inputs**-0.5
    kernel_key, bias_key = jax.random.split(key)
    return {
        "kernel": jax.random.uniform(kernel_key, (inputs, outputs), jnp.float32, -bound, bound),
        "bias": jax.random.uniform(bias_key, (outputs,), jnp.float32, -bound, bound),
    }


def _linear(params: Params, x: jax.Array) -> jax.Array:
    # Always in float32: narrow inputs (an observation) cost little and would lose most.
    return x @ params["kernel"] + params["bias"][None, :]
