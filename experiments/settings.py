"""Settings of the trainings, as the sweep's flags."""


def flags(settings: dict[str, object]) -> list[str]:
    """Fields of the configuration, for the sweep's command line."""
    return [f"--{name.replace('_', '-')}={value}" for name, value in settings.items()]


def setting_text(settings: dict[str, object]) -> str:
    """The setting of a run's rows, by which rows of an earlier one are known."""
    return " ".join(flags(settings))
