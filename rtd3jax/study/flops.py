"""The floating-point operations of the updates of an agent."""

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.networks import Network
from rtd3jax.config import Config
from rtd3jax.registries import AGENTS


def update_flops(config: Config) -> float:
    """Floating-point operations of the updates' matrix products, per environment step.

    The backward pass of a layer takes two forward passes, one for the gradient of its weights and
    one for the gradient of its input. The first token of a window has no carry, and so no recurrent
    product. No gradient flows into a carry from the replay. Only products that grow with H squared
    are counted; the small products of encoders and outputs are left out. tests/study/test_flops.py
    compares the result with XLA's count.
    """
    variant, batch, width = AGENTS[config.algorithm], config.batch_size, config.hidden_size
    layer = 2.0 * batch * width * width
    # Neither count depends on the sizes of observations and actions, which are small.
    actor, critic = (make_part(variant, role, config.memory, 1, 1, width) for role in _ROLES)

    def token(network: Network) -> tuple[float, float]:
        of_input, of_carry = network.memory.operations() if network.memory else (0.0, 0.0)
        return batch * of_input, batch * of_carry

    def head(network: Network) -> float:
        return layer * (1 + bool(network.reads.memory and network.reads.current))

    segments = config.replay == "segments"

    def present(network: Network) -> float:
        """The current token, and the layers after the memory."""
        return network.reads.memory_has_current * sum(token(network)) + head(network)

    def forward(network: Network) -> float:
        """A history, and a current token that is not part of the history."""
        if not network.reads.memory or network.reads.carry_from_replay:
            return present(network)
        if segments:
            return passed(network, config.window_tokens) + present(network)
        # The first token has no carry.
        return config.window_tokens * sum(token(network)) - token(network)[1] + present(network)

    def passed(network: Network, burn_in: int) -> float:
        """A pass over the tokens of all segments."""
        length = config.segment_steps
        return (burn_in + length) / length * sum(token(network))

    def recorded(network: Network) -> float:
        """The recorded actions, which are part of the segment's tokens."""
        if segments and network.reads.memory and not network.reads.carry_from_replay:
            return passed(network, config.window_tokens) + head(network)
        return forward(network)

    def backward(network: Network) -> float:
        if segments and network.reads.memory and not network.reads.carry_from_replay:
            burn_in = config.window_tokens if config.burn_in_gradient else 0
            return 2 * (passed(network, burn_in) + head(network))
        return 2 * forward(network) - token(network)[1] * network.reads.carry_from_replay

    to_action = head(critic)
    if critic.reads.memory_has_current and "action" in critic.reads.memory:
        to_action += token(critic)[0]
    critics = forward(actor) + 2 * forward(critic) + 2 * (recorded(critic) + backward(critic))
    delayed = recorded(actor) + backward(actor) + forward(critic) + to_action
    return (critics + delayed / config.policy_delay) / config.update_every


_ROLES = ("actor", "critic")
