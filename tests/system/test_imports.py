"""Tests the import of a user's modules."""

import os
import sys

import pytest

from rtd3jax.errors import UserError
from rtd3jax.system.imports import import_modules


@pytest.mark.parametrize(
    ("code", "change"),
    [
        ("sys.path.insert(0, '/own/modules')", lambda path: ["/own/modules", *path]),
        ("sys.path.remove(os.getcwd())", lambda path: path),
        ("", lambda path: path),
    ],
)
def test_the_working_directory_leaves_the_path_and_nothing_else_does(
    code, change, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = list(sys.path)
    (tmp_path / "own_path.py").write_text(f"import os, sys\n{code}\n")
    try:
        import_modules(["own_path"])
    finally:
        sys.modules.pop("own_path", None)
    assert sys.path == change(before) and os.getcwd() not in sys.path
    with pytest.raises(UserError, match="--import no_such_module: No module named"):
        import_modules(["no_such_module"])
    assert sys.path == change(before)
