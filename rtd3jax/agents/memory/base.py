"""`Memory`: the interface of recurrent cells, and their registration.

Shapes: ``T`` tokens, ``B`` batch, ``I`` inputs, ``H`` width. Time comes first.
"""

import functools
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from rtd3jax.agents.rows import where_rows
from rtd3jax.errors import UserError, short_reason
from rtd3jax.registries import MEMORIES

Params = dict[str, Any]
Carry = Any
"""A pytree of float32 arrays [B, ...]; zeros before the first token of an episode."""


class Memory(nn.Module):
    """A recurrent cell.

    A subclass must define `zero` and `step`, and also `read` if its output is not the carry. The
    other methods have defaults.

    Attributes:
        inputs: I.
        width: H.
        precision: precision of the factors of large products; see `rtd3jax.agents.products`.
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
        """The output of the memory: [B, H]; zeros for a carry of zeros."""
        return carry

    def carries(self, carry: Carry | None, tokens: jax.Array, starts: jax.Array) -> Carry:
        """The carries after each token: arrays [T, B, ...].

        Args:
            carry: the carry before the first token; None for zeros.
            tokens: [T, B, I].
            starts: bool [T, B], the first tokens of episodes; the carry is zero before them.
        """
        # flax does not allow a module to read its parameters inside JAX's scan.
        cell, variables = self.clone(parent=None), self.variables

        def step(carry: Carry, x: tuple[jax.Array, jax.Array]) -> tuple[Carry, Carry]:
            token, begins = x
            carry = jax.tree.map(functools.partial(where_rows, begins, 0.0), carry)
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
            carry: the carry before the first token; None for zeros.
            tokens: [T, B, I].
            exists: bool [T, B]. The existing tokens are the last ones; the others have no effect.
        """
        first = exists & ~jnp.concatenate((jnp.zeros_like(exists[:1]), exists[:-1]))
        starts = first if carry is None else jnp.zeros_like(exists)
        after = jax.tree.map(lambda part: part[-1], self.carries(carry, tokens, starts))
        before = self.zero(tokens.shape[1]) if carry is None else carry
        return jax.tree.map(functools.partial(where_rows, exists[-1]), after, before)

    def initial(self, key: jax.Array) -> Params:
        """Initial parameters."""
        carry, token = self.zero(1), jnp.zeros((1, self.inputs), jnp.float32)
        variables = self.init(key, carry, token, method=lambda m, c, x: m.read(m.step(c, x)))
        return variables.get("params", {})

    def operations(self) -> tuple[float, float]:
        """Floating-point operations per token of the products with the input, and with the carry.

        The default counts dense products with all parameters.
        """
        params = jax.eval_shape(self.initial, jax.random.key(0))
        wide = [leaf.size for leaf in jax.tree.leaves(params) if leaf.ndim > 1]
        return float(sum(wide)), float(sum(wide))


def register_memory(name: str, module: type[Memory], *, replace: bool = False) -> None:
    """Register a memory, for ``Config(memory=name)``.

    Args:
        name: the name in the configuration and in saved files.
        module: a subclass of `Memory`.
        replace: whether it may replace a memory of the same name.

    Raises:
        UserError: when the name is taken or ``module`` is not a subclass of `Memory`.
    """
    if not (isinstance(module, type) and issubclass(module, Memory)):
        raise UserError(f"memory {name!r} must be a subclass of rtd.Memory, not {module!r}")
    MEMORIES.register(name, module, replace=replace)


def check_memory(name: str, memory: Memory) -> None:
    """Raise UserError, before anything is compiled, if the memory violates its interface."""
    batch = 2

    def trace(what: str, call: Any, *arguments: Any) -> Any:
        try:
            return jax.eval_shape(call, *arguments)
        except Exception as error:  # code of a user, which may raise any error
            raise UserError(f"memory {name!r} failed in {what}: {short_reason(error)}") from error

    carry = trace("zero", lambda: memory.zero(batch))
    for leaf in jax.tree.leaves(carry):
        if leaf.shape[:1] != (batch,) or leaf.dtype != jnp.float32:
            raise UserError(
                f"memory {name!r}: zero(batch) must return float32 arrays [batch, ...], not "
                f"{leaf.dtype}{list(leaf.shape)} for a batch of {batch}"
            )
    with jax.ensure_compile_time_eval():
        start = [np.asarray(leaf) for leaf in jax.tree.leaves(memory.zero(1))]
    if any(leaf.any() for leaf in start):
        raise UserError(
            f"memory {name!r}: zero must return zeros, which the empty steps of a window are; add "
            "an offset in read instead"
        )
    params = trace(
        "initial, step or read", memory.initial, jax.ShapeDtypeStruct((), jax.random.key(0).dtype)
    )
    token = jax.ShapeDtypeStruct((batch, memory.inputs), jnp.float32)

    def apply(params: Params, method: str, *arguments: Any) -> Any:
        return memory.apply({"params": params}, *arguments, method=method)

    after = trace("step", lambda p, c, x: apply(p, "step", c, x), params, carry, token)
    if _shapes(after) != _shapes(carry):
        raise UserError(
            f"memory {name!r}: step must return a carry like zero's, {_shapes(carry)[1]}, "
            f"not {_shapes(after)[1]}"
        )
    output = trace("read", lambda p, c: apply(p, "read", c), params, carry)
    if getattr(output, "shape", None) != (batch, memory.width) or output.dtype != jnp.float32:
        raise UserError(
            f"memory {name!r}: read must return float32 [batch, {memory.width}], "
            f"not {getattr(output, 'dtype', type(output).__name__)}"
            f"{list(getattr(output, 'shape', []))} for a batch of {batch}"
        )


def draw_uniform(key: jax.Array, shapes: dict[str, tuple[int, ...]], bound: float) -> Params:
    """Arrays of these shapes, uniform in ±``bound``; consumes ``key``."""
    keys = jax.random.split(key, len(shapes))
    return {
        name: jax.random.uniform(k, shape, jnp.float32, -bound, bound)
        for k, (name, shape) in zip(keys, shapes.items(), strict=True)
    }


def _shapes(tree: object) -> tuple[Any, list[str]]:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [f"{leaf.dtype}{list(leaf.shape)}" for leaf in leaves]
