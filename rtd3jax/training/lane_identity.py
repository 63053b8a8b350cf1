"""The identity of a lane, in its checkpoints: what determines its results.

An identity is a JSON-ready dictionary with the fields of the configuration, the seed, and what else
the caller knows of the lane, such as its plant or its window.
"""

import json
from collections.abc import Mapping
from typing import Any

LONGER = ("total_steps", "replay_capacity")
"""Fields of the configuration that may increase when a lane continues from its checkpoint."""


def same(one: object, other: object) -> bool:
    """Whether two JSON-ready values are the same; NaN is the same as NaN."""
    return json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


def difference(there: object, here: object) -> str:
    """The first difference of two JSON-ready values, in words."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name in {**there, **here}:
            if not same(there.get(name), here.get(name)):
                return f"{name}: {difference(there.get(name), here.get(name))}"
    return f"{there} there, {here} here"


def is_longer(before: Any, after: Mapping[str, Any]) -> bool:
    """Whether ``after``, the identity of a lane, equals ``before`` except for more steps."""
    if not isinstance(before, dict) or before.keys() != after.keys():
        return False
    changed = {name for name in after if not same(before[name], after[name])}
    return (
        "total_steps" in changed
        and changed <= set(LONGER)
        and before["total_steps"] < after["total_steps"]
    )


def why_not_longer(before: Mapping[str, Any], after: Mapping[str, Any], step: int) -> str | None:
    """Why a lane cannot continue to more steps with the results of an uninterrupted training.

    Args:
        before: the configuration of the steps so far.
        after: the configuration with more steps.
        step: number of steps so far.

    Returns:
        The reason, with the field that causes it; None if the lane can continue.
    """
    fraction, slots = before["final_learning_rate_fraction"], before["replay_capacity"]
    if fraction != 1.0:
        return (
            f"its learning rates have been falling towards step {before['total_steps']:,} "
            f"(final_learning_rate_fraction: {fraction})"
        )
    if slots != after["replay_capacity"] and (step > slots or slots > after["replay_capacity"]):
        return f"replay_capacity: {slots} there, {after['replay_capacity']} here"
    if step == before["total_steps"] and step % before["eval_every"]:
        return (
            f"its last evaluation, at step {step:,}, is not a multiple of eval_every "
            f"({before['eval_every']:,})"
        )
    return None
