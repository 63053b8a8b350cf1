"""Tests of the trainer: determinism, independence of lanes, common history lengths."""

import dataclasses
import threading
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments.classic_control.pendulum import Pendulum

import rtd3jax as rtd
from rtd3jax.training import devices, lanes
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.pool import Pool
from rtd3jax.training.result import failure_of

TINY = rtd.Config(
    algorithm="lstm-td3-1ha1hc",
    history_length=2,
    total_steps=260,
    hidden_size=8,
    batch_size=8,
    learning_starts=20,
    eval_every=100,
    eval_episodes=2,
)


def _rover():
    return rtd.make("rover", disturbance="ar1-slip")


def _train(algorithm=TINY.algorithm, seeds=(3,), env=None, **changes):
    length = None if algorithm == "td3" else changes.pop("history_length", 2)
    config = dataclasses.replace(TINY, algorithm=algorithm, history_length=length, **changes)
    return rtd.train(env or _rover(), config, seeds, progress=False)


def _same(a, b):
    return all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True)
    )


@pytest.mark.parametrize(
    "algorithm",
    [
        *("td3", "lstm-td3-1ha1hc", "h-td3"),
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("lstm-td3", "lstm-td3-no-action", "lstm-td3-1ha2hc")
        ),
    ],
)
def test_every_agent_trains_and_its_policy_plays(algorithm):
    env = _rover()
    run = _train(algorithm, env=env)
    assert run.returns.shape == (1, 3) and np.all(np.isfinite(run.returns))
    assert run.eval_steps.tolist() == [100, 200, 260]
    assert not run.failures
    returns = rtd.evaluate(run.policy(3), env, episodes=2, seed=7)
    assert returns.shape == (2,) and returns.dtype == np.float32


def test_the_same_call_twice_gives_the_same_bits():
    first, second = _train("h-td3"), _train("h-td3")
    np.testing.assert_array_equal(first.returns, second.returns)
    assert _same(first.policy(3).actor, second.policy(3).actor)


def test_a_seed_does_not_depend_on_its_company():
    alone, among = _train(seeds=[3]), _train(seeds=range(5))
    np.testing.assert_array_equal(alone.returns[0], among.returns[3])
    assert _same(alone.policy(3).actor, among.policy(3).actor)
    assert not _same(among.policy(2).actor, among.policy(3).actor)
    assert len(np.unique(among.returns[:, 0])) == 5


def test_a_lost_lane_is_reported_and_does_not_touch_the_others():
    from rtd3jax.training.lanes import advance_groups

    # A broken configuration and a sound one share a program, and stand side by side.
    broken = dataclasses.replace(TINY, algorithm="td3", critic_learning_rate=1e30)
    sound = dataclasses.replace(TINY, algorithm="td3")
    jobs = [*make_jobs(_rover(), broken, [0]), *make_jobs(_rover(), sound, [3])]
    for strategy in ("map", "vmap"):
        groups = make_groups(jobs, strategy, 1)
        advance_groups(groups, lambda group: None)
        (_, one), (_, other) = (pair for group in groups for pair in group.lanes())
        assert int(one.failure) != 0 and int(other.failure) == 0
        if strategy == "map":
            assert _same(other.learner.actor, _train("td3", seeds=[3]).policy(3).actor)
        assert np.all(np.isfinite(other.returns))

    lost = _train("td3", critic_learning_rate=1e30, seeds=[0])
    assert np.isnan(lost.returns[0, -1])
    assert "loss is not finite" in lost.failures[0].reason
    with pytest.raises(rtd.UserError, match="seed 0 was lost"):
        lost.policy(0)


@pytest.mark.parametrize("env_id", ["MountainCarContinuous-v0", "PointRobot-misc"])
def test_gymnax_environments_train_without_glue(env_id):
    import gymnax

    env, _ = gymnax.make(env_id)
    run = _train("td3", env=env, total_steps=60, eval_every=60, eval_episodes=1)
    assert np.all(np.isfinite(run.returns))


@pytest.mark.parametrize("seeds", [[], [1, 1], [-1], [0.5], 3, None])
def test_bad_seeds_are_refused(seeds):
    with pytest.raises(rtd.UserError, match="seeds must be"):
        rtd.train(_rover(), TINY, seeds, progress=False)


@pytest.mark.parametrize("config", [None, rtd.Config, 3, []])
def test_what_is_no_configuration_is_refused(config):
    with pytest.raises(rtd.UserError, match=r"config must be an rtd\.Config"):
        rtd.train(_rover(), config, progress=False)


@pytest.mark.parametrize(
    "options, line",
    [
        ({"checkpoint_dir": 3}, "checkpoint_dir must be a path, not 3"),
        ({"checkpoint_seconds": "60"}, "checkpoint_seconds must be a number of at least 0"),
        ({"checkpoint_seconds": float("nan")}, "at least 0, not nan"),
        ({"checkpoint_seconds": -1}, "at least 0, not -1"),
        ({"checkpoint_seconds": True}, "at least 0, not True"),
    ],
)
def test_bad_options_of_checkpoints_are_refused(options, line):
    with pytest.raises(rtd.UserError, match=line):
        rtd.train(_rover(), TINY, progress=False, **options)


