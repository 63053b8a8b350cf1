"""Writes the page: data, code and style in one HTML document."""

import datetime
import functools
import html
import importlib.resources
import json
import os
import sys
from pathlib import Path
from typing import Any

from rtd3jax.errors import UserError, short_reason
from rtd3jax.study.ceilings import ceilings_of
from rtd3jax.study.report.data import study_data
from rtd3jax.study.report.playback import recordings
from rtd3jax.study.report.robustness import robustness_data
from rtd3jax.study.report.table import policies_of
from rtd3jax.study.report.transfer import transfer_data
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.statistics import seed_means
from rtd3jax.study.tables import current_tables
from rtd3jax.system.files import user_path, write_bytes_atomically
from rtd3jax.system.versions import versions_of

NAME = "report.html"
_GENERATOR = '<meta name="generator" content="rtd3jax">'
_SCRIPTS = (
    "dom",
    "charts",
    "filters",
    "curves",
    "learning",
    "finals",
    "table",
    "transfer",
    "robustness",
    "player",
    "main",
)


def write_page(
    directory: RunDirectory,
    path: Path | None = None,
    *,
    complete: bool = True,
    playback: bool = True,
) -> Path:
    """Write the page of a run; return its path.

    Args:
        directory: the run directory.
        path: the path of the page; ``report.html`` in the run directory by default.
        complete: whether to compute missing ceilings and play missing episodes. Without this, the
            page only has those that are stored, and is written fast.
        playback: whether the page has episodes.

    Raises:
        UserError: when ``path`` is a file that is not such a page, or cannot be written.
    """
    path = directory.path / NAME if path is None else user_path(path)
    _check_ours(path)
    page = render(page_data(directory, complete=complete, playback=playback))
    try:
        write_bytes_atomically(path, page.encode())
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
    return path


def refresh_page(directory: RunDirectory, *, complete: bool) -> None:
    """Write the page; an error is printed, and the sweep continues."""
    try:
        write_page(directory, complete=complete)
    except Exception as error:
        reason = short_reason(error)
        print(f"{NAME} was not written: {reason}", file=sys.stderr)


def page_data(directory: RunDirectory, *, complete: bool, playback: bool) -> dict[str, Any]:
    """The data of the page, JSON-ready; the arguments are those of `write_page`."""
    notes: list[str] = []
    tables = current_tables(directory, notes)
    lanes = seed_means(tables["episodes"])
    data = study_data(directory, tables, lanes, notes)
    ceilings = ceilings_of(directory.path, directory.cells, compute=complete)
    for environment in data["environments"]:
        environment["ceiling"] = ceilings.get((environment["env"], environment["disturbance"]))
    policies = functools.cache(lambda: policies_of(directory))  # for both tables
    try:
        data["transfer"] = transfer_data(directory, policies, notes)
    except UserError as error:
        data["transfer"] = None
        notes.append(str(error))
    try:
        data["robustness"] = robustness_data(directory, policies, notes)
    except UserError as error:
        data["robustness"] = None
        notes.append(str(error))
    data["playback"] = []
    if playback:
        data["playback"] = recordings(directory, lanes, record=complete, notes=notes)
    data["with_playback"] = playback
    data["notes"] = notes
    data["complete"] = complete
    data["written"] = datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC")
    data["rtd3jax"] = versions_of(["rtd3jax"])["rtd3jax"]
    return data


def render(data: dict[str, Any]) -> str:
    """The HTML document; a browser reads nothing in ``data`` as HTML or as code."""
    parts = importlib.resources.files("rtd3jax.study.report") / "page"
    scripts = "\n".join((parts / f"{name}.js").read_text("utf-8") for name in _SCRIPTS)
    pieces = {
        "GENERATOR": _GENERATOR,
        "TITLE": html.escape(str(data["title"])),
        "STYLE": (parts / "page.css").read_text("utf-8"),
        "DATA": _json_in_html(data),
        "SCRIPT": f"(() => {{\n'use strict';\n{scripts}\n}})();",
    }
    document = (parts / "page.html").read_text("utf-8")
    # The template is split first, so that marks in a run's own text are never replaced.
    found = document.split("@@")
    page = "".join(pieces[part] if index % 2 else part for index, part in enumerate(found))
    # The name of the run may contain bytes that are not text.
    return page.encode("utf-8", "replace").decode()


def _json_in_html(data: object) -> str:
    """JSON without characters that can end a script element."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return text


def _check_ours(path: Path) -> None:
    """Raise UserError if ``path`` is a file that is not such a page."""
    try:
        if os.path.lexists(path) and _GENERATOR not in path.read_text("utf-8", "replace")[:2000]:
            raise UserError(f"{path} exists and is not a page of rtd3jax; choose another --out")
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from error
