"""Where a file of the repository stands on the site, and its links as they must read there."""

import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
_LINK = re.compile(r"(!?\[[^\]]*\]\()([^)\s]+)(\))")
_FENCE = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)


def on_the_site(path: str) -> str:
    """The page or file that shows ``path`` of the repository: docs/ is the site's root."""
    if path == "README.md":
        return "index.md"
    path = path.removeprefix("docs/")
    return path.removesuffix(".ipynb") + ".md" if path.endswith(".ipynb") else path


def links(text: str) -> Iterator[str]:
    """Every target of a Markdown link outside of blocks of code, those of the web included."""
    for match in _LINK.finditer(_FENCE.sub("", text)):
        yield match[2]


def is_local(target: str) -> bool:
    """Whether it names a file or a heading here."""
    return "://" not in target and not target.startswith(("mailto:", "data:"))


def repository_path(target: str, source: str) -> str:
    """The file that a link in ``source`` names, from the repository's root; without its anchor."""
    path = target.partition("#")[0]
    if not path:
        return source
    return posixpath.normpath(posixpath.join(posixpath.dirname(source), path))


def rewritten(text: str, source: str) -> str:
    """``text`` of the file ``source`` with links that hold on the site."""
    here = posixpath.dirname(on_the_site(source)) or "."

    def replace(match: re.Match[str]) -> str:
        if not is_local(match[2]):
            return match[0]
        _, mark, anchor = match[2].partition("#")
        page = on_the_site(repository_path(match[2], source))
        target = os.path.relpath(page, here) if match[2][0] != "#" else ""
        return f"{match[1]}{target}{mark}{anchor}{match[3]}"

    parts, end = [], 0
    for fence in _FENCE.finditer(text):
        parts += [_LINK.sub(replace, text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join([*parts, _LINK.sub(replace, text[end:])])
