"""Settings of the trainings, as the sweep's flags, and the marks of earlier ones in tables."""

from collections.abc import Iterable


def flags(settings: dict[str, object]) -> list[str]:
    """Fields of the configuration, for the sweep's command line."""
    return [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]


def setting_text(settings: dict[str, object]) -> str:
    """The setting of a run's rows, by which rows of an earlier one are known."""
    return " ".join(flags(settings))


def mark(older: int, count: int) -> str:
    """What follows a cell of ``count`` rows, ``older`` of which are of an earlier setting."""
    if not older:
        return ""
    return " †" if older == count else f" († {older} of {count})"


def notes(older: Iterable[str]) -> list[str]:
    """The lines below a table that say what the marked rows were trained with."""
    return [f"\n† trained with {setting}" for setting in sorted(set(older))]