def test_lengths_side_by_side_equal_exact_windows():
    """Vmapped lanes of different history length; each equals a program of its own.

    They learn, and an episode ends after 200 steps.
    """
    from rtd3jax.study.cells import Cell, cell_jobs
    from rtd3jax.training.lanes import advance_groups
    from rtd3jax.training.result import collect

    configs = [
        dataclasses.replace(TINY, algorithm="h-td3", history_length=length, total_steps=240)
        for length in (1, 3)
    ]
    cells = [Cell("rover", "ar1-slip", config) for config in configs]
    groups = make_groups(cell_jobs(cells, [0], "vmap"), "vmap", 1)
    assert len(groups) == 1
    advance_groups(groups, lambda group: None)
    for (job, state), config in zip(groups[0].lanes(), configs, strict=True):
        policy = collect(config, [0], {0: (job, state)}).policy(0)
        assert policy.window_tokens == config.history_length
        exact = make_groups(cell_jobs([Cell("rover", "ar1-slip", config)], [0], "map"), "map", 1)
        advance_groups(exact, lambda group: None)
        run = collect(config, [0], {0: next(iter(exact[0].lanes()))})
        np.testing.assert_allclose(state.returns, run.returns[0], rtol=1e-4)
        for a, b in zip(
            jax.tree.leaves(state.learner.actor), jax.tree.leaves(run.policy(0).actor), strict=True
        ):
            np.testing.assert_allclose(a, b, atol=1e-4)


def test_several_configurations_are_trained_as_each_alone(tmp_path):
    env = rtd.make("rover", "ar1-slip")
    tiny = dict(total_steps=60, hidden_size=4, batch_size=4, learning_starts=10, eval_every=30)
    configs = [
        rtd.Config(algorithm="td3", critic_learning_rate=rate, eval_episodes=1, **tiny)
        for rate in (1e-3, 3e-2)
    ]
    alone = [rtd.train(env, config, seeds=[0, 1], progress=False) for config in configs]
    together = rtd.train(env, configs, seeds=[0, 1], progress=False, checkpoint_dir=tmp_path)
    assert [run.config for run in together] == configs
    for one, other in zip(alone, together, strict=True):
        np.testing.assert_array_equal(one.returns, other.returns)
    assert not np.array_equal(together[0].returns, together[1].returns)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config-0", "config-1"]
    again = rtd.train(env, configs, seeds=[0, 1], progress=False, checkpoint_dir=tmp_path)
    np.testing.assert_array_equal(again[1].returns, together[1].returns)
    with pytest.raises(rtd.UserError, match="rtd.Config, or several"):
        rtd.train(env, [], progress=False)


def test_jax_debug_nans_does_not_end_a_training():
    """Curves are NaN where they are not reached yet; those are ours."""
    config = rtd.Config(
        "td3", total_steps=40, hidden_size=4, batch_size=4, learning_starts=10, eval_every=20
    )
    jax.config.update("jax_debug_nans", True)
    try:
        run = rtd.train(rtd.make("rover"), config, seeds=[0, 1], progress=False, strategy="vmap")
    finally:
        jax.config.update("jax_debug_nans", False)
    assert not run.failures


def test_a_long_training_without_checkpoints_says_so_once(capsys, monkeypatch, tmp_path):
    from rtd3jax.training import progress, train

    group = types.SimpleNamespace(
        jobs=[None], step=10, total=30, began_at=0, returns=np.zeros((1, 1))
    )
    for seconds, times in ((0.0, 1), (60.0, 0)):
        monkeypatch.setattr(progress, "LONG_SECONDS", seconds)
        with progress.Progress([group], str, remark=train._NO_CHECKPOINTS) as bar:
            bar.update(group)
            bar.update(group)
        assert capsys.readouterr().err.count("no checkpoints are written") == times

    remarks = []

    def begun(*_, remark, **__):
        remarks.append(remark)
        raise KeyboardInterrupt

    monkeypatch.setattr(train, "Progress", begun)
    for directory in (None, tmp_path):
        with pytest.raises(KeyboardInterrupt):
            rtd.train(_rover(), TINY, [0], checkpoint_dir=directory)
    assert remarks == [train._NO_CHECKPOINTS, ""]


def test_side_by_side_only_lanes_of_the_same_step_advance_together():
    jobs = make_jobs(_rover(), TINY, [0, 1, 2], cell="cell")
    steps = {0: {20, 40}, 1: {40}, 2: set()}
    kept = types.SimpleNamespace(steps=lambda job: steps[job.seed])
    groups = make_groups(jobs, "vmap", 1, checkpoints=kept)
    assert [[job.seed for job in group.jobs] for group in groups] == [[0, 1], [2]]


