"""Actor and critic: encoder, memory, head (paper, Appendix: "Network Structure"), as flax modules.

A `Network` consists of exchangeable modules; the names of its fields are the names of its
parameters. Shapes: ``L`` past tokens, ``B`` batch, ``O`` and ``A`` sizes of
an observation and an action, ``H`` width.
"""

import dataclasses
from typing import Any

import chex
import flax.linen as nn
import jax
import jax.numpy as jnp
from flax.errors import FlaxError

from rtd3jax.agents.history import History, Segment, Steps, Window, flat
from rtd3jax.agents.memory.base import Carry, Memory, Params, check_memory
from rtd3jax.agents.parameters import own_parameters
from rtd3jax.agents.products import matmul
from rtd3jax.agents.rows import where_rows
from rtd3jax.errors import UserError, short_reason
from rtd3jax.registries import MEMORIES

LAYERS = ("encoder", "memory", "current", "head", "output")
"""The modules of a network, in the order in which their keys are drawn."""


@dataclasses.dataclass(frozen=True)
class NetworkSpec:
    """The inputs of one network.

    Attributes:
        memory: parts of each token of the recurrent stream; empty without this stream.
        memory_has_current: whether the recurrent stream ends with the current token.
        current: parts of the input of the feed-forward stream; empty without this stream.
        carry_from_replay: whether the memory starts from the behaviour actor's stored carry and
            does not read the past tokens (h-td3's critic).
    """

    memory: tuple[str, ...] = ()
    memory_has_current: bool = False
    current: tuple[str, ...] = ()
    carry_from_replay: bool = False

    def __post_init__(self) -> None:
        for name in ("memory", "current"):  # lists would not be hashable
            object.__setattr__(self, name, tuple(getattr(self, name)))


class Linear(nn.Module):
    """``x @ kernel + bias`` [B, outputs]; initial values are uniform in ±1/sqrt(inputs).

    Attributes:
        inputs: elements of an input.
        outputs: elements of an output.
        precision: precision of the factors of a large product; None for a small product, whose
            factors are never rounded: its cost is low, and observations need the precision.
    """

    inputs: int
    outputs: int
    precision: str | None = None

    def setup(self) -> None:
        own = own_parameters(self, ("kernel", "bias"))
        self.kernel, self.bias = own["kernel"], own["bias"]

    def initial(self, key: jax.Array) -> Params:
        """Initial parameters, uniform in ±1/sqrt(inputs)."""
        bound = self.inputs**-0.5
        shape = (self.inputs, self.outputs)
        kernel_key, bias_key = jax.random.split(key)
        return {
            "kernel": jax.random.uniform(kernel_key, shape, jnp.float32, -bound, bound),
            "bias": jax.random.uniform(bias_key, shape[1:], jnp.float32, -bound, bound),
        }

    def __call__(self, x: jax.Array) -> jax.Array:
        """The output [B, outputs] for ``x`` [B, inputs]."""
        if self.precision is None:
            return x @ self.kernel + self.bias[None, :]
        return matmul(x, self.kernel, self.precision) + self.bias[None, :]


