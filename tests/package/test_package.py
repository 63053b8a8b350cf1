"""Tests that the built packages are complete, and work outside the repository."""

import email
import os
import subprocess
import sys
import tarfile
import tomllib
import zipfile

import pytest
from building import ROOT, build

import rtd3jax

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build(tmp_path_factory.mktemp("build"))


def package_files():
    """Every file of the package, as it lies in the repository."""
    files = (path for path in (ROOT / "rtd3jax").rglob("*") if path.is_file())
    return {str(p.relative_to(ROOT)) for p in files if "__pycache__" not in p.parts}


def test_the_wheel_holds_the_package_and_nothing_else(built):
    with zipfile.ZipFile(built[0]) as wheel:
        names = set(wheel.namelist())
        about = next(name for name in names if name.endswith(".dist-info/METADATA"))
        metadata = email.message_from_bytes(wheel.read(about))
    held = {name for name in names if ".dist-info/" not in name}
    assert held == package_files()
    assert {"rtd3jax/py.typed", "rtd3jax/study/report/page/page.html"} <= held
    assert metadata["Version"] == PROJECT["version"]
    assert metadata["License-Expression"] == "Apache-2.0"
    assert any(name.endswith("/LICENSE") for name in names)
    assert metadata.get_payload().startswith("# rtd3jax")


def test_the_sdist_holds_what_the_wheel_needs_and_no_tests(built):
    with tarfile.open(built[1]) as archive:
        held = {m.name.partition("/")[2] for m in archive.getmembers() if m.isfile()}
    assert held >= package_files() | {"pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md"}
    tops = {name.partition("/")[0] for name in held}
    assert tops.isdisjoint({"tests", "experiments", "docs", "runs"}), tops


def test_the_version_stands_in_one_place():
    assert rtd3jax.__version__ == PROJECT["version"]
    assert f"version: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text()


def played(code, cwd, path):
    """What Python says to ``code`` or arguments where the package lies in ``path`` alone."""
    given = ["-c", code] if isinstance(code, str) else code
    env = {**os.environ, "PYTHONPATH": str(path), "PYTHONIOENCODING": "ascii"}
    done = subprocess.run(
        # -P: nothing of the current directory is imported.
        [sys.executable, "-P", *given],
        cwd=cwd,
        env=env,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


PLAY = """
import gymnasium, rtd3jax
env = gymnasium.make("rtd3jax/Rover-ar1-slip-v0")
env.reset(seed=0)
print(rtd3jax.__file__, env.step(env.action_space.sample())[1])
"""
SWEEP = (
    "-m rtd3jax.sweep --preset quick --seeds 1 --total-steps 200 --hidden-size 8 --batch-size 8 "
    "--learning-starts 50 --eval-every 100 --final-episodes 2 --algorithms td3 --out run --quiet"
)


@pytest.mark.slow
def test_the_wheel_works_without_the_repository(built, tmp_path):
    target, elsewhere = tmp_path / "target", tmp_path / "elsewhere"
    elsewhere.mkdir()
    install = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--quiet"]
    subprocess.run([*install, "--target", target, built[0]], check=True, capture_output=True)
    assert f"rtd3jax {PROJECT['version']}" in played(["-m", "rtd3jax"], elsewhere, target)
    assert played(PLAY, elsewhere, target).startswith(str(target))
    played(SWEEP.split(), elsewhere, target)
    page = (elsewhere / "run" / "report.html").read_text("utf-8")
    for part in (target / "rtd3jax" / "study" / "report" / "page").glob("*.js"):
        assert part.read_text("utf-8").strip().splitlines()[-1] in page, part
