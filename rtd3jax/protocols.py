"""The methods that the package needs of an environment and of a policy.

An environment and a policy choose the types of their states and parameters: any pytree. Where the
package only passes such a pytree on, its type is ``object``.
"""

from typing import Any, Protocol

import jax


class EnvironmentLike(Protocol):
    """A gymnax >= 1.0 environment; `rtd3jax.envs.entry.check_gymnax` names what is missing."""

    @property
    def default_params(self) -> Any:
        """Parameters that are used when the caller gives none; their numbers may be traced."""

    def reset(self, key: jax.Array, params: Any = None, /) -> tuple[Any, Any]:
        """The first observation [O] of an episode, and the state."""

    def step(
        self, key: jax.Array, state: Any, action: jax.Array, params: Any = None, /
    ) -> tuple[Any, Any, Any, Any, Any, dict]:
        """One step with automatic reset.

        Returns observation [O], state, reward [], terminated [], truncated [] and info.
        """

    def action_space(self, params: Any = None, /) -> Any:
        """The bounded Box of actions."""


class ComposableEnvironment(EnvironmentLike, Protocol):
    """An environment that can be disturbed: it has the methods of gymnax's ``Environment``."""

    @property
    def name(self) -> str:
        """The name used in messages."""

    @property
    def num_actions(self) -> int:
        """Elements of an action."""

    def reset_env(self, key: jax.Array, params: Any, /) -> tuple[Any, Any]:
        """As `reset`, but ``params`` is required."""

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
    """A policy for `rtd3jax.evaluate`; a pytree, so that it can be an argument of compiled code."""

    def init(self, key: jax.Array | None = None, /) -> Any:
        """The state before an episode's first step.

        A random policy draws its numbers from ``key``; None stands for a fixed key.
        """

    def step(self, state: Any, observation: jax.Array, /) -> tuple[Any, Any]:
        """The action for ``observation`` [O], and the next state."""
