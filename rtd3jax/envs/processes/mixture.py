"""A mixture of disturbances: each episode draws one of them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from rtd3jax.envs.processes.process import Composition
from rtd3jax.errors import UserError


class MixtureState(struct.PyTreeNode):
    """The drawn member of an episode, and the states of all members, which all evolve."""

    kind: jax.Array
    """int32 []: index of the member that acts in this episode"""
    members: tuple


class Mixture(Composition):
    """One of several processes, which is drawn at the start of an episode and acts in all of it.

    The agent does not observe which process was drawn. Each member has its own random stream. The
    outputs of all members must have the same number of elements.
    """

    weights: tuple[int, ...] = struct.field(pytree_node=False, default=())
    """Relative frequency of each member; () means equal frequencies."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> MixtureState:
        """Draw a member, and the states of all members."""
        weights = self.weights or (1,) * len(self.processes)
        logits = jnp.log(jnp.asarray(weights, jnp.float32))
        kind = jax.random.categorical(jax.random.fold_in(key, len(self.processes)), logits)
        return MixtureState(kind.astype(jnp.int32), super().init(key, horizon, size))

    def step(
        self, key: jax.Array, state: MixtureState, signal: jax.Array
    ) -> tuple[jax.Array, MixtureState]:
        """The output of the drawn member."""
        # Not a switch: under vmap, all its branches are computed too, and a step takes little time.
        stepped = [
            process.step(jax.random.fold_in(key, index), inner, signal)
            for index, (process, inner) in enumerate(
                zip(self.processes, state.members, strict=True)
            )
        ]
        signals = jnp.stack([disturbed for disturbed, _ in stepped])
        return signals[state.kind], state.replace(members=tuple(inner for _, inner in stepped))

    def output_size(self, size: int) -> int:
        """The common output size of all members; raises UserError if the sizes differ."""
        sizes = [process.output_size(size) for process in self.processes]
        if len(set(sizes)) > 1:
            each = ", ".join(
                f"{type(process).__name__} {count}"
                for process, count in zip(self.processes, sizes, strict=True)
            )
            raise UserError(
                f"Mixture: the outputs of its members have different sizes ({each}), which an "
                "agent cannot read; hide the same elements in every member"
            )
        return sizes[0]

    def validate(self) -> None:
        """Check the weights and every member."""
        super().validate()
        if not isinstance(self.weights, tuple) or not all(map(_is_weight, self.weights)):
            raise UserError(
                f"Mixture: weights={self.weights!r} must be a tuple of finite numbers, one for "
                "each member"
            )
        if self.weights and len(self.weights) != len(self.processes):
            raise UserError(
                f"Mixture: {len(self.weights)} weights for {len(self.processes)} members; pass "
                "one for each member, or none"
            )
        if any(weight < 0 for weight in self.weights) or (self.weights and not any(self.weights)):
            raise UserError(
                f"Mixture: weights={self.weights} must not be negative, and one must be positive"
            )


def _is_weight(weight: object) -> bool:
    if isinstance(weight, bool) or not isinstance(weight, int | float | np.number):
        return False
    return math.isfinite(weight)
