"""What mkdocs does beside its own: the repository's pages and results, and the notebook.

Files outside of docs/ that a page links to become files of the site; links are written for the
repository's page and are rewritten here.
"""

import json
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

sys.path.insert(0, str(Path(__file__).parent))
import links  # noqa: E402
import notebook  # noqa: E402
import reference  # noqa: E402

_PAGES = ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")
_source_of: dict[str, str] = {}
"""Paths in the repository of the site's pages."""


def on_files(files: Files, config: Any) -> Files:
    """Add what stands outside of docs/: three pages, and whatever pages link to."""
    _source_of.clear()
    for file in list(files.documentation_pages()):
        _source_of[file.src_uri] = f"docs/{file.src_uri}"
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            files.remove(file)
            _add_page(files, config, f"docs/{file.src_uri}")
    files.append(File.generated(config, "api.md", content=reference.page()))
    waiting = [*_PAGES, *_source_of.values()]
    seen = set(waiting)
    while waiting:
        source = waiting.pop()
        path = links.ROOT / source
        if source.endswith(".md") and links.on_the_site(source) not in _source_of:
            _add_page(files, config, source)
        if path.suffix not in (".md", ".ipynb"):
            if not source.startswith("docs/"):
                files.append(File.generated(config, source, abs_src_path=str(path)))
            continue
        for target in filter(links.is_local, links.links(_markdown(source))):
            linked = links.repository_path(target, source)
            if linked not in seen and (links.ROOT / linked).is_file():
                seen.add(linked)
                waiting.append(linked)
    return files


def on_page_read_source(page: Any, config: Any) -> str | None:
    """The page's text with links that hold on the site; None leaves it to mkdocs."""
    source = _source_of.get(page.file.src_uri)
    if source is None:
        return None
    return links.rewritten(_markdown(source), source)


def _markdown(source: str) -> str:
    text = (links.ROOT / source).read_text("utf-8")
    return notebook.as_markdown(json.loads(text)) if source.endswith(".ipynb") else text


def _add_page(files: Files, config: Any, source: str) -> None:
    uri = links.on_the_site(source)
    _source_of[uri] = source
    files.append(File.generated(config, uri, content=""))
