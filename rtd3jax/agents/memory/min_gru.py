"""A minimal gated recurrent unit (Feng et al., 2024), scanned in parallel.

Neither the gate nor the candidate reads the carry, so the carry follows a linear recurrence,
``h_t = (1 - z_t) h_{t-1} + z_t n_t``, and one associative scan computes the carries of all tokens.
Shapes: ``T`` tokens, ``B`` batch, ``I`` inputs, ``H`` width.
"""

import jax
import jax.numpy as jnp
from jax import lax

from rtd3jax.agents.memory.base import Memory, Params, draw_uniform
from rtd3jax.agents.parameters import own_parameters
from rtd3jax.agents.products import matmul


class MinGRU(Memory):
    """A minimal GRU; gate order: gate, candidate. The carry [B, H] is the output."""

    def setup(self) -> None:
        self.kernels = own_parameters(self, ("kernel", "bias"))

    def initial(self, key: jax.Array) -> Params:
        """Uniform in ±1/sqrt(I)."""
        width = 2 * self.width
        shapes = {"kernel": (self.inputs, width), "bias": (width,)}
        return draw_uniform(key, shapes, self.inputs**-0.5)

    def zero(self, batch: int) -> jax.Array:
        """Zeros [B, H]."""
        return jnp.zeros((batch, self.width), jnp.float32)

    def step(self, carry: jax.Array, token: jax.Array) -> jax.Array:
        """``(1 - z) h + z n``, where ``z`` and ``n`` only depend on the token [B, I]."""
        keep, add = self._terms(token)
        return keep * carry + add

    def carries(self, carry: jax.Array | None, tokens: jax.Array, starts: jax.Array) -> jax.Array:
        """The carries after each token, [T, B, H]."""
        keep, add = self._terms(tokens.reshape(-1, tokens.shape[-1]))
        shape = (*tokens.shape[:2], self.width)
        keep = jnp.where(starts[:, :, None], 0.0, keep.reshape(shape))

        def joined(earlier, later):
            return earlier[0] * later[0], later[0] * earlier[1] + later[1]

        kept, added = lax.associative_scan(joined, (keep, add.reshape(shape)))
        return added if carry is None else kept * carry[None] + added

    def operations(self) -> tuple[float, float]:
        """Operations of the product with the input; there is no product with the carry."""
        return 4.0 * self.inputs * self.width, 0.0

    def _terms(self, token: jax.Array) -> tuple[jax.Array, jax.Array]:
        kernels = self.kernels
        both = matmul(token, kernels["kernel"], self.precision) + kernels["bias"][None, :]
        gate, candidate = jnp.split(both, 2, axis=-1)
        gate = jax.nn.sigmoid(gate)
        return 1.0 - gate, gate * jnp.tanh(candidate)
