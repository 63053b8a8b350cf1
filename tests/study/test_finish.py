"""Tests of the results when several shards end together."""

import threading

import pytest
from made_run import make_run

from rtd3jax.study import finish as module
from rtd3jax.study.cells import Grid
from rtd3jax.study.finish import finish
from rtd3jax.study.lock import deriver


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path / "run", Grid("rover", ("ar1-slip",), ("td3",), (1,)))


def test_the_page_is_written_while_no_other_shard_writes_results(run, monkeypatch):
    pages = []

    def refresh_page(directory, *, complete):
        with pytest.raises(BlockingIOError), deriver(directory.path, wait=False):
            pass
        pages.append(complete)

    monkeypatch.setattr(module, "refresh_page", refresh_page)
    finish(run, [], page=True)
    finish(run, [], page=True, interrupted=True)
    assert pages == [True, False]
    with deriver(run.path, wait=False):
        pass


def test_the_last_shard_with_the_lock_writes_the_complete_page(run, monkeypatch):
    """Its last look at the lanes of others is not one from before it had the lock."""
    pages = []
    monkeypatch.setattr(module, "refresh_page", lambda _, complete: pages.append(complete))
    lane = run.lanes.lane_path(run.cells[0], 1)
    content = lane.read_bytes()
    lane.unlink()
    with deriver(run.path):
        thread = threading.Thread(target=finish, args=(run, []), kwargs={"page": True})
        thread.start()
        thread.join(0.3)
        assert thread.is_alive() and not pages
        lane.write_bytes(content)  # the other shard ends
    thread.join()
    assert pages == [True]
