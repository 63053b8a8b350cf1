"""What experiments/pendulum.py trains: studies of the sweep, in folders of one directory.

* ``main``: the agents that share a setting, under the paper's four disturbances;
* ``h-td3``: the sixth agent, with more exploration, a shorter memory, a slower actor, slower
  targets and more steps. Its critics read carries that an actor of long ago stored, and its actor
  moves on meanwhile;
* ``action-history``: `lstm-td3` with and without past actions, where the paper compares them.

Their settings are those of the preset `pendulum`; experiments/pendulum_search.py found them, under
`hidden`.
"""

import argparse
import dataclasses
import pathlib
from collections.abc import Sequence

from settings import flags, setting_text

from rtd3jax import sweep
from rtd3jax.study import presets


def settings_of(algorithm: str) -> dict[str, object]:
    """Fields of the configuration in which the agent differs from the defaults."""
    return {**presets.PENDULUM_SETTINGS, **presets.PENDULUM_OWN_SETTINGS.get(algorithm, {})}


def current_setting(algorithm: str) -> str:
    """`settings_of` the agent, as it stands in tables."""
    return setting_text(settings_of(algorithm))


@dataclasses.dataclass(frozen=True)
class Study:
    """A study of the sweep: its folder's name, and what is crossed in it."""

    name: str
    disturbances: tuple[str, ...]
    algorithms: tuple[str, ...]

    def train(self, run: pathlib.Path, options: argparse.Namespace, more: list[str]) -> int:
        """Train in ``run`` what is missing; the sweep's exit status."""
        first = self.algorithms[0]
        assert len({current_setting(name) for name in self.algorithms}) == 1
        settings = {
            **settings_of(first),
            "total_steps": options.steps * presets.PENDULUM_STEPS_FACTOR.get(first, 1),
            "hidden_size": options.width,
        }
        lengths = map(str, options.lengths)
        return sweep.main(
            [
                *("--env", "pendulum", "--out", str(run), "--seeds", str(options.seeds)),
                *("--disturbances", *self.disturbances, "--algorithms", *self.algorithms),
                *("--history-lengths", *lengths, *flags(settings), *more),
            ]
        )


def studies(disturbances: Sequence[str], algorithms: Sequence[str]) -> list[Study]:
    """Those of the given agents; without ``disturbances``, under the paper's."""
    given = tuple(disturbances) or presets.PENDULUM_DISTURBANCES
    together = tuple(name for name in algorithms if name not in presets.PENDULUM_OWN_SETTINGS)
    alone = [name for name in algorithms if name in presets.PENDULUM_OWN_SETTINGS]
    found = [Study(name, given, (name,)) for name in alone]
    if together:
        found.insert(0, Study("main", given, together))
    compared = tuple(name for name in ("lstm-td3", "lstm-td3-no-action") if name in algorithms)
    if compared and not disturbances:
        found.append(Study("action-history", presets.ACTION_HISTORY_DISTURBANCES, compared))
    return found