class Network(nn.Module):
    """An actor or a critic.

    Attributes:
        reads: the inputs of the network.
        head: layer from the features of the streams to H.
        output: layer from H to the outputs.
        encoder: first layer of the recurrent stream, before its ReLU; None without this stream.
        memory: recurrent cell of the recurrent stream; None without this stream.
        current: first layer of the feed-forward stream, before its ReLU; None without this stream.
    """

    reads: NetworkSpec
    head: Linear
    output: Linear
    encoder: nn.Module | None = None
    memory: Memory | None = None
    current: nn.Module | None = None

    def __call__(
        self, window: Window, action: jax.Array | None = None, carry: Carry | None = None
    ) -> jax.Array:
        """The output [B, outputs].

        Args:
            window: the window of the step.
            action: [B, A], the current action, for critics.
            carry: the carry after the past tokens, if it is known; the past tokens are then not
                read.
        """
        feature = current = None
        if self.reads.memory:
            feature = self._remember(window, action, carry)
        if self.reads.current:
            current = current_token(self.reads.current, window, action)
        return self.from_features(feature, current)

    def from_features(self, feature: jax.Array | None, current: jax.Array | None) -> jax.Array:
        """The output [B, outputs] for the memory's ``feature`` [B, H] and the ``current`` token."""
        features = [] if feature is None else [feature]
        if current is not None:
            assert self.current is not None
            features.append(jax.nn.relu(self.current(current)))
        hidden = self.head(jnp.concatenate(features, axis=-1))
        return self.output(jax.nn.relu(hidden))

    def carry_before(self, window: Window) -> Carry:
        """The memory's carry after the past tokens of the window, before the current token."""
        assert self.memory is not None
        encoded = self.encode(past_tokens(self.reads.memory, window.past))
        return self.memory.end(None, encoded, window.exists)

    def carries(self, carry: Carry | None, tokens: jax.Array, starts: jax.Array) -> Carry:
        """The memory's carries [T, B, ...] after each of ``tokens`` [T, B, parts].

        ``carry`` is the carry before the first token, None for zeros. The carry is zero before each
        token that ``starts`` marks.
        """
        assert self.memory is not None
        return self.memory.carries(carry, self.encode(tokens), starts)

    def advance(self, window: Window, action: jax.Array, carry: Carry) -> Carry:
        """The carry after the token of the present step with its ``action`` [B, A]."""
        assert self.memory is not None
        token = current_token(self.reads.memory, window, action)
        return self.memory.step(carry, self.encode(token[None])[0])

    def from_carries(
        self, window: Window, action: jax.Array | None, before: Carry, after: Carry
    ) -> jax.Array:
        """The output [B, outputs] from the carries before and after the current token."""
        assert self.memory is not None
        feature = self.memory.read(after if self.reads.memory_has_current else before)
        current = None
        if self.reads.current:
            current = current_token(self.reads.current, window, action)
        return self.from_features(feature, current)

    def zero_carry(self, batch: int) -> Carry:
        """The memory's carry before any token; None without a memory."""
        return None if self.memory is None else self.memory.zero(batch)

    def encode(self, tokens: jax.Array) -> jax.Array:
        """The encoded tokens [T, B, H] of ``tokens`` [T, B, parts]."""
        assert self.encoder is not None
        flat = jax.nn.relu(self.encoder(tokens.reshape(-1, tokens.shape[-1])))
        return flat.reshape(*tokens.shape[:2], flat.shape[-1])

    def _remember(self, window: Window, action: jax.Array | None, carry: Carry | None) -> jax.Array:
        """The memory's feature [B, H]: its output after the last token of the stream."""
        assert self.memory is not None
        if not self.reads.memory_has_current:
            return self.memory.read(self.carry_before(window) if carry is None else carry)
        current = current_token(self.reads.memory, window, action)[None]
        present = jnp.ones((1, current.shape[1]), bool)
        if carry is not None:
            return self.memory.read(self.memory.end(carry, self.encode(current), present))
        past = past_tokens(self.reads.memory, window.past)
        tokens = jnp.concatenate((past, current))
        exists = jnp.concatenate((window.exists, present))
        return self.memory.read(self.memory.end(None, self.encode(tokens), exists))


