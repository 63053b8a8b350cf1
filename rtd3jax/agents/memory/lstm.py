"""An LSTM over a masked window, with a hand-written gradient.

Shapes: ``T`` tokens, ``B`` batch, ``I`` inputs, ``H`` width. Time comes first.

Two measures make it fast on a CPU. Before the scan, one product serves the inputs of all tokens.
The backward scan only propagates the gradient of the carry and returns the gradients of the gates,
so that the gradient of each weight is one large product after the scan. The tests compare with the
straightforward `reference`.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from rtd3jax.agents.memory.base import Memory, draw_uniform
from rtd3jax.agents.parameters import own_parameters
from rtd3jax.agents.products import matmul, narrow, product, weight_gradient
from rtd3jax.agents.rows import where_rows

Params = dict[str, jax.Array]


class Carry(NamedTuple):
    """The LSTM's state. ``hidden`` and ``cell``: [B, H]."""

    hidden: jax.Array
    cell: jax.Array


def init_lstm(key: jax.Array, inputs: int, width: int) -> Params:
    """Parameters, uniform in ±1/sqrt(width), with two bias vectors; gate order i, f, g, o."""
    shapes = {
        "input_kernel": (inputs, 4 * width),
        "recurrent_kernel": (width, 4 * width),
        "input_bias": (4 * width,),
        "recurrent_bias": (4 * width,),
    }
    return draw_uniform(key, shapes, width**-0.5)


_ARRAYS = ("input_kernel", "recurrent_kernel", "input_bias", "recurrent_bias")


def zero_carry(batch: int, width: int) -> Carry:
    """The carry before any token."""
    zeros = jnp.zeros((batch, width), jnp.float32)
    return Carry(zeros, zeros)


class LSTM(Memory):
    """The LSTM as a memory: two bias vectors, gates in the order i, f, g, o."""

    def setup(self) -> None:
        # The names are those in files; `initial` draws all parameters from one key.
        self.kernels = own_parameters(self, _ARRAYS)

    def initial(self, key: jax.Array) -> Params:
        """Uniform in ±1/sqrt(H)."""
        return init_lstm(key, self.inputs, self.width)

    def zero(self, batch: int) -> Carry:
        """Zeros [B, H]."""
        return zero_carry(batch, self.width)

    def step(self, carry: Carry, token: jax.Array) -> Carry:
        """The carry after ``token`` [B, I]; differentiated automatically."""
        kernels = self.kernels
        bias = kernels["input_bias"] + kernels["recurrent_bias"]
        gates = matmul(token, kernels["input_kernel"], self.precision) + bias[None, :]
        gates = gates + matmul(carry.hidden, kernels["recurrent_kernel"], self.precision)
        return _cell(_activate(gates, jnp.ones((token.shape[0],), bool)), carry.cell)

    def read(self, carry: Carry) -> jax.Array:
        """The hidden state [B, H]."""
        return carry.hidden

    def carries(self, carry: Carry | None, tokens: jax.Array, starts: jax.Array) -> Carry:
        """The carries after each token: [T, B, H]."""
        start = zero_carry(tokens.shape[1], self.width) if carry is None else carry
        return lstm_carries(self.kernels, tokens, starts, start, self.precision)

    def end(self, carry: Carry | None, tokens: jax.Array, exists: jax.Array) -> Carry:
        """The carry after all tokens."""
        return lstm(self.kernels, tokens, exists, carry, self.precision)

    def operations(self) -> tuple[float, float]:
        """Operations of the products with the input and with the hidden state."""
        return 8.0 * self.inputs * self.width, 8.0 * self.width * self.width


def lstm(
    params: Params,
    inputs: jax.Array,
    exists: jax.Array,
    carry: Carry | None = None,
    precision: str = "float32",
) -> Carry:
    """The carry after all tokens.

    Args:
        params: parameters from `init_lstm`.
        inputs: [T, B, I].
        exists: bool [T, B]. A token that does not exist does not change the carry, **provided**
            that it is before all existing tokens and that its carry is zero, as in a window: only
            the candidate is masked, which keeps a zero carry zero.
        carry: the initial carry; None for zero.
        precision: precision of the products' factors; see `rtd3jax.agents.products`.
    """
    input_kernel, recurrent_kernel = params["input_kernel"], params["recurrent_kernel"]
    bias = params["input_bias"] + params["recurrent_bias"]
    if carry is None:
        # With a zero carry, the first token needs no recurrent product, a quarter of all at l = 1.
        gates = matmul(inputs[0], input_kernel, precision) + bias[None, :]
        nothing = zero_carry(inputs.shape[1], recurrent_kernel.shape[0]).cell
        carry = _cell(_activate(gates, exists[0]), nothing.astype(gates.dtype))
        inputs, exists = inputs[1:], exists[1:]
    if inputs.shape[0] == 0:
        return carry
    return _lstm(precision, input_kernel, recurrent_kernel, bias, inputs, exists, carry)


