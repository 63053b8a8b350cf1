"""Several kinds of disturbance in one training: each episode draws one of them."""

import jax
import jax.numpy as jnp
from flax import struct

from rtd3jax.envs.processes.process import Process
from rtd3jax.errors import UserError


class MixtureState(struct.PyTreeNode):
    """An episode's kind, and the state of every member: those that do not act evolve unseen."""

    kind: jax.Array
    """int32 []: which member acts throughout this episode"""
    members: tuple


class Mixture(Process):
    """One of several processes, drawn when an episode begins; it acts throughout the episode.

    The agent is not told which one it is. Each member has its own random stream. All members must
    make signals of the same number of elements.
    """

    processes: tuple[Process, ...] = ()
    weights: tuple[int, ...] = struct.field(pytree_node=False, default=())
    """How often each member is drawn, relative to the others; equally often if empty."""

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> MixtureState:
        """Draw the kind and every member's state."""
        weights = self.weights or (1,) * len(self.processes)
        logits = jnp.log(jnp.asarray(weights, jnp.float32))
        kind = jax.random.categorical(jax.random.fold_in(key, len(self.processes)), logits)
        members = tuple(
            process.init(jax.random.fold_in(key, index), horizon, size)
            for index, process in enumerate(self.processes)
        )
        return MixtureState(kind.astype(jnp.int32), members)

    def step(
        self, key: jax.Array, state: MixtureState, signal: jax.Array
    ) -> tuple[jax.Array, MixtureState]:
        """What the drawn member makes of the signal."""
        # Under vmap every branch of a switch is computed anyway, and a step costs little.
        stepped = [
            process.step(jax.random.fold_in(key, index), inner, signal)
            for index, (process, inner) in enumerate(
                zip(self.processes, state.members, strict=True)
            )
        ]
        signals = jnp.stack([disturbed for disturbed, _ in stepped])
        return signals[state.kind], state.replace(members=tuple(inner for _, inner in stepped))

    def output_size(self, size: int) -> int:
        """The size that every member makes; UserError where they differ."""
        sizes = [process.output_size(size) for process in self.processes]
        if len(set(sizes)) > 1:
            each = ", ".join(
                f"{type(process).__name__} {count}"
                for process, count in zip(self.processes, sizes, strict=True)
            )
            raise UserError(
                f"Mixture: its members leave different numbers of elements ({each}), which one "
                "agent cannot read; hide the same elements in every member"
            )
        return sizes[0]

    def validate(self) -> None:
        """Check the weights and every member."""
        if not self.processes:
            raise UserError("Mixture has no members: give it processes=(process, process, ...)")
        if self.weights and len(self.weights) != len(self.processes):
            raise UserError(
                f"Mixture: {len(self.weights)} weights for {len(self.processes)} members; give "
                "one for each, or none"
            )
        if any(weight < 0 for weight in self.weights) or (self.weights and not any(self.weights)):
            raise UserError(
                f"Mixture: weights={self.weights} must not be negative, and one must be positive"
            )
        for process in self.processes:
            process.validate()

    def check_use(self, horizon: int, field: str) -> None:
        """Check every member."""
        for process in self.processes:
            process.check_use(horizon, field)