def make_network(
    reads: NetworkSpec,
    memory: str,
    sizes: dict[str, int],
    width: int,
    outputs: int,
    precision: str = "float32",
    encoder: type[nn.Module] = Linear,
) -> Network:
    """The network of an agent.

    Args:
        reads: the inputs of the network.
        memory: the registered name of the memory.
        sizes: elements of each part, from `part_sizes`.
        width: H.
        outputs: elements of the output: A for an actor, 1 for a critic.
        precision: precision of the factors of large products; see `rtd3jax.agents.products`.
        encoder: a function of ``inputs`` and ``outputs`` that returns the first layer of a stream.

    Raises:
        UserError: when the memory or the encoder violates its interface.
    """

    def first_layer(parts: tuple[str, ...]) -> nn.Module:
        module = encoder(inputs=sum(sizes[part] for part in parts), outputs=width)
        _check_encoder(module, width)
        return module

    modules: dict[str, Any] = {}
    features = 0
    if reads.memory:
        modules["encoder"] = first_layer(reads.memory)
        modules["memory"] = MEMORIES[memory](inputs=width, width=width, precision=precision)
        check_memory(memory, modules["memory"])
        features += width
    if reads.current:
        modules["current"] = first_layer(reads.current)
        features += width
    head, output = Linear(features, width, precision), Linear(width, outputs)
    return Network(reads=reads, head=head, output=output, **modules)


def init_network(key: jax.Array, network: Network) -> Params:
    """Initial parameters of ``network``, under the names of its fields."""
    keys = dict(zip(LAYERS, jax.random.split(key, len(LAYERS)), strict=True))
    params: Params = {}
    for name in LAYERS:
        module = getattr(network, name)
        if module is not None:
            params[name] = _initial(module, keys[name])
    return params


def apply_network(
    network: Network,
    params: Params,
    history: History,
    action: jax.Array | None = None,
    carry: Carry | None = None,
) -> jax.Array:
    """The network's output [B, outputs] with ``params``.

    Args:
        network: an actor or a critic.
        params: the parameters of the network.
        history: a window or a segment; see `rtd3jax.agents.history`.
        action: [B, A], the current action, for critics. With a segment, None means the actions of
            the segment.
        carry: the carry before the current token, if it is known; past tokens are then not read.
    """
    chex.assert_rank((history.observation, history.previous_action), 2)
    if action is not None:
        chex.assert_equal_shape((action, history.previous_action))
    if isinstance(history, Segment):
        return _apply_to_segment(network, params, history, action, carry)
    chex.assert_rank(history.past.action, 3)
    return _output(network, params, history, action, carry)


def act(actor: Network, params: Params, history: History, carry: Carry | None = None) -> jax.Array:
    """The deterministic action [B, A] of an actor in half ranges: the tanh of its output."""
    if isinstance(history, Segment):
        output = _apply_to_segment(actor, params, history, None, carry, history.start)
        return jnp.tanh(output)
    return jnp.tanh(apply_network(actor, params, history, carry=carry))


def carry_before(network: Network, params: Params, history: History) -> Carry:
    """The carry after the past tokens of ``history``, before the current token."""
    if isinstance(history, Segment):
        before, after = segment_carries(network, params, history)
        return after if history.following else before
    return network.apply({"params": params}, history, method="carry_before")


def advance(
    network: Network, params: Params, window: Window, action: jax.Array, carry: Carry
) -> Carry:
    """The carry after the current token of ``window``, with its ``action`` [B, A]."""
    return network.apply({"params": params}, window, action, carry, method="advance")


def segment_carries(
    network: Network, params: Params, segment: Segment, start: Carry | None = None
) -> tuple[Carry, Carry]:
    """The carries, leaves [B, ...], before and after the token of each of the segment's steps.

    ``start`` is the carry before the first token of the burn-in, zeros by default.
    """
    tokens = past_tokens(network.reads.memory, segment.steps)
    burn_in = tokens.shape[0] - segment.length
    starts = segment.starts
    if start is not None:
        starts = starts.at[0].set(segment.begins)

    def carries(params: Params, carry: Carry | None, part: slice) -> Carry:
        inputs = carry, tokens[part], starts[part]
        return network.apply({"params": params}, *inputs, method="carries")

    own = slice(burn_in, None)
    if segment.burn_in_gradient:
        through = carries(params, start, slice(None))
        last = jax.tree.map(lambda leaf: leaf[burn_in - 1], through)
        after = jax.tree.map(lambda leaf: leaf[own], through)
    else:
        through = carries(jax.lax.stop_gradient(params), start, slice(burn_in))
        last = jax.tree.map(lambda leaf: leaf[-1], through)
        after = carries(params, last, own)

    def before(last: jax.Array, after: jax.Array) -> jax.Array:
        earlier = jnp.concatenate((last[None], after[:-1]))
        return where_rows(segment.starts[own], 0.0, earlier)

    return jax.tree.map(flat, jax.tree.map(before, last, after)), jax.tree.map(flat, after)


