"""Tests of the results during training, which never make the training wait."""

import threading

import pytest
from made_run import make_run

from rtd3jax.study import interim
from rtd3jax.study.cells import Grid
from rtd3jax.study.derive import derive
from rtd3jax.study.interim import InterimResults
from rtd3jax.study.lock import deriver


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path / "run", Grid("rover", ("ar1-slip",), ("td3",), (1,)))


def test_the_training_does_not_wait_while_another_shard_writes_the_tables(run, monkeypatch, capsys):
    monkeypatch.setattr(interim, "SECONDS", -1.0)
    table, pages = run.path / "curves.parquet", []
    monkeypatch.setattr(interim, "refresh_page", lambda *_, **__: pages.append(table.exists()))
    results = InterimResults(run, [], page=True)
    table.unlink()
    with deriver(run.path):
        thread = threading.Thread(target=results.refresh, daemon=True)
        thread.start()
        thread.join(20.0)
        assert not thread.is_alive()
        assert not table.exists() and not pages
    results.refresh()
    assert table.exists() and pages == [True]
    assert capsys.readouterr().err == ""


def test_tables_that_do_not_wait_are_left_to_the_other_shard(run):
    with deriver(run.path), pytest.raises(BlockingIOError):
        derive(run, [], wait=False)
