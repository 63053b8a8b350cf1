"""What the package asks of an environment and of a policy, whoever wrote it.

Their states and parameters are pytrees of their own, of which the package knows nothing: where they
pass through, their type is ``object``.
"""

from typing import Any, Protocol

import jax


class EnvironmentLike(Protocol):
    """A gymnax >= 1.0 environment; `rtd3jax.envs.entry.check_gymnax` says what lacks."""

    @property
    def default_params(self) -> Any:
        """Parameters for where none are given; numbers in them may be traced."""

    def reset(self, key: jax.Array, params: Any = None, /) -> tuple[Any, Any]:
        """The first observation [O] of an episode, and the state."""

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any = None, /
    ) -> tuple[Any, Any, Any, Any, Any, dict]:
        """Observation [O], state, reward [], terminated [], truncated [], info."""

    def action_space(self, params: Any = None, /) -> Any:
        """The bounded Box of actions."""


class ComposableEnvironment(EnvironmentLike, Protocol):
    """What a disturbance is composed with: the parts of gymnax's ``Environment``."""

    @property
    def name(self) -> str:
        """The name used in messages."""

    @property
    def num_actions(self) -> int:
        """Elements of an action."""

    def reset_env(self, key: jax.Array, params: Any, /) -> tuple[Any, Any]:
        """As `reset`."""

    def step_env(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any, /
    ) -> tuple[Any, Any, Any, Any, dict]:
        """Observation [O], state, reward [], terminated [], info; without an automatic reset."""

    def is_terminated(self, state: Any, params: Any, /) -> Any:
        """Whether the episode ended by itself."""

    def is_truncated(self, state: Any, params: Any, /) -> Any:
        """Whether the time limit was reached."""

    def observation_space(self, params: Any = None, /) -> Any:
        """The Box of observations; many environments have none."""


class PolicyLike(Protocol):
    """What `rtd3jax.evaluate` plays; a pytree, so that it can be an argument of compiled code."""

    def init(self, key: jax.Array | None = None, /) -> Any:
        """The state before an episode's first step; a random policy starts its stream by ``key``.

        ``key`` None gives a fixed stream.
        """

    def step(self, state: Any, observation: jax.Array, /) -> tuple[Any, Any]:
        """The action for ``observation`` [O], and the next state."""