def lstm_carries(
    params: Params,
    inputs: jax.Array,
    starts: jax.Array,
    carry: Carry,
    precision: str = "float32",
) -> Carry:
    """The carries after each token, [T, B, H], with a hand-written gradient.

    Args:
        params: parameters from `init_lstm`.
        inputs: [T, B, I].
        starts: bool [T, B], tokens before which the carry is set to zero.
        carry: [B, H], the carry before the first token.
        precision: precision of the products' factors.
    """
    bias = params["input_bias"] + params["recurrent_bias"]
    kernels = params["input_kernel"], params["recurrent_kernel"]
    return _carries(precision, *kernels, bias, inputs, starts, carry)


def reference(params: Params, inputs: jax.Array, exists: jax.Array, carry: Carry) -> Carry:
    """A straightforward version of `lstm`, for the tests."""
    for x, there in zip(inputs, exists, strict=True):
        gates = x @ params["input_kernel"] + carry.hidden @ params["recurrent_kernel"]
        gates = gates + (params["input_bias"] + params["recurrent_bias"])[None, :]
        i, f, g, o = jnp.split(gates, 4, axis=-1)
        cell = jax.nn.sigmoid(f) * carry.cell + jax.nn.sigmoid(i) * jnp.tanh(g)
        new = Carry(jax.nn.sigmoid(o) * jnp.tanh(cell), cell)
        carry = Carry(*(where_rows(there, n, c) for n, c in zip(new, carry, strict=True)))
    return carry


def _project(input_kernel: jax.Array, bias: jax.Array, inputs: jax.Array) -> jax.Array:
    tokens, batch, size = inputs.shape
    flat = product(inputs.reshape(tokens * batch, size), input_kernel) + bias[None, :]
    return flat.reshape(tokens, batch, -1)


def _activate(gates: jax.Array, exists: jax.Array):
    """The activations i, f, g and o, [B, H] each, of the sums [B, 4H]; the candidate g is masked.

    A single tanh computes all four, because ``sigmoid(x) = tanh(x/2)/2 + 1/2``. The barrier keeps
    XLA from fusing it with the slices (experiments/benchmarks/gates.py measures what this changes).
    """
    width = gates.shape[-1] // 4
    half, one = jnp.full((width,), 0.5, gates.dtype), jnp.ones((width,), gates.dtype)
    scales = jnp.concatenate((half, half, one, half))
    squashed = lax.optimization_barrier(jnp.tanh(scales[None, :] * gates))
    i, f, g, o = jnp.split(squashed, 4, axis=-1)
    return 0.5 * i + 0.5, 0.5 * f + 0.5, jnp.where(exists[:, None], g, 0.0), 0.5 * o + 0.5


def _cell(activations, cell: jax.Array) -> Carry:
    i, f, g, o = activations
    cell = f * cell + i * g
    return Carry(o * jnp.tanh(cell), cell)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _lstm(precision, input_kernel, recurrent_kernel, bias, inputs, exists, carry: Carry) -> Carry:
    input_kernel, recurrent_kernel, inputs = (
        narrow(factor, precision) for factor in (input_kernel, recurrent_kernel, inputs)
    )
    projected = _project(input_kernel, bias, inputs)

    def token(carry: Carry, x):
        gates, there = x
        recurrent = product(narrow(carry.hidden, precision), recurrent_kernel)
        return _cell(_activate(gates + recurrent, there), carry.cell), None

    return lax.scan(token, carry, (projected, exists))[0]


def _forward(precision, input_kernel, recurrent_kernel, bias, inputs, exists, carry: Carry):
    input_kernel, recurrent_kernel, inputs = (
        narrow(factor, precision) for factor in (input_kernel, recurrent_kernel, inputs)
    )
    projected = _project(input_kernel, bias, inputs)

    def token(carry: Carry, x):
        gates, there = x
        recurrent = product(narrow(carry.hidden, precision), recurrent_kernel)
        activations = _activate(gates + recurrent, there)
        # Stacked in float32: for a stack of bfloat16, XLA's CPU backend converts the whole stack to
        # float32 and back at every token.
        return _cell(activations, carry.cell), (carry, activations)

    end, (before, activations) = lax.scan(token, carry, (projected, exists))
    return end, (input_kernel, recurrent_kernel, inputs, exists, before, activations)


