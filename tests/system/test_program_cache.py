"""Tests that programs are removed before the limit of mappings, without other effects."""

import jax
import numpy as np
import pytest
from gymnax.environments import environment

import rtd3jax as rtd
from rtd3jax.system import program_cache as programs
from rtd3jax.training import executables, lanes
from rtd3jax.training.devices import workers
from rtd3jax.training.lane import make_lane
from rtd3jax.training.loop import make_program

SETTINGS = {"hidden_size": 4, "batch_size": 4, "learning_starts": 10, "total_steps": 60}
SETTINGS |= {"eval_every": 30, "eval_episodes": 1}


@pytest.fixture
def always_full(monkeypatch):
    """Every look finds the process full, and every call looks."""
    monkeypatch.setattr(programs, "_SHARE", -1.0)
    monkeypatch.setattr(programs, "_SECONDS", 0.0)
    monkeypatch.setattr(programs, "_mappings", lambda: (1, 1.0))


def train():
    env = rtd.make("rover", "ar1-slip")
    config = rtd.Config("td3", **SETTINGS)
    return rtd.train(env, config, seeds=range(2), progress=False)


def test_letting_programs_go_all_the_time_changes_no_number(monkeypatch, always_full):
    compiled, let_go = lanes.compiled, []

    def after_letting_go(*arguments):
        let_go.append(programs.make_room())
        return compiled(*arguments)

    monkeypatch.setattr(lanes, "compiled", after_letting_go)
    often = train()
    assert len(let_go) > 2 and all(let_go)
    monkeypatch.undo()
    once = train()
    np.testing.assert_array_equal(often.returns, once.returns)
    policies = [jax.tree.leaves(run.policy(seed=1)) for run in (often, once)]
    for a, b in zip(*policies, strict=True):
        np.testing.assert_array_equal(a, b)


def test_full_means_that_the_mappings_near_the_limit(monkeypatch):
    monkeypatch.setattr(programs, "_SECONDS", 0.0)
    let_go = []
    monkeypatch.setattr(programs, "_caches", [lambda: let_go.append(True)])
    monkeypatch.setattr(programs, "_mappings", lambda: (59, 100.0))
    assert not programs.make_room() and not let_go
    monkeypatch.setattr(programs, "_mappings", lambda: (61, 100.0))
    assert programs.make_room() and let_go == [True]


def test_programs_and_their_mappings_go(monkeypatch):
    monkeypatch.setattr(programs, "_SECONDS", 0.0)
    train()
    before, _ = programs._mappings()
    assert before > 300 and executables._programs
    monkeypatch.setattr(programs, "_SHARE", 0.0)
    assert programs.make_room() and not executables._programs
    after, limit = programs._mappings()
    assert after < before - 300 and limit > after


def test_where_no_limit_can_be_read_nothing_is_let_go(monkeypatch, tmp_path):
    monkeypatch.setattr(programs, "_SECONDS", 0.0)
    monkeypatch.setattr(programs, "_LIMIT", tmp_path / "missing")
    assert programs._mappings() == (0, float("inf")) and not programs.make_room()


def test_looks_are_seldom(monkeypatch):
    monkeypatch.setattr(programs, "_mappings", lambda: pytest.fail("looked"))
    monkeypatch.setattr(programs, "_counted_at", programs.time.monotonic())
    assert not programs.make_room()


def test_equal_environments_share_a_program_and_copies_are_warned_of(monkeypatch, recwarn):
    class Tank(environment.Environment):
        def __init__(self, pipes=1):
            self.pipes = pipes

    class Equal(rtd.ValueIdentity, Tank):
        def identity(self):
            return (self.pipes,)

    monkeypatch.setattr(executables, "_programs", {})
    monkeypatch.setattr(executables, "_compile", lambda *_: ())
    lane = make_lane(rtd.Config("td3", **SETTINGS), 0, ())
    device = workers()[0]

    def compiled(env, **changes):
        config = rtd.Config("td3", **SETTINGS | changes)
        lanes.compiled(make_program(env, config, 1, (1,)), lane, False, device)
        return len(executables._programs)

    assert [compiled(Equal()) for _ in range(4)] == [1] * 4
    assert compiled(Equal(2)) == 2
    assert [compiled(Tank(), hidden_size=width) for width in (4, 5, 6)] == [3, 4, 5]
    assert not [w for w in recwarn if w.category is UserWarning]
    for _ in range(4):
        compiled(Tank())
    (warning,) = [w for w in recwarn if w.category is UserWarning]
    assert "3 programs of Tank differ only in the environment object" in str(warning.message)
