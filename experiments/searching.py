"""A search over settings that can be interrupted and continued; each setting has a CSV row."""

import argparse
import pathlib
import sys
from collections.abc import Callable, Iterable, Sequence

import pandas as pd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import parse  # noqa: E402


def go_through(
    settings: Iterable[dict], search: Callable[[dict], dict], out: pathlib.Path, defaults: dict
) -> None:
    """Append ``{**setting, **search(setting)}`` to ``out`` for each setting without a row.

    A row has every field of its setting. ``defaults`` are the values of fields that rows of an
    earlier search do not have, because they were not varied then.
    """
    rows = pd.read_csv(out).to_dict("records") if out.exists() else []
    rows = [{**defaults, **row} for row in rows]
    for setting in settings:
        assert setting.keys() <= defaults.keys(), "a field without its default"
        if any(all(row[name] == value for name, value in setting.items()) for row in rows):
            continue
        rows.append({**setting, **search(setting)})
        print(rows[-1], flush=True)
        out.parent.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(rows).to_csv(out, index=False)


def search_main(
    arguments: list[str] | None,
    description: str,
    results: pathlib.Path,
    base: dict,
    changes: Sequence[dict],
    search: Callable[[dict, int], dict],
    episodes: int,
) -> None:
    """The command line of a search: ``search(setting, episodes)`` for each of ``changes``.

    ``--only`` names settings by their places in ``changes``, from 0. ``--quick`` only goes through
    the first two of the settings, with tiny trainings.
    """
    parser = argparse.ArgumentParser(description=description.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    numbers = range(len(changes))
    parser.add_argument("--only", type=int, nargs="+", metavar="N", choices=numbers)
    parser.add_argument("--out", type=pathlib.Path, default=results)
    options = parse(parser, arguments)
    if options.only:
        changes = [changes[number] for number in options.only]
    tiny = {}
    if options.quick:
        tiny = {"total_steps": 1_200, "hidden_size": 8}
        changes, episodes = changes[:2], 10
    go_through(
        ({**base, **change, **tiny} for change in changes),
        lambda setting: search(setting, episodes),
        options.out,
        base,
    )
