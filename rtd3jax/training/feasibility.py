"""Checks before compilation whether a configuration can train its networks."""

import warnings

from rtd3jax.config import Config
from rtd3jax.errors import UserError

_ZERO = {
    "actor_learning_rate": "the actor will not change",
    "critic_learning_rate": "the critics will not change",
    "tau": "the target networks will not change",
    "reward_scale": "all rewards in updates will be 0",
}
_OF = {"actor_learning_rate": "actor", "critic_learning_rate": "critics"}
"""The network to which a field applies; it has no effect if the network is frozen."""


def updates_of(config: Config) -> tuple[int, int]:
    """The number of updates of the critics, and of the actor."""
    waits = config.updates_before_the_actor
    actor = config.updates // config.policy_delay - waits // config.policy_delay
    return config.updates, 0 if "actor" in config.frozen else max(0, actor)


def why_untrained(config: Config) -> str | None:
    """Why a configuration will not train its networks, and what to change; None if it will."""
    critics, actor = updates_of(config)
    end = "the actor will not change"
    if {"actor", "critics"} <= set(config.frozen):
        return "freeze names the actor and the critics, so nothing will change: leave out one"
    if critics == 0:
        starts = config.first_learning_step * config.environments
        rounded = f", which becomes {starts:,}" if starts != config.learning_starts else ""
        return (
            f"total_steps ({config.total_steps:,}) is not more than learning_starts "
            f"({config.learning_starts:,}{rounded}), so there will be no update and {end}: "
            "raise total_steps or lower learning_starts"
        )
    if actor == 0 and "actor" not in config.frozen:
        if config.updates_before_the_actor:
            return (
                f"actor_starts ({config.first_actor_step:,}) allows no update of the actor within "
                f"{config.total_steps:,} steps: lower actor_starts, or raise total_steps"
            )
        return (
            f"policy_delay ({config.policy_delay:,}) is more than the {critics:,} critic updates "
            f"of {config.total_steps:,} steps, so {end}: "
            "lower policy_delay or update_every, or raise total_steps"
        )
    for name, what in _ZERO.items():
        if getattr(config, name) == 0 and _OF.get(name) not in config.frozen:
            return f"{name} is 0, so {what}: raise {name}"
    return None


def check_segments(config: Config, horizon: int | None) -> None:
    """Raise UserError if a segment is longer than any episode.

    Args:
        config: the agent's configuration.
        horizon: the maximum number of steps of an episode; None if it is not known.
    """
    if config.replay == "segments" and horizon is not None and config.segment_steps > horizon:
        raise UserError(
            f"segment_length ({config.segment_steps}) is longer than any episode "
            f"({horizon} steps): lower segment_length"
        )


def warn_if_untrained(config: Config) -> None:
    """Warn in one line if the networks will not be trained, which may be intended."""
    reason = why_untrained(config)
    if reason is not None:
        warnings.warn(f"{config.algorithm}: {reason}", stacklevel=4)
