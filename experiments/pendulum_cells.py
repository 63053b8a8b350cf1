"""The cells of the paper's figures of the pendulum, for experiments/pendulum.py.

The cells are six agents under the paper's four disturbances, and `lstm-td3` with and without past
actions under three other disturbances, for which the paper compares both. Each has every window
length. Those of `BEYOND_THE_PAPER` can be given as disturbances: claim 11 compares agents that
learned under them. The settings are those of the preset `pendulum`; experiments/pendulum_search.py
found them under `hidden`. `h-td3` has different settings, because its critics read carries that an
old version of the actor stored.
"""

import argparse
from collections.abc import Iterable
from typing import Any

import pandas as pd
from settings import setting_text

import rtd3jax as rtd
from rtd3jax.study import presets


def settings_of(algorithm: str) -> dict[str, object]:
    """Fields of the agent's configuration that differ from the defaults."""
    return {**presets.PENDULUM_SETTINGS, **presets.PENDULUM_OWN_SETTINGS.get(algorithm, {})}


def current_setting(algorithm: str) -> str:
    """`settings_of` the agent, as the text in tables."""
    return setting_text(settings_of(algorithm))


HISTORIES = ("lstm-td3", "lstm-td3-no-action")
"""The agents of the paper's figure of action history."""


CLEAN_NOISE = "noise:sigma=1.0,reward_from=state"
"""Noise in the observations alone; the paper's `noise` also disturbs the rewards."""
HARD_BIAS = "temporal-bias:amplitude_min=1.0,amplitude_max=1.0"
"""The bias of the paper's figure of generalisation."""
BEYOND_THE_PAPER = (CLEAN_NOISE, HARD_BIAS)
"""Disturbances under which the paper trains no agent: claim 11 compares agents trained there."""


def in_the_paper(disturbance: str, algorithm: str) -> bool:
    """Whether a figure of the paper shows the agent under the disturbance."""
    if disturbance in BEYOND_THE_PAPER:
        return False
    return disturbance not in presets.ACTION_HISTORY_DISTURBANCES or algorithm in HISTORIES


def cells(options: argparse.Namespace, tiny: dict[str, Any]) -> list[rtd.Cell]:
    """The cells of the given lengths, disturbances and agents, in the order of the lengths.

    Without ``options.disturbances``, they are the paper's cells, with its comparison of action
    history. ``tiny`` holds fields for a small configuration.
    """
    pairs = [
        (disturbance, algorithm)
        for disturbance in options.disturbances or presets.PENDULUM_DISTURBANCES
        for algorithm in options.algorithms
    ]
    if not options.disturbances:
        pairs += [
            (disturbance, algorithm)
            for disturbance in presets.ACTION_HISTORY_DISTURBANCES
            for algorithm in HISTORIES
            if algorithm in options.algorithms
        ]
    found: dict[tuple[object, ...], rtd.Cell] = {}
    for length in options.lengths:
        for disturbance, algorithm in pairs:
            factor = presets.PENDULUM_STEPS_FACTOR.get(algorithm, 1)
            fields: dict[str, Any] = {
                **settings_of(algorithm),
                "total_steps": options.steps * factor,
                "hidden_size": options.width,
                **tiny,
            }
            config = rtd.Config(
                algorithm=algorithm, history_length=length if algorithm != "td3" else None, **fields
            )
            cell = rtd.Cell("pendulum", disturbance, config)
            found.setdefault(tuple(cell.key.values()), cell)
    return list(found.values())


def missing(wanted: list[rtd.Cell], lanes: pd.DataFrame, seeds: Iterable[int]) -> list[rtd.Cell]:
    """The cells of which the table ``lanes`` lacks some of ``seeds`` with the current settings."""

    def stands(cell: rtd.Cell) -> bool:
        config = cell.config
        own = lanes[
            (lanes["algorithm"] == config.algorithm)
            & (lanes["history_length"] == config.window_tokens)
            & (lanes["disturbance"] == cell.disturbance)
            & (lanes["setting"] == current_setting(config.algorithm))
            & (lanes["steps"] == config.total_steps)
            & (lanes["width"] == config.hidden_size)
        ]
        return set(seeds) <= set(own["seed"])

    return [cell for cell in wanted if lanes.empty or not stands(cell)]
