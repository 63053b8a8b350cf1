"""Whether a configuration can train at all: said in one line before anything is compiled."""

import warnings

from rtd3jax.config import Config
from rtd3jax.errors import UserError

_ZERO = {
    "actor_learning_rate": "the actor will stay as it began",
    "critic_learning_rate": "the critics will stay as they began",
    "tau": "the targets will stay as they began",
    "reward_scale": "no reward will be learnt from",
}


def updates_of(config: Config) -> tuple[int, int]:
    """How often the critics and the actor will be updated."""
    waits = config.updates_before_the_actor
    actor = config.updates // config.policy_delay - waits // config.policy_delay
    return config.updates, 0 if "actor" in config.frozen else max(0, actor)


def why_untrained(config: Config) -> str | None:
    """Why a configuration trains no agent, and what to change; None where it trains one."""
    critics, actor = updates_of(config)
    end = "the actor will stay as it began"
    if critics == 0:
        return (
            f"total_steps ({config.total_steps:,}) is not more than learning_starts "
            f"({config.learning_starts:,}), so that no update is made and {end}: "
            "raise total_steps or lower learning_starts"
        )
    if actor == 0 and "actor" not in config.frozen:
        if config.updates_before_the_actor:
            return (
                f"actor_starts ({config.actor_starts:,}) leaves the actor no update within "
                f"{config.total_steps:,} steps: lower it, or raise total_steps"
            )
        return (
            f"policy_delay ({config.policy_delay:,}) is more than the {critics:,} critic updates "
            f"of {config.total_steps:,} steps, so that {end}: "
            "lower policy_delay or update_every, or raise total_steps"
        )
    for name, what in _ZERO.items():
        if getattr(config, name) == 0:
            return f"{name} is 0, so that {what}: raise it"
    return None


def check_segments(config: Config, horizon: int | None) -> None:
    """Raise UserError where a segment is longer than an episode ever gets.

    Args:
        config: the agent's.
        horizon: an episode's longest, in steps; None where it is not known.
    """
    if config.replay == "segments" and horizon is not None and config.segment_steps > horizon:
        raise UserError(
            f"segment_length ({config.segment_steps}) is longer than an episode ever gets "
            f"({horizon} steps): lower it"
        )


def warn_if_untrained(config: Config) -> None:
    """Warn in one line where nothing would be learnt; a training of nothing may be meant."""
    reason = why_untrained(config)
    if reason is not None:
        warnings.warn(f"{config.algorithm}: {reason}", stacklevel=4)
