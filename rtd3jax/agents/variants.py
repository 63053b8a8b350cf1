"""The definitions of the agents (paper, Sections 3, 5 and 6).

A network has one or two streams, whose features are concatenated before the head:

* *memory*: Linear-ReLU-memory over a window of tokens;
* *current*: Linear-ReLU on the current step only.

``td3`` has networks without a memory; the recurrent agents only differ in the streams' inputs.
"""

import dataclasses
from typing import Any

from rtd3jax.agents.networks import Linear, NetworkSpec
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS, LEARNERS


@dataclasses.dataclass(frozen=True)
class Variant:
    """The definition of an agent.

    Attributes:
        actor: inputs of the actor.
        critic: inputs of the critics.
        learner: registered name of the learner.
        colour: colour of the curves; None for an automatic choice.
        colour_on_dark: colour on a dark page, if it must differ.
        peak_arrays: peak memory of an update, in arrays of [l + 1, B, H], for the memory plan: the
            bytes that XLA reserves for the compiled loop on a CPU, divided by the size of an array.
        encoder: a function of ``inputs`` and ``outputs`` that returns the first layer of a stream.
    """

    actor: NetworkSpec
    critic: NetworkSpec
    learner: str = "td3"
    colour: str | None = None
    colour_on_dark: str | None = None
    peak_arrays: float = 30.0
    encoder: Any = Linear

    @property
    def has_window(self) -> bool:
        """Whether the agent reads past steps, so that the history length has an effect."""
        return bool(self.actor.memory or self.critic.memory)

    @property
    def critic_reads_carries(self) -> bool:
        """Whether the critics start from the behaviour actor's carries, which the replay stores."""
        return self.critic.carry_from_replay

    @property
    def reads_truth(self) -> bool:
        """Whether the critics read the undisturbed observation (a privileged critic)."""
        return _T in self.critic.current


_O = "observation"
_A = "action"
_P = "previous_action"
_T = "true_observation"
PARTS = (_O, _A, _P, _T)
"""Parts of tokens; only the current stream of critics may read the true observation."""

_ONE_HEADED_ACTOR = NetworkSpec(memory=(_O, _P), memory_has_current=True)

# Colours that colour-blind readers can distinguish: the palette of Okabe and Ito, "Color Universal
# Design" (2008), without its yellow, which is too light for a line on white.
_PAPER: dict[str, Variant] = {
    "td3": Variant(
        actor=NetworkSpec(current=(_O,)),
        critic=NetworkSpec(current=(_O, _A)),
        colour="#000000",
        colour_on_dark="#F2F2F2",
        peak_arrays=5.0,
    ),
    "lstm-td3": Variant(
        actor=NetworkSpec(memory=(_O, _A), current=(_O,)),
        critic=NetworkSpec(memory=(_O, _A), current=(_O, _A)),
        colour="#0072B2",
        colour_on_dark="#3D9BE0",
        peak_arrays=21.5,
    ),
    "lstm-td3-no-action": Variant(
        actor=NetworkSpec(memory=(_O,), current=(_O,)),
        critic=NetworkSpec(memory=(_O,), current=(_O, _A)),
        colour="#E69F00",
        peak_arrays=21.0,
    ),
    "lstm-td3-1ha1hc": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(memory=(_O, _A), memory_has_current=True),
        colour="#009E73",
        peak_arrays=22.5,
    ),
    "lstm-td3-1ha2hc": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(memory=(_O, _P), memory_has_current=True, current=(_A,)),
        colour="#CC79A7",
        peak_arrays=22.5,
    ),
    "h-td3": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(memory=(_O, _A), memory_has_current=True, carry_from_replay=True),
        colour="#D55E00",
        peak_arrays=19.0,
    ),
}

ALGORITHMS = tuple(_PAPER)
"""The six agents of the paper."""

_BEYOND: dict[str, Variant] = {
    # An asymmetric actor-critic (Pinto et al., 2018): in simulation, the critics may read what the
    # actor must infer. The policy never reads it.
    "lstm-td3-privileged": Variant(
        actor=_ONE_HEADED_ACTOR,
        critic=NetworkSpec(current=(_T, _P, _A)),
        colour="#56B4E9",
        peak_arrays=22.5,
    ),
}


def register_agent(name: str, variant: Variant, *, replace: bool = False) -> None:
    """Register an agent, for ``Config(algorithm=name)``.

    Args:
        name: the name in the configuration, in tables and in saved files.
        variant: the definition of the agent.
        replace: whether it may replace an agent of the same name.

    Raises:
        UserError: when the name is taken, or ``variant`` cannot be trained.
    """
    if not isinstance(variant, Variant):
        raise UserError(f"agent {name!r} must be an rtd.Variant, not {variant!r}")
    _check(name, variant)
    AGENTS.register(name, variant, replace=replace)


def _check(name: str, variant: Variant) -> None:
    """Raise UserError unless the inputs of actor and critic are available when they act."""
    LEARNERS.check(variant.learner)
    actor, critic = variant.actor, variant.critic
    for role, reads in (("actor", actor), ("critic", critic)):
        if not reads.memory and not reads.current:
            raise UserError(f"agent {name!r}: its {role} reads nothing")
        for part in (*reads.memory, *reads.current):
            if part not in PARTS:
                raise UserError(
                    f"agent {name!r}: its {role} reads {part!r}; the parts are {', '.join(PARTS)}"
                )
    if _T in (*actor.memory, *actor.current, *critic.memory):
        raise UserError(
            f"agent {name!r}: {_T!r} is for the current stream of critics only: it is unknown when "
            "a policy acts"
        )
    if _A in actor.current or (_A in actor.memory and actor.memory_has_current):
        raise UserError(
            f"agent {name!r}: its actor reads the action that it must choose; use "
            "'previous_action', or end its memory before the current step"
        )
    if _A not in critic.current and not (_A in critic.memory and critic.memory_has_current):
        raise UserError(f"agent {name!r}: its critic does not read the current action")
    if critic.carry_from_replay and not (actor.memory and critic.memory):
        raise UserError(
            f"agent {name!r}: a critic that starts from the actor's carry needs a memory, as its "
            "actor does"
        )


for _name, _variant in (_PAPER | _BEYOND).items():
    register_agent(_name, _variant)
