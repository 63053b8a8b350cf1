"""The six agents in PyTorch, with the same work per update as in rtd3jax, written to be fast.

It is fast because of `torch.nn.LSTM` over whole windows, no tape for values without gradients
(targets, and the critic's past tokens in the actor's loss), fused Adam, one fused call for all
Polyak averages, one gather per window. Shapes are those of `numpy_environment`.
"""

import copy

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from experiments.benchmarks.numpy_environment import Batch, Window
from rtd3jax.agents.networks import NetworkSpec
from rtd3jax.agents.variants import Variant

# The input gate of a token that does not exist: its sigmoid is exactly zero.
_SHUT = -1e4

Carry = tuple[torch.Tensor, torch.Tensor]


class Network(nn.Module):
    """Encoder, memory, head, as `rtd3jax.agents.networks`.

    The LSTM has one more input than the encoder has outputs: a flag that closes the input gate of
    missing tokens. These are before all other tokens, so the carry stays zero. The weights of the
    flag get no gradient, because a closed gate passes none.
    """

    def __init__(
        self,
        spec: NetworkSpec,
        observation_size: int,
        action_size: int,
        width: int,
        outputs: int,
    ):
        super().__init__()
        sizes = {
            "previous_action": action_size,
            "observation": observation_size,
            "action": action_size,
        }
        begin = 0 if "previous_action" in spec.memory else action_size
        self.columns = slice(begin, begin + sum(sizes[part] for part in spec.memory))
        self.spec, self.sizes, self.width = spec, sizes, width
        features = 0
        if spec.memory:
            self.encoder = nn.Linear(self.columns.stop - begin, width)
            self.lstm = nn.LSTM(width + 1, width)
            with torch.no_grad():
                self.lstm.weight_ih_l0[:, width] = 0.0
                self.lstm.weight_ih_l0[:width, width] = _SHUT
            features += width
        if spec.current:
            self.current = nn.Linear(sum(sizes[part] for part in spec.current), width)
            features += width
        self.head = nn.Linear(features, width)
        self.output = nn.Linear(width, outputs)

    def carry_before(self, window: Window) -> Carry:
        """Hidden and cell, [1, B, H] each, after the past tokens."""
        past = window.past[..., self.columns]
        return self._run(past, window.missing[:-1], None)

    def forward(
        self, window: Window, action: torch.Tensor | None = None, carry: Carry | None = None
    ) -> torch.Tensor:
        """The output [B, outputs]; with ``carry``, the past tokens are not read."""
        features = []
        if self.spec.memory:
            features.append(self._memory(window, action, carry))
        if self.spec.current:
            features.append(
                functional.relu(self.current(self._token(self.spec.current, window, action)))
            )
        joined = features[0] if len(features) == 1 else torch.cat(features, 1)
        return self.output(functional.relu(self.head(joined)))

    def _memory(self, window: Window, action, carry: Carry | None) -> torch.Tensor:
        if not self.spec.memory_has_current:
            return (self.carry_before(window) if carry is None else carry)[0][0]
        tokens = self._token(self.spec.memory, window, action)[None]
        absent = window.missing[-1:]
        if carry is None:
            tokens = torch.cat((window.past[..., self.columns], tokens))
            absent = window.missing
        return self._run(tokens, absent, carry)[0][0]

    def _run(self, tokens: torch.Tensor, absent: torch.Tensor, carry: Carry | None) -> Carry:
        encoded = functional.relu(self.encoder(tokens))
        return self.lstm(torch.cat((encoded, absent), -1), carry)[1]

    def _token(self, parts: tuple[str, ...], window: Window, action) -> torch.Tensor:
        """The ``parts`` of the current token, in the order of a row."""
        split = self.sizes["previous_action"]
        if "previous_action" in parts:
            return window.current
        named = {"observation": window.current[:, split:], "action": action}
        return action if parts == ("action",) else torch.cat([named[part] for part in parts], 1)