@pytest.mark.parametrize(
    ("kept", "groups"),
    [
        ({}, [[0, 2, 4], [1, 3]]),
        ({0: 40, 1: 40, 2: 40, 3: 40, 4: 40}, [[0, 2, 4], [1, 3]]),
        # Those of two devices, which were interrupted at different steps, stay together.
        ({0: 40, 2: 40, 4: 40, 1: 60, 3: 60}, [[0, 2, 4], [1, 3]]),
        # What is new does not wait for a lane that began before.
        ({3: 40}, [[3], [0, 2], [1, 4]]),
    ],
)
def test_each_device_has_one_group_also_after_an_interrupt(kept, groups):
    jobs = make_jobs(_rover(), TINY, range(5), cell="cell")
    checkpoints = types.SimpleNamespace(
        steps=lambda job: {kept[job.seed]} if job.seed in kept else set()
    )
    found = make_groups(jobs, "vmap", 2, checkpoints=checkpoints)
    assert [[job.seed for job in group.jobs] for group in found] == groups
    assert [group.wave for group in found] == [0, 0, 1][: len(groups)]


def test_a_group_stays_on_its_device_unless_that_is_busy():
    jobs = make_jobs(_rover(), TINY, range(3), cell="cell")
    first, second, third = groups = [Group([job]) for job in jobs]
    pool = Pool(groups)
    assert pool.take("a") is first and pool.take("b") is second
    first.step, second.step, third.step = 60, 40, 50
    pool.give_back(second)
    pool.give_back(first)
    # Both devices return their groups before either takes again.
    assert pool.take("a") is third and pool.take("b") is second
    assert third.device == "a" and second.device == "b"
    # The device of the first group is busy with the third, so another may take the first.
    pool.give_back(second)
    second.step = 100
    assert pool.take("b") is second
    assert pool.take("c") is first and first.device == "c"


def test_a_group_that_a_worker_holds_does_not_keep_others_from_being_saved(monkeypatch):
    """An interrupt that ends the wait for a worker leaves a group whose state is in use."""
    groups = [Group([job], state="state") for job in make_jobs(_rover(), TINY, range(2))]
    held, other = groups
    taken, saved, found = threading.Event(), threading.Event(), []

    class Impatient(threading.Thread):
        def join(self, timeout=None):
            raise KeyboardInterrupt

    def train(pool, device, checkpoints):
        group = pool.take(device)
        group.step = 1
        if group is held:
            taken.set()
            saved.wait(20.0)
        pool.give_back(group)

    def interrupt(group):
        assert taken.wait(20.0)
        raise KeyboardInterrupt

    def save_all(ready):
        found.extend(ready)
        saved.set()

    impatient = types.SimpleNamespace(**{**vars(threading), "Thread": Impatient})
    monkeypatch.setattr(lanes, "threading", impatient)
    monkeypatch.setattr(lanes, "_train", train)
    with pytest.raises(KeyboardInterrupt):
        checkpoints = types.SimpleNamespace(save_all=save_all)
        lanes.advance_groups(groups, interrupt, checkpoints, devices=["a", "b"])
    assert found == [other]


def test_steps_of_a_checkpoint_do_not_count_for_the_speed(monkeypatch):
    from rtd3jax.training import progress

    now = [0.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    group = types.SimpleNamespace(
        jobs=[None, None], step=0, total=30_000, began_at=0, returns=np.zeros((2, 1))
    )
    bar = progress.Progress([group], str)
    now[0], group.began_at, group.step = 10.0, 29_000, 29_100
    bar.update(group)
    (task,) = bar._bar.tasks
    assert task.fields["rate"] == "20 steps/s" and task.completed == 58_200
    assert sum(sample.completed for sample in task._progress) == 200


def test_an_observation_of_reset_that_is_not_finite_is_the_environments_fault():
    class NotFiniteAtReset(Pendulum):
        def reset_env(self, key, params):
            observation, state = super().reset_env(key, params)
            return observation / 0.0, state

    config = dataclasses.replace(TINY, algorithm="td3", history_length=None)
    run = rtd.train(NotFiniteAtReset(), config, [0], progress=False)
    (failure,) = run.failures
    assert failure.step == 0 and "the environment returned an observation" in failure.reason


def test_an_actor_that_diverged_is_not_the_environments_fault():
    (job,) = make_jobs(_rover(), dataclasses.replace(TINY, algorithm="td3"), [0])
    state = jax.jit(job.program.init)(job.lane)
    actor = jax.tree.map(lambda leaf: leaf + jnp.nan, state.learner.actor)
    state = dataclasses.replace(state, learner=dataclasses.replace(state.learner, actor=actor))
    state = jax.jit(job.program.advance)(job.lane, state, jnp.int32(0), jnp.int32(40))
    failure = failure_of(0, state)
    assert failure.step == 20 and "the actor's action is not finite" in failure.reason


def test_the_default_device_may_be_named_by_its_platform():
    with jax.default_device("cpu"):
        assert devices.default_strategy() == "map"
        assert {device.platform for device in devices.workers()} == {"cpu"}
