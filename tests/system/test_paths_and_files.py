"""Tests of files: modes, reasons of errors, home directories, UTF-8."""

import ast
import io
import os
import pathlib
import stat
import sys

import numpy as np
import pytest

import rtd3jax
import rtd3jax as rtd
from rtd3jax.cli import sweep_options
from rtd3jax.cli.common import replace_unprintable
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.system.files import (
    read_arrays,
    user_path,
    write_arrays,
    write_bytes_atomically,
    write_new,
)


@pytest.mark.parametrize("umask", [0o002, 0o022, 0o077])
def test_the_umask_says_who_may_read(umask, tmp_path):
    before = os.umask(umask)
    try:
        write_bytes_atomically(tmp_path / "f", b"one")
        write_bytes_atomically(tmp_path / "f", b"two")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "f").stat().st_mode) == 0o666 & ~umask
    assert (tmp_path / "f").read_bytes() == b"two" and len(list(tmp_path.iterdir())) == 1


def test_the_true_reason_is_said(tmp_path, monkeypatch):
    write_arrays(tmp_path / "f", {"a": np.zeros(1)}, {})
    opened = pathlib.Path.open

    def refuse(path, *rest, **more):
        if path.name == "f":
            raise PermissionError(13, "Permission denied", str(path))
        return opened(path, *rest, **more)

    monkeypatch.setattr(pathlib.Path, "open", refuse)
    with pytest.raises(rtd.UserError, match=r"f cannot be read \(Permission denied\)"):
        read_arrays(tmp_path / "f")
    with pytest.raises(rtd.UserError, match=r"absent cannot be read \(No such file"):
        read_arrays(tmp_path / "absent")


@pytest.mark.parametrize("call", [rtd.load_policy, lambda path: write_new(path, b"")])
def test_a_directory_that_may_not_be_entered(call, monkeypatch):
    def refuse(path, **_):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(pathlib.Path, "is_dir", refuse)
    with pytest.raises(rtd.UserError, match="Permission denied"):
        call("closed/p")


def test_a_home_directory_is_found_in_every_path(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    write_new("~/a/f", b"1")
    write_arrays("~/a/g", {}, {})
    assert read_arrays("~/a/g") == ({}, {}) and (tmp_path / "a" / "f").read_bytes() == b"1"
    given = sweep_options.parser("").parse_args(["--env", "rover", "--out=~/x"])
    assert sweep_options.out(given) == tmp_path / "x"
    RunDirectory.create("~/r", [], [0], 1)
    assert RunDirectory.open(pathlib.Path("~/r")).path == tmp_path / "r"
    assert not (tmp_path / "~").exists()
    with pytest.raises(rtd.UserError, match=f"{tmp_path}/absent cannot be read"):
        rtd.load_policy("~/absent")
    with pytest.raises(rtd.UserError, match="write the whole path"):
        user_path("~nobody-of-this-name/x")


def _unnamed_encodings(source):
    """Lines that open a text file in whatever encoding the machine has."""
    for node in ast.walk(ast.parse(source)):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name)):
            continue
        name = getattr(node.func, "attr", getattr(node.func, "id", ""))
        texts = [a.value for a in node.args if isinstance(getattr(a, "value", None), str)]
        named = any(k.arg == "encoding" for k in node.keywords) or "utf-8" in texts
        binary = any("b" in text for text in texts)
        opens = name in ("read_text", "write_text", "fdopen") or (
            name == "open" and (texts or isinstance(node.func, ast.Name))
        )
        if opens and not named and not binary:
            yield node.lineno


def test_files_are_utf8_whatever_the_locale():
    for path in pathlib.Path(rtd3jax.__file__).parent.rglob("*.py"):
        assert list(_unnamed_encodings(path.read_text("utf-8"))) == [], path
    assert list(_unnamed_encodings('p.read_text()\nopen("f")\np.open("a")\np.open("rb")')) == [
        1,
        2,
        3,
    ]


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_the_terminal_gets_what_it_can_show(encoding, monkeypatch):
    shown = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(shown, encoding=encoding))
    sweep_options.parser("")  # as every command does first
    print("3 × 2, ≥ λ")
    sys.stdout.flush()
    assert shown.getvalue() == "3 × 2, ≥ λ\n".encode(encoding, "replace")
    monkeypatch.setattr(sys, "stdout", io.StringIO())  # a notebook's
    replace_unprintable()
