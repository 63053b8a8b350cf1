"""A search over settings that may be stopped and gone on with: a row of a CSV for each setting."""

import pathlib
from collections.abc import Callable, Iterable

import pandas as pd


def go_through(
    settings: Iterable[dict], search: Callable[[dict], dict], out: pathlib.Path, defaults: dict
) -> None:
    """Append ``{**setting, **search(setting)}`` to ``out`` for each setting without a row there.

    A row knows every field of its setting; ``defaults`` are the values of those fields that a row
    of an earlier search lacks, because they were not varied then.
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
