"""A gated recurrent unit (Cho et al., 2014); the reset gate acts on the product with the carry.

Shapes: ``T`` tokens, ``B`` batch, ``I`` inputs, ``H`` width.
"""

import jax
import jax.numpy as jnp
from jax import lax

from rtd3jax.agents.memory.base import Memory, Params, draw_uniform
from rtd3jax.agents.parameters import own_parameters
from rtd3jax.agents.products import matmul
from rtd3jax.agents.rows import where_rows


class GRU(Memory):
    """A GRU; its gates have the order reset, update, candidate. The carry [B, H] is the output."""

    def setup(self) -> None:
        names = ("input_kernel", "recurrent_kernel", "input_bias", "recurrent_bias")
        self.kernels = own_parameters(self, names)

    def initial(self, key: jax.Array) -> Params:
        """Uniform in ±1/sqrt(H)."""
        width = self.width
        shapes = {
            "input_kernel": (self.inputs, 3 * width),
            "recurrent_kernel": (width, 3 * width),
            "input_bias": (3 * width,),
            "recurrent_bias": (3 * width,),
        }
        return draw_uniform(key, shapes, width**-0.5)

    def zero(self, batch: int) -> jax.Array:
        """Zeros [B, H]."""
        return jnp.zeros((batch, self.width), jnp.float32)

    def step(self, carry: jax.Array, token: jax.Array) -> jax.Array:
        """``n + z * (h - n)`` with ``n = tanh(W x + r * (U h))``."""
        return self._cell(carry, self._project(token))

    def carries(self, carry: jax.Array | None, tokens: jax.Array, starts: jax.Array) -> jax.Array:
        """The carries after each token, [T, B, H]; one product serves the inputs of all tokens."""
        flat = tokens.reshape(-1, tokens.shape[-1])
        projected = self._project(flat).reshape(*tokens.shape[:2], -1)

        def step(carry: jax.Array, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            gates, begins = x
            after = self._cell(where_rows(begins, 0.0, carry), gates)
            return after, after

        start = self.zero(tokens.shape[1]) if carry is None else carry
        return lax.scan(step, start, (projected, starts))[1]

    def operations(self) -> tuple[float, float]:
        """Operations of the products with the input and with the carry."""
        return 6.0 * self.inputs * self.width, 6.0 * self.width * self.width

    def _project(self, token: jax.Array) -> jax.Array:
        kernels = self.kernels
        product = matmul(token, kernels["input_kernel"], self.precision)
        return product + kernels["input_bias"][None, :]

    def _cell(self, carry: jax.Array, projected: jax.Array) -> jax.Array:
        kernels = self.kernels
        recurrent = matmul(carry, kernels["recurrent_kernel"], self.precision)
        recurrent = recurrent + kernels["recurrent_bias"][None, :]
        width = self.width
        gates = jax.nn.sigmoid(projected[:, : 2 * width] + recurrent[:, : 2 * width])
        reset, update = jnp.split(gates, 2, axis=-1)
        candidate = jnp.tanh(projected[:, 2 * width :] + reset * recurrent[:, 2 * width :])
        return candidate + update * (carry - candidate)
