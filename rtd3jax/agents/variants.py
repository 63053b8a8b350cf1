"""The six agents as data: which tokens go to which stream (paper, Sections 2, 4 and 5; Table 4).

A network has up to two streams whose features are concatenated before its head:

* *memory*: Linear-ReLU-LSTM over a window of tokens;
* *current*: Linear-ReLU on the present step alone.

``td3`` is the network without memory; the recurrent agents differ only in what is read where.
"""

import dataclasses

from rtd3jax.config import ALGORITHMS


@dataclasses.dataclass(frozen=True)
class NetworkSpec:
    """What one network reads.

    Attributes:
        memory: parts of each token of the recurrent stream; empty for none.
        memory_has_current: whether that stream ends with the current token.
        current: parts of the input of the feed-forward stream; empty for none.
        carry_from_replay: whether the LSTM starts from the behaviour actor's stored carry instead
            of reading the past tokens itself (h-td3's critic).
        precision: of its wide products' factors; see `rtd3jax.agents.products`.
    """

    memory: tuple[str, ...] = ()
    memory_has_current: bool = False
    current: tuple[str, ...] = ()
    carry_from_replay: bool = False
    precision: str = "float32"


@dataclasses.dataclass(frozen=True)
class Variant:
    """An agent: what its actor and its critics read."""

    actor: NetworkSpec
    critic: NetworkSpec

    @property
    def stores_carry(self) -> bool:
        """Whether replay keeps the behaviour actor's LSTM carries."""
        return self.critic.carry_from_replay

    def at(self, precision: str) -> "Variant":
        """The same agent with wide products in ``precision``."""
        return Variant(
            dataclasses.replace(self.actor, precision=precision),
            dataclasses.replace(self.critic, precision=precision),
        )


_O = "observation"
_A = "action"
_P = "previous_action"

_ONE_HEADED_ACTOR = NetworkSpec(memory=(_O, _P), memory_has_current=True)

VARIANTS: dict[str, Variant] = {
    "td3": Variant(
        actor=NetworkSpec(current=(_O,)),
        critic=NetworkSpec(current=(_O, _A)),
    ),
    "lstm-td3": Variant(
        actor=NetworkSpec(memory=(_O, _A), current=(_O,)),
        critic=NetworkSpec(memory=(_O, _A), current=(_O, _A)),
    ),
    "lstm-td3-no-action": Variant(
        actor=NetworkSpec(memory=(_O,), current=(_O,)),
        critic=NetworkSpec(memory=(_O,), current=(_O, _A)),
    ),
    "lstm-td3-1ha1hc": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(memory=(_O, _A), memory_has_current=True),
    ),
    "lstm-td3-1ha2hc": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(memory=(_O, _P), memory_has_current=True, current=(_A,)),
    ),
    "h-td3": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(memory=(_O, _A), memory_has_current=True, carry_from_replay=True),
    ),
}

assert tuple(VARIANTS) == ALGORITHMS