class Learner:
    """Networks, targets and optimisers of one seed, with the updates of rtd3jax's TD3."""

    def __init__(
        self,
        variant: Variant,
        observation_size: int,
        action_size: int,
        width: int,
        *,
        gamma: float = 0.99,
        tau: float = 0.005,
        learning_rate: float = 1e-3,
        noise: float = 0.2,
        noise_clip: float = 0.5,
    ):
        self.variant = variant
        sizes = observation_size, action_size, width
        self.actor = Network(variant.actor, *sizes, action_size)
        self.critics = nn.ModuleList(Network(variant.critic, *sizes, 1) for _ in range(2))
        self.target_actor = copy.deepcopy(self.actor)
        self.target_critics = copy.deepcopy(self.critics)
        self._gamma, self._tau, self._noise, self._clip = gamma, tau, noise, noise_clip
        self._actor_weights = list(self.actor.parameters())
        self._critic_weights = list(self.critics.parameters())
        self._online = self._actor_weights + self._critic_weights
        self._targets = [*self.target_actor.parameters(), *self.target_critics.parameters()]
        self._actor_adam = torch.optim.Adam(self._actor_weights, learning_rate, fused=True)
        self._critic_adam = torch.optim.Adam(self._critic_weights, learning_rate, fused=True)

    def act(self, actor: Network, window: Window, carry: Carry | None = None) -> torch.Tensor:
        """The greedy action [B, A], in half ranges."""
        return torch.tanh(actor(window, carry=carry))

    @torch.no_grad()
    def target(self, batch: Batch, gaussian: torch.Tensor) -> torch.Tensor:
        """The targets y [B], with ``gaussian`` [B, A] for the smoothing noise."""
        noise = (self._noise * gaussian).clamp_(-self._clip, self._clip)
        action = self.act(self.target_actor, batch.next_window).add_(noise)
        action.clamp_(-1.0, 1.0)
        first, second = (
            critic(batch.next_window, action, batch.next_carry)[:, 0]
            for critic in self.target_critics
        )
        bootstrap = self._gamma * (1.0 - batch.terminated) * torch.minimum(first, second)
        return batch.reward + bootstrap

    def update_critics(self, batch: Batch, gaussian: torch.Tensor) -> torch.Tensor:
        """One step of both critics; returns the loss []."""
        y = self.target(batch, gaussian)
        loss = sum(
            functional.mse_loss(critic(batch.window, batch.action, batch.carry)[:, 0], y)
            for critic in self.critics
        )
        self._descend(loss, self._critic_weights, self._critic_adam)
        return loss.detach()

    def update_actor_and_targets(self, batch: Batch) -> None:
        """One step of the actor, then of all targets."""
        carry = batch.carry
        critic = self.critics[0]
        if carry is None and self.variant.critic.memory:
            with torch.no_grad():
                carry = critic.carry_before(batch.window)
        loss = -critic(batch.window, self.act(self.actor, batch.window), carry).mean()
        self._descend(loss, self._actor_weights, self._actor_adam)
        with torch.no_grad():
            torch._foreach_lerp_(self._targets, self._online, self._tau)

    @staticmethod
    def _descend(loss: torch.Tensor, weights: list, adam: torch.optim.Optimizer) -> None:
        for weight, gradient in zip(weights, torch.autograd.grad(loss, weights), strict=True):
            weight.grad = gradient
        adam.step()


def tensors(batch: Batch) -> Batch:
    """The batch as tensors over the same memory, with carries for the LSTM."""
    return Batch(
        window=window_tensors(batch.window),
        action=torch.from_numpy(batch.action),
        reward=torch.from_numpy(batch.reward),
        terminated=torch.from_numpy(batch.terminated),
        next_window=window_tensors(batch.next_window),
        carry=carry_tensors(batch.carry),
        next_carry=carry_tensors(batch.next_carry),
    )


def window_tensors(window: Window) -> Window:
    """The window as tensors over the same memory."""
    return Window(*map(torch.from_numpy, window))


def carry_tensors(carry: np.ndarray | None) -> Carry | None:
    """[B, 2, H] as hidden and cell [1, B, H]."""
    if carry is None:
        return None
    hidden, cell = torch.from_numpy(carry.transpose(1, 0, 2).copy())[:, None]
    return hidden, cell
