"""Settings of the trainings as flags of the sweep, and marks of earlier settings in tables."""

from collections.abc import Iterable

from rtd3jax.study import presets


def flags(settings: dict[str, object]) -> list[str]:
    """Fields of the configuration as flags of the sweep."""
    return [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]


def setting_text(settings: dict[str, object]) -> str:
    """The text of settings in a table, which distinguishes rows of earlier settings."""
    return " ".join(flags(settings))


ROVER_SETTING = setting_text({**presets.ROVER_SETTINGS, "total_steps": presets.ROVER_STEPS})
"""The current setting of experiments/rover.py, whose table may have rows of earlier settings."""


def mark(older: int, count: int) -> str:
    """The mark of a cell with ``count`` rows, of which ``older`` have earlier settings."""
    if not older:
        return ""
    return " †" if older == count else f" († {older} of {count})"


def notes(older: Iterable[str]) -> list[str]:
    """The lines below a table with the settings of the marked rows."""
    return [f"\n† trained with {setting}" for setting in sorted(set(older))]
