"""Tests that ``python -m rtd3jax`` lists everything, in any terminal."""

import io
import pathlib

import pytest

import rtd3jax
from rtd3jax.__main__ import commands, main
from rtd3jax.envs.registered import FAULTS
from rtd3jax.registries import AGENTS, MEMORIES
from rtd3jax.study.presets import PRESETS


def test_every_name_is_said_in_short_ascii_lines(capsys):
    assert main([]) == 0
    text = capsys.readouterr().out
    said = set(text.replace(",", " ").replace(":", " ").split())
    ours = {name for names in rtd3jax.DISTURBANCES.values() for name in names}
    missing = {*ours, *FAULTS, *rtd3jax.ENVIRONMENTS, *AGENTS, *MEMORIES, *PRESETS} - said
    assert not missing
    assert text.isascii() and max(map(len, text.splitlines())) <= 79
    assert text.startswith(f"rtd3jax {rtd3jax.__version__}, jax ")


def test_every_command_is_said_with_its_purpose():
    folder = pathlib.Path(rtd3jax.__file__).parent
    holds_a_main = {
        p.stem for p in folder.glob("cli/*.py") if "\ndef main(" in p.read_text("utf-8")
    }
    assert set(commands()) == holds_a_main and len(holds_a_main) == 6
    assert all((folder / f"{name}.py").is_file() for name in commands())
    assert all(10 < len(purpose) < 70 for purpose in commands().values())


def test_a_terminal_that_lacks_a_letter_shows_a_question_mark(monkeypatch):
    stream = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr("sys.stdout", stream)
    monkeypatch.setattr("rtd3jax.__main__.commands", lambda: {"play": "a λ-return"})
    main([])
    stream.flush()
    assert b"a ?-return" in stream.buffer.getvalue()


def test_what_is_not_known_is_refused(capsys):
    with pytest.raises(SystemExit) as end:
        main(["sweep"])
    assert end.value.code == 2 and "sweep" in capsys.readouterr().err
