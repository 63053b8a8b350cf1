"""`Memory`: the interface of a recurrent cell, and the table of those that there are.

Shapes: ``T`` tokens, ``B`` batch, ``I`` inputs, ``H`` width. Time comes first.
"""

from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import lax

from rtd3jax.errors import UserError, first_line
from rtd3jax.registries import MEMORIES

Params = dict[str, Any]
Carry = Any
"""A pytree of float32 arrays [B, ...]; zeros before an episode's first token."""


class Memory(nn.Module):
    """A recurrent cell. A memory of your own needs `zero` and `step`, and `read` where the output
    is not the carry itself; the rest follows.

    Attributes:
        inputs: I.
        width: H.
        precision: of the factors of wide products; see `rtd3jax.agents.products`.
    """

    inputs: int
    width: int
    precision: str = "float32"

    def zero(self, batch: int) -> Carry:
        """The carry before any token: arrays [B, ...] of zeros."""
        raise NotImplementedError

    def step(self, carry: Carry, token: jax.Array) -> Carry:
        """The carry after ``token`` [B, I]."""
        raise NotImplementedError

    def read(self, carry: Carry) -> jax.Array:
        """What the memory puts out: [B, H]. Zeros for a carry of zeros."""
        return carry

    def carries(self, carry: Carry | None, tokens: jax.Array, starts: jax.Array) -> Carry:
        """The carries after each token: arrays [T, B, ...].

        Args:
            carry: before the first token; None for zeros.
            tokens: [T, B, I].
            starts: bool [T, B], tokens that begin an episode: the carry is zero before them.
        """
        # A module's parameters may not be read inside a transformation that began outside it.
        cell, variables = self.clone(parent=None), self.variables

        def step(carry: Carry, x: tuple[jax.Array, jax.Array]) -> tuple[Carry, Carry]:
            token, begins = x
            carry = jax.tree.map(lambda part: _where(begins, jnp.zeros_like(part), part), carry)
            after = cell.apply(variables, carry, token, method="step")
            return after, after

        start = self.zero(tokens.shape[1]) if carry is None else carry
        return lax.scan(step, start, (tokens, starts))[1]

    def scan(
        self, carry: Carry | None, tokens: jax.Array, starts: jax.Array
    ) -> tuple[jax.Array, Carry]:
        """The outputs [T, B, H] after each token, and the carry after the last one."""
        after = self.carries(carry, tokens, starts)
        rows = jax.tree.map(lambda part: part.reshape(-1, *part.shape[2:]), after)
        outputs = self.read(rows).reshape(*tokens.shape[:2], self.width)
        return outputs, jax.tree.map(lambda part: part[-1], after)

    def end(self, carry: Carry | None, tokens: jax.Array, exists: jax.Array) -> Carry:
        """The carry after all tokens of a window.

        Args:
            carry: before the first token; None for zeros.
            tokens: [T, B, I].
            exists: bool [T, B]. The tokens that exist are the last ones; the others leave no trace.
        """
        first = exists & ~jnp.concatenate((jnp.zeros_like(exists[:1]), exists[:-1]))
        starts = first if carry is None else jnp.zeros_like(exists)
        after = jax.tree.map(lambda part: part[-1], self.carries(carry, tokens, starts))
        before = self.zero(tokens.shape[1]) if carry is None else carry
        return jax.tree.map(lambda new, old: _where(exists[-1], new, old), after, before)

    def initial(self, key: jax.Array) -> Params:
        """Parameters at the start of training."""
        carry, token = self.zero(1), jnp.zeros((1, self.inputs), jnp.float32)
        variables = self.init(key, carry, token, method=lambda m, c, x: m.read(m.step(c, x)))
        return variables.get("params", {})

    def operations(self) -> tuple[float, float]:
        """Floating-point operations of a token's wide products: of its input, of the carry.

        By default those of dense products with all parameters.
        """
        params = jax.eval_shape(self.initial, jax.random.key(0))
        wide = [leaf.size for leaf in jax.tree.leaves(params) if leaf.ndim > 1]
        return float(sum(wide)), float(sum(wide))


def register_memory(name: str, module: type[Memory], *, replace: bool = False) -> None:
    """Add a memory, which ``Config(memory=name)`` then chooses.

    Args:
        name: by which the configuration and saved files know it.
        module: a subclass of `Memory`.
        replace: whether it may take the place of another of that name.

    Raises:
        UserError: when the name is taken or ``module`` is not a subclass of `Memory`.
    """
    if not (isinstance(module, type) and issubclass(module, Memory)):
        raise UserError(f"memory {name!r} must be a subclass of rtd.Memory, not {module!r}")
    MEMORIES.register(name, module, replace=replace)


def check_memory(name: str, memory: Memory) -> None:
    """Raise UserError, before anything is compiled, unless the memory keeps to its interface."""
    batch = 2

    def trace(what: str, call: Any, *arguments: Any) -> Any:
        try:
            return jax.eval_shape(call, *arguments)
        except Exception as error:  # the user's own code, which may raise anything
            raise UserError(f"memory {name!r} failed in {what}: {first_line(error)}") from error

    carry = trace("zero", lambda: memory.zero(batch))
    for leaf in jax.tree.leaves(carry):
        if leaf.shape[:1] != (batch,) or leaf.dtype != jnp.float32:
            raise UserError(
                f"memory {name!r}: zero(batch) must give float32 arrays [batch, ...], not "
                f"{leaf.dtype}{list(leaf.shape)} for a batch of {batch}"
            )
    params = trace("step", memory.initial, jax.ShapeDtypeStruct((), jax.random.key(0).dtype))
    token = jax.ShapeDtypeStruct((batch, memory.inputs), jnp.float32)

    def apply(params: Params, method: str, *arguments: Any) -> Any:
        return memory.apply({"params": params}, *arguments, method=method)

    after = trace("step", lambda p, c, x: apply(p, "step", c, x), params, carry, token)
    if _shapes(after) != _shapes(carry):
        raise UserError(
            f"memory {name!r}: step must give a carry like zero's, {_shapes(carry)[1]}, "
            f"not {_shapes(after)[1]}"
        )
    output = trace("read", lambda p, c: apply(p, "read", c), params, carry)
    if getattr(output, "shape", None) != (batch, memory.width) or output.dtype != jnp.float32:
        raise UserError(
            f"memory {name!r}: read must give float32 [batch, {memory.width}], "
            f"not {getattr(output, 'dtype', type(output).__name__)}"
            f"{list(getattr(output, 'shape', []))} for a batch of {batch}"
        )


def draw_uniform(key: jax.Array, shapes: dict[str, tuple[int, ...]], bound: float) -> Params:
    """Arrays of these shapes, uniform in ±``bound``; ``key`` is consumed here."""
    keys = jax.random.split(key, len(shapes))
    return {
        name: jax.random.uniform(k, shape, jnp.float32, -bound, bound)
        for k, (name, shape) in zip(keys, shapes.items(), strict=True)
    }


def _shapes(tree: object) -> tuple[Any, list[str]]:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [f"{leaf.dtype}{list(leaf.shape)}" for leaf in leaves]


def _where(there: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
    """``new`` where the token exists: [B, ...]."""
    return jnp.where(there.reshape(-1, *[1] * (new.ndim - 1)), new, old)
