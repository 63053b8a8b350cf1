"""Tests that the site builds without warnings and network, and that its links are valid."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from urllib.parse import unquote

import pytest
from building import ROOT

import rtd3jax

sys.path.insert(0, str(ROOT / "docs" / "_tools"))
import links
import notebook

TEXTS = ["README.md", "CONTRIBUTING.md", "CHANGELOG.md"]
TEXTS += sorted(
    f"docs/{p.name}" for p in (ROOT / "docs").iterdir() if p.suffix in (".md", ".ipynb")
)


def text_of(path):
    text = (ROOT / path).read_text("utf-8")
    if not path.endswith(".ipynb"):
        return text
    return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])


def anchors(text):
    """The anchors that a repository's page gives to headings."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    heads = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def dead_links(path, text):
    """Targets of links in ``text`` that name no file, or no heading of it."""
    dead = []
    for target in filter(links.is_local, links.links(text)):
        named = links.repository_path(target, path)
        anchor = target.partition("#")[2]
        if not (ROOT / named).exists():
            dead.append(target)
        elif anchor:
            there = text if named == path else text_of(named)
            dead += [target] if anchor not in anchors(there) else []
    return dead


@pytest.mark.parametrize("path", TEXTS)
def test_links_of_the_repository_resolve(path):
    assert dead_links(path, text_of(path)) == []


def test_dead_links_are_found():
    text = "# A b\n[x](#a-b) [y](#c) [z](docs/none.md)\n```\n[w](none.md)\n```\n"
    assert dead_links("README.md", text) == ["#c", "docs/none.md"]
    assert links.rewritten(text, "docs/a.md").count("](") == 4
    moved = links.rewritten("[b](docs/a.md#c) ![p](../README.md)", "README.md")
    assert moved.startswith("[b](a.md#c)")
    assert links.rewritten("[b](../README.md)", "docs/a.md") == "[b](index.md)"


class _Page(HTMLParser):
    """What a page refers to, and its anchors."""

    def __init__(self, text):
        super().__init__()
        self.links, self.loaded, self.ids = [], [], set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        self.ids.add(given.get("id"))
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        if tag in ("img", "script", "link") and given.get("rel") not in (
            "canonical",
            "next",
            "prev",
        ):
            self.loaded += [given[k] for k in ("src", "href") if given.get(k)]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    if importlib.util.find_spec("material") is None or not importlib.util.find_spec("mkdocstrings"):
        pytest.skip("the extra docs is not installed: make venv")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "-d", folder]
    # No proxy listens there: whatever asks the network fails.
    nowhere = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    env = {**os.environ, **nowhere, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True)
    assert done.returncode == 0 and "WARNING" not in done.stderr, done.stderr
    return {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}


def test_links_of_the_site_resolve_and_load_nothing_from_elsewhere(site):
    pages = {name: _Page(p.read_text("utf-8")) for name, p in site.items() if p.suffix == ".html"}
    dead = []
    for name, page in pages.items():
        if name == "404.html":  # its links begin at a server's root
            continue
        assert not [t for t in page.loaded if re.match(r"(https?:)?//", t)], name
        for target in filter(links.is_local, [*page.links, *page.loaded]):
            path, _, anchor = unquote(target).partition("#")
            named = links.repository_path(path, name)
            known = named in site or named == "."
            if not known or (anchor and named in pages and anchor not in pages[named].ids):
                dead.append((name, target))
    assert dead == []


def test_the_reference_has_every_public_name(site):
    page = _Page(site["api.html"].read_text("utf-8"))
    documented = {str(anchor).rpartition(".")[2] for anchor in page.ids}
    assert set(rtd3jax.__all__) <= documented


def test_the_notebook_is_shown_with_its_pictures(site):
    text = site["first_steps.html"].read_text("utf-8")
    assert text.count("data:image/png;base64,") == 2 and "agent, seed 0" in text


def the_notebook():
    return json.loads((ROOT / "docs" / "first_steps.ipynb").read_text("utf-8"))


def test_the_notebook_has_small_outputs_without_paths():
    cells = [cell for cell in the_notebook()["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = json.dumps([cell["outputs"] for cell in cells])
    assert "image/png" in outputs and len(outputs) < 300_000
    assert not re.search(r"/(home|root|tmp|work|Users)/", outputs)


def run_notebook(folder, monkeypatch, **changed):
    """The names that its cells leave; ``changed`` has other numbers for its settings."""
    monkeypatch.chdir(folder)
    cells = the_notebook()
    for cell in cells["cells"]:
        source = "".join(cell["source"])
        for name, value in changed.items():
            source = re.sub(rf"{name}=[\d_]+", f"{name}={value}", source)
        cell["source"] = [source]
    return notebook.execute(cells), cells


@pytest.mark.slow
def test_the_notebook_runs(tmp_path, monkeypatch):
    """With fewer steps: `test_the_notebook_learns` has them all."""
    small = {"total_steps": 800, "eval_every": 400, "eval_episodes": 2, "episodes": 20}
    names, cells = run_notebook(tmp_path, monkeypatch, **small)
    assert names["run"].returns.shape == (2, 2) and names["played"].returns.shape == (1,)
    shown = [
        o["data"]["text/plain"] for c in cells["cells"] for o in c.get("outputs", []) if "data" in o
    ]
    assert shown.count(["True"]) == 2, "loaded and exported policies act as the trained one"


@pytest.mark.slow
def test_the_notebook_learns(tmp_path, monkeypatch):
    names, _ = run_notebook(tmp_path, monkeypatch)
    assert names["run"].returns[:, -1].min() > names["marks"]["constant command"] + 1.0
    assert names["marks"]["ceiling"] > names["marks"]["PI controller"]
