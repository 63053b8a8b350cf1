"""Builds the wheel and the sdist of a copy of the project, offline."""

import pathlib
import shutil
import subprocess
import sys
import tarfile

ROOT = pathlib.Path(__file__).parents[2]
_NOT_COPIED = shutil.ignore_patterns(
    ".*", "__pycache__", "*.egg-info", "build", "dist", "runs", "results", "site"
)


def build(folder):
    """Paths of the wheel and the sdist; the wheel is built from what the sdist holds."""
    source = folder / "source"
    shutil.copytree(ROOT, source, ignore=_NOT_COPIED)
    (source / "experiments" / "results").mkdir()
    (source / "experiments" / "results" / "table.md").write_text("a result")
    sdist = _backend("build_sdist", source, folder / "dist")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (unpacked,) = (folder / "unpacked").iterdir()
    return _backend("build_wheel", unpacked, folder / "dist"), sdist


def _backend(hook, source, out):
    """Call a hook of PEP 517's, as `pip install --no-build-isolation` does."""
    out.mkdir(exist_ok=True)
    code = f"from setuptools import build_meta; print(build_meta.{hook}({str(out)!r}))"
    done = subprocess.run([sys.executable, "-c", code], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return out / done.stdout.split()[-1]