def _backward(precision, residuals, gradient: Carry):
    input_kernel, recurrent_kernel, inputs, exists, before, activations = residuals
    to_hidden = lax.optimization_barrier(recurrent_kernel.T)

    def token(gradient: Carry, x):
        there, cell_before, (i, f, g, o) = x
        tanh_cell = jnp.tanh(f * cell_before + i * g)
        d_cell = gradient.cell + gradient.hidden * o * (1.0 - tanh_cell * tanh_cell)
        d_gates = jnp.concatenate(
            (
                d_cell * g * i * (1.0 - i),
                d_cell * cell_before * f * (1.0 - f),
                jnp.where(there[:, None], d_cell * i * (1.0 - g * g), 0.0),
                gradient.hidden * tanh_cell * o * (1.0 - o),
            ),
            axis=-1,
        )
        return Carry(product(narrow(d_gates, precision), to_hidden), d_cell * f), d_gates

    start, d_gates = lax.scan(token, gradient, (exists, before.cell, activations), reverse=True)
    return (*_sums(precision, residuals, d_gates), None, start)


_lstm.defvjp(_forward, _backward)


def _sums(precision, residuals, d_gates: jax.Array):
    """Gradients of kernels, bias and inputs, from the gradients of the gates [T, B, 4H]."""
    input_kernel, _, inputs, _, before, _ = residuals
    d_bias = d_gates.sum(axis=(0, 1))
    d_gates = narrow(d_gates, precision)
    d_input_kernel = weight_gradient(inputs, d_gates)
    d_recurrent_kernel = weight_gradient(narrow(before.hidden, precision), d_gates)
    flat = d_gates.reshape(-1, d_gates.shape[-1])
    d_inputs = product(flat, input_kernel.T).reshape(inputs.shape)
    return d_input_kernel, d_recurrent_kernel, d_bias, d_inputs


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _carries(precision, input_kernel, recurrent_kernel, bias, inputs, starts, carry) -> Carry:
    return _carries_forward(precision, input_kernel, recurrent_kernel, bias, inputs, starts, carry)[
        0
    ]


def _carries_forward(precision, input_kernel, recurrent_kernel, bias, inputs, starts, carry):
    input_kernel, recurrent_kernel, inputs = (
        narrow(factor, precision) for factor in (input_kernel, recurrent_kernel, inputs)
    )
    projected = _project(input_kernel, bias, inputs)
    present = jnp.ones((inputs.shape[1],), bool)

    def token(carry: Carry, x):
        gates, begins = x
        carry = _reset(carry, begins)
        recurrent = product(narrow(carry.hidden, precision), recurrent_kernel)
        activations = _activate(gates + recurrent, present)
        after = _cell(activations, carry.cell)
        return after, (after, carry, activations)

    _, (after, before, activations) = lax.scan(token, carry, (projected, starts))
    return after, (input_kernel, recurrent_kernel, inputs, starts, before, activations)


def _carries_backward(precision, residuals, gradients: Carry):
    input_kernel, recurrent_kernel, inputs, starts, before, activations = residuals
    to_hidden = lax.optimization_barrier(recurrent_kernel.T)

    def token(later: Carry, x):
        begins, own, cell_before, (i, f, g, o) = x
        d_hidden, d_cell = later.hidden + own.hidden, later.cell + own.cell
        tanh_cell = jnp.tanh(f * cell_before + i * g)
        d_cell = d_cell + d_hidden * o * (1.0 - tanh_cell * tanh_cell)
        d_gates = jnp.concatenate(
            (
                d_cell * g * i * (1.0 - i),
                d_cell * cell_before * f * (1.0 - f),
                d_cell * i * (1.0 - g * g),
                d_hidden * tanh_cell * o * (1.0 - o),
            ),
            axis=-1,
        )
        earlier = Carry(product(narrow(d_gates, precision), to_hidden), d_cell * f)
        return _reset(earlier, begins), d_gates

    nothing = jax.tree.map(lambda leaf: jnp.zeros_like(leaf[0]), gradients)
    xs = (starts, gradients, before.cell, activations)
    start, d_gates = lax.scan(token, nothing, xs, reverse=True)
    return (*_sums(precision, residuals, d_gates), None, start)


_carries.defvjp(_carries_forward, _carries_backward)


def _reset(carry: Carry, begins: jax.Array) -> Carry:
    """``carry`` [B, H], set to zero at the entries where an episode ``begins`` [B]."""
    return Carry(*(where_rows(begins, 0.0, part) for part in carry))