def _apply_to_segment(
    network: Network,
    params: Params,
    segment: Segment,
    action: jax.Array | None,
    carry: Carry | None,
    start: Carry | None = None,
) -> jax.Array:
    """`apply_network` for a segment: a pass over the tokens, then one step for all B."""
    recorded = action is None and not segment.following
    if recorded:
        action = segment.action
    if network.reads.memory and carry is None:
        before, after = segment_carries(network, params, segment, start)
        if recorded:  # the pass over the segment's tokens has included the current token
            carries = before, after
            return _output(
                network, params, segment.present, action, *carries, method="from_carries"
            )
        carry = after if segment.following else before
    return _output(network, params, segment.present, action, carry)


def _output(network: Network, params: Params, *inputs: Any, method: str | None = None) -> jax.Array:
    output = network.apply({"params": params}, *inputs, method=method)
    assert isinstance(output, jax.Array)  # and not a tuple with mutable collections
    return output


def part_sizes(
    observation_size: int, action_size: int, true_observation_size: int = 0
) -> dict[str, int]:
    """Number of elements of each part of a token; ``true_observation_size`` 0 is for S = O."""
    return {
        "observation": observation_size,
        "action": action_size,
        "previous_action": action_size,
        "true_observation": true_observation_size or observation_size,
    }


def past_tokens(parts: tuple[str, ...], steps: Steps) -> jax.Array:
    """The tokens [..., parts] of ``steps``, leaves [..., O] and [..., A]."""
    return jnp.concatenate([getattr(steps, part) for part in parts], axis=-1)


def current_token(parts: tuple[str, ...], window: Window, action: jax.Array | None) -> jax.Array:
    """The token [B, parts] of the current step."""
    values: dict[str, Any] = {
        "observation": window.observation,
        "previous_action": window.previous_action,
        "action": action,
        "true_observation": window.true_observation,
    }
    return jnp.concatenate([values[part] for part in parts], axis=-1)


def _initial(module: nn.Module, key: jax.Array) -> Params:
    """Initial parameters of a module: from its method ``initial``, or else from flax."""
    if isinstance(module, Linear | Memory):
        return module.initial(key)
    return module.init(key, _example(module, 1)).get("params", {})


def _example(module: nn.Module, batch: int) -> jax.Array:
    return jnp.zeros((batch, module.inputs), jnp.float32)


def _check_encoder(module: nn.Module, width: int) -> None:
    """Raise UserError, before anything is compiled, if the encoder violates its interface."""
    name = type(module).__name__

    def applied() -> Any:
        # As in training: with the parameters alone, and not with all that `init` makes.
        params = _initial(module, jax.random.key(0))
        return module.apply({"params": params}, _example(module, 2))

    try:
        given = jax.eval_shape(applied)
    except Exception as error:  # code of a user, which may raise any error
        remedy = ""
        if isinstance(error, FlaxError):
            remedy = "; an encoder may only use parameters, no other variables or random numbers"
        raise UserError(f"encoder {name} failed: {short_reason(error)}{remedy}") from error
    if (getattr(given, "shape", None), getattr(given, "dtype", None)) != ((2, width), jnp.float32):
        raise UserError(
            f"encoder {name} must return float32 [batch, {width}], not "
            f"{getattr(given, 'dtype', type(given).__name__)}"
            f"{list(getattr(given, 'shape', []))} for a batch of 2"
        )
