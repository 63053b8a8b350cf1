"""Tests training from a policy or a checkpoint, with frozen and delayed parts."""

import dataclasses
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_policies import random_policy

import rtd3jax as rtd
from rtd3jax import sweep
from rtd3jax.agents.freeze import frozen_parts
from rtd3jax.study import finish
from rtd3jax.study.execute import checkpoints_of
from rtd3jax.study.rundir import RunDirectory
from rtd3jax.study.starts import _place, add_starts, starts_of
from rtd3jax.system.files import read_arrays, write_arrays
from rtd3jax.training import lanes
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.start import KNOWN_OBSERVATIONS, Start
from rtd3jax.training.starts import starts_of_path

SMALL = dict(
    algorithm="td3",
    total_steps=60,
    hidden_size=8,
    batch_size=4,
    learning_starts=20,
    eval_every=30,
    eval_episodes=1,
    normalise_observations=True,
)


@dataclasses.dataclass
class Pair:
    """A learner's networks."""

    actor: dict
    critics: tuple


def _config(**changes):
    return rtd.Config(**{**SMALL, **changes})


@pytest.fixture(scope="module")
def env():
    return rtd.make("rover", "sine-slip")


@pytest.fixture(scope="module")
def kept(env, tmp_path_factory):
    """A run of two seeds, and the directory of its checkpoints."""
    directory = tmp_path_factory.mktemp("kept")
    run = rtd.train(env, _config(), [0, 1], progress=False, checkpoint_dir=directory)
    return run, directory


def _same(one, other):
    return all(
        np.array_equal(a, b)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True)
    )


def test_a_lane_acts_by_the_policy_while_parts_stay_and_the_actor_waits(env, kept, tmp_path):
    run, _ = kept
    policy = run.policy(0)
    policy.save(tmp_path / "p.safetensors")
    start = starts_of_path(tmp_path / "p.safetensors", (0,))[0]
    fields = dict(exploration_noise=0.0, actor_starts=40, freeze="actor.head, critics.current")
    (job,) = make_jobs(env, _config(start="p", **fields), [0], starts={0: start})
    state = start.begin(job.program, job.lane, jax.jit(job.program.init)(job.lane))
    assert _same(state.learner.actor, policy.actor)
    assert _same(state.learner.target_actor, policy.actor)
    assert int(state.statistics.count) == KNOWN_OBSERVATIONS
    np.testing.assert_allclose(state.statistics.normaliser().scale, policy.normaliser.scale, 1e-6)
    advance = jax.jit(job.program.advance)
    acted = advance(job.lane, state, jnp.int32(0), jnp.int32(10))
    rows = acted.replay.transitions.step
    # Its statistics stay while it waits, so that it acts as the policy does.
    memory = policy.init()
    for observation, action in zip(rows.observation[:10], rows.action[:10], strict=True):
        expected, memory = policy.step(memory, observation)
        np.testing.assert_allclose(action, expected, atol=1e-5)
    waiting = advance(job.lane, acted, jnp.int32(10), jnp.int32(40))
    assert _same(waiting.learner.actor, policy.actor)
    assert _same(waiting.learner.target_actor, policy.actor)
    assert not _same(waiting.learner.target_critics, state.learner.target_critics)
    assert _same(waiting.statistics, state.statistics)
    later = advance(job.lane, waiting, jnp.int32(40), jnp.int32(44))
    assert int(later.statistics.count) == KNOWN_OBSERVATIONS + 4
    actor = {
        layer: _same(policy.actor[layer], later.learner.actor[layer]) for layer in policy.actor
    }
    assert actor == {"current": False, "head": True, "output": False}
    before, after = state.learner, later.learner
    for old, new in (
        (before.critics[1], after.critics[1]),
        (before.target_critics[1], after.target_critics[1]),
    ):
        critic = {layer: _same(old[layer], new[layer]) for layer in old}
        assert critic == {"current": True, "head": False, "output": False}
    targets = before.target_actor, after.target_actor
    assert {layer: _same(targets[0][layer], targets[1][layer]) for layer in actor} == actor


def test_a_frozen_actor_reads_observations_as_it_was_trained_to(env, kept):
    run, _ = kept
    start = Start("p", run.policy(0))
    (job,) = make_jobs(env, _config(start="p", freeze="actor"), [0], starts={0: start})
    state = start.begin(job.program, job.lane, jax.jit(job.program.init)(job.lane))
    later = jax.jit(job.program.advance)(job.lane, state, jnp.int32(0), jnp.int32(30))
    assert _same(later.statistics, state.statistics)
    assert not _same(later.learner.critics, state.learner.critics)


@pytest.mark.parametrize("algorithm", ["lstm-td3", "lstm-td3-1ha1hc", "h-td3"])
def test_a_lane_acts_as_its_policy_does_also_after_an_episode(algorithm):
    env = rtd.make("rover", "sine-slip", max_steps_in_episode=5)
    policy = random_policy(algorithm, env)
    config = _config(
        algorithm=algorithm,
        history_length=3,
        start="p",
        exploration_noise=0.0,
        normalise_observations=False,
    )
    start = Start("p", policy)
    (job,) = make_jobs(env, config, [0], starts={0: start})
    state = start.begin(job.program, job.lane, jax.jit(job.program.init)(job.lane))
    steps = 17  # no update comes before step 20
    state = jax.jit(job.program.advance)(job.lane, state, jnp.int32(0), jnp.int32(steps))
    rows, memory = state.replay.transitions, policy.init()
    for index in range(steps):
        if rows.episode_step[index] == 0:
            memory = policy.init()
        action, memory = policy.step(memory, rows.step.observation[index])
        np.testing.assert_allclose(rows.step.action[index], action, atol=1e-5)
    assert np.sum(rows.episode_step[:steps] == 0) == 4 and np.ptp(rows.step.action[:steps]) > 0.1


def test_a_whole_network_may_be_frozen():
    before = Pair({"head": 1.0}, ({"head": 1.0}, {"head": 2.0}))
    after = Pair({"head": 3.0}, ({"head": 4.0}, {"head": 5.0}))
    assert frozen_parts(before, after, ["critics"]) == Pair(after.actor, before.critics)
    assert frozen_parts(before, after, []) == after


def test_a_checkpoint_gives_the_whole_learner(env, kept):
    _, directory = kept
    start = starts_of_path(directory, (1,))[1]
    (job,) = make_jobs(env, _config(start="there"), [1], starts={1: start})
    began = start.begin(job.program, job.lane, jax.eval_shape(job.program.init, job.lane))
    whole = _checkpoint_state(directory, job)
    assert _same(began.learner, whole.learner) and _same(began.statistics, whole.statistics)
    assert int(began.learner.critic_optimizer.count) == 40
    assert start.about == f"actor, critics and optimisers of {directory} seed 1"


def _checkpoint_state(directory, job):
    from rtd3jax.system.files import read_arrays
    from rtd3jax.training.checkpoint_arrays import from_arrays
    from rtd3jax.training.checkpoint_files import checkpoint_files

    (file, *_) = checkpoint_files(directory / "seed-1")
    return from_arrays(read_arrays(file)[0], job.program, job.lane, file)


def test_each_seed_goes_on_from_its_own_and_with_others_the_same(env, kept):
    run, directory = kept
    other = rtd.make("rover", "sine-slip", offset=0.2)
    both = rtd.train(other, _config(), [0, 1], progress=False, start=directory)
    (alone,) = rtd.train(other, [_config()], [1], progress=False, start=directory)
    assert _same(both.policy(1), alone.policy(1)) and not _same(both.policy(0), both.policy(1))
    side = rtd.train(other, _config(), [0, 1], progress=False, start=directory, strategy="vmap")
    np.testing.assert_allclose(side.returns, both.returns, rtol=1e-3)
    fresh = rtd.train(other, _config(), [1], progress=False)
    assert not _same(fresh.policy(1), alone.policy(1))
    # A Run has the policies alone; its name is part of what checkpoints are of.
    begun = rtd.train(other, _config(), [0, 1], progress=False, start=run)
    assert begun.config.start.startswith("a policy of td3")
    with pytest.raises(rtd.UserError, match="pass this policy again as start="):
        rtd.train(other, begun.config, [0, 1], progress=False)
    again = rtd.train(other, both.config, [0, 1], progress=False)
    assert both.config.start == str(directory) and _same(again.policy(1), both.policy(1))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (dict(algorithm="lstm-td3"), "has algorithm=td3, and the new"),
        (dict(hidden_size=16), "has hidden_size=8, and the new training 16"),
        (dict(normalise_observations=False), "has normalise_observations=True"),
        (dict(freeze="actor.heart"), "actor has no layer 'heart'.*head.*its layers are"),
        (dict(freeze="body"), "'body' is not actor, critics"),
        (dict(freeze="actor.,critics."), "'actor.' is not actor, critics"),
        (dict(start=3), "start must be a string"),
    ],
)
@pytest.mark.parametrize("of", ["policy", "checkpoints"])
def test_what_does_not_fit_is_refused_before_compilation(
    env, kept, monkeypatch, of, changes, message
):
    run, directory = kept
    monkeypatch.setattr(lanes, "_chunk", lambda *_: pytest.fail("compiled"))
    start = run.policy(0) if of == "policy" else directory
    with pytest.raises(rtd.UserError, match=message):
        rtd.train(env, _config(**changes), [0], progress=False, start=start)


def test_a_checkpoint_is_read_once_and_let_go(env, kept, monkeypatch):
    from rtd3jax.training import start as module

    _, directory = kept
    read = []
    monkeypatch.setattr(module, "read_arrays", lambda f: read.append(f) or read_arrays(f))
    start = starts_of_path(directory, (1,))[1]
    (job,) = make_jobs(env, _config(start="there"), [1], starts={1: start})
    start.check(job.program, job.lane)
    (held, _), (arrays, _) = start._read, read_arrays(start.checkpoint)
    assert ".learner.critic_optimizer.count" in held and set(held) < set(arrays)
    assert not any("replay" in name for name in held)  # it may be large
    start.begin(job.program, job.lane, jax.eval_shape(job.program.init, job.lane))
    assert read == [start.checkpoint] and "_read" not in vars(start)


def test_a_lost_lane_is_no_start(env, kept, tmp_path):
    _, directory = kept
    shutil.copytree(directory, tmp_path / "lost")
    (file,) = (tmp_path / "lost" / "seed-0").glob("step-*60.safetensors")
    arrays, about = read_arrays(file)
    write_arrays(file, {**arrays, ".failure": np.int32(2), ".failed_at": np.int32(31)}, about)
    with pytest.raises(rtd.UserError, match="was lost in training, at step 31"):
        rtd.train(env, _config(), [0], progress=False, start=tmp_path / "lost")


def test_an_actor_that_waits_to_the_end_is_named(env):
    with pytest.warns(UserWarning, match="actor_starts .50. allows no update of the actor"):
        make_jobs(env, _config(actor_starts=50, total_steps=50), [0])


def test_what_is_no_start_is_refused(env, kept, tmp_path):
    _, directory = kept
    for start, message in (
        (3, "start must be a policy"),
        (tmp_path / "nothing", "cannot be read"),
        (tmp_path, "no saved policy, and has no checkpoint of seed 0"),
    ):
        with pytest.raises(rtd.UserError, match=message):
            rtd.train(env, _config(), [0], progress=False, start=start)
    with pytest.raises(rtd.UserError, match="no checkpoint of seed 7"):
        rtd.train(env, _config(), [7], progress=False, start=directory)
    pendulum = rtd.make("pendulum")
    policy = random_policy("td3", env)
    config = _config(normalise_observations=False)
    with pytest.raises(rtd.UserError, match="2 observation and 2 action elements.*has 3 and 1"):
        rtd.train(pendulum, config, [0], progress=False, start=policy)


@pytest.mark.parametrize("of", ["policy", "checkpoints"])
def test_a_lane_with_checkpoints_does_not_need_its_start_any_more(env, kept, tmp_path, of):
    run, directory = kept
    start = tmp_path / "start"
    if of == "policy":
        run.policy(0).save(start)
    else:
        shutil.copytree(directory, start)

    def train(seeds, start=start, **changes):
        place = tmp_path / "out"
        return rtd.train(
            env, _config(**changes), seeds, progress=False, start=start, checkpoint_dir=place
        )

    begun = train([0])
    start.rename(tmp_path / "elsewhere")
    again = train([0])
    assert again.config == begun.config and _same(again.policy(0), begun.policy(0))
    longer = train([0], total_steps=70)
    np.testing.assert_array_equal(longer.returns[:, :2], begun.returns)
    # A new lane needs it, and no lane may have begun from something else.
    with pytest.raises(rtd.UserError, match="start cannot be read"):
        train([0, 1])
    with pytest.raises(rtd.UserError, match="nothing cannot be read"):
        train([0], start=tmp_path / "nothing")


def test_the_parts_of_a_policy_are_on_no_fixed_device(env, kept):
    """So that policies of several accelerators can start lanes of one group."""
    run, _ = kept
    policy = jax.device_put(run.policy(0), jax.devices()[0])
    assert all(leaf.committed for leaf in jax.tree.leaves(policy.actor))
    start = Start("p", policy)
    (job,) = make_jobs(env, _config(start="p"), [0], starts={0: start})
    begun = start.begin(job.program, job.lane, jax.eval_shape(job.program.init, job.lane))
    taken = begun.learner.actor, begun.learner.target_actor, begun.statistics
    assert not any(leaf.committed for leaf in jax.tree.leaves(taken))


def test_side_by_side_lanes_whose_checkpoints_are_of_no_use_begin_from_the_start_again(
    env, kept, tmp_path
):
    run, _ = kept
    file = tmp_path / "p.safetensors"
    run.policy(0).save(file)
    cell = rtd.Cell("rover", "sine-slip", _config(start=str(file)))
    directory = RunDirectory.create(tmp_path / "run", [cell], [0, 1], 2)
    checkpoints = checkpoints_of(directory, (None, None))
    jobs = directory.jobs("vmap")
    program = jobs[0].program
    states = jax.jit(jax.vmap(program.init))(lanes.stacked([job.lane for job in jobs], None))
    for job, group_step in zip(jobs, (20, 40), strict=True):
        (state,) = (s for j, s in Group(jobs, state=states).lanes() if j is job)
        checkpoints.save_lane(job, state, group_step)
        # The newest of both is of step 60, and the first lane's is cut short.
        checkpoints.save_lane(job, state, 60)
    newest = directory.lanes.checkpoint_directory(cell, 0) / "step-000000060.safetensors"
    newest.write_bytes(newest.read_bytes()[:1000])
    add_starts(directory, jobs, write=True)
    assert not directory.lanes.start_path(cell, 0).exists()  # it stands there since they began
    (group,) = make_groups(jobs, "vmap", 1, checkpoints=checkpoints)
    with pytest.warns(UserWarning, match=f"from the beginning, with the actor of {file}"):
        lanes._restore(group, checkpoints, jax.devices()[0])
    begun = lanes._with_start(group, states, jax.devices()[0])
    for index in range(2):
        actor = jax.tree.map(lambda leaf, i=index: leaf[i], begun.learner.actor)
        assert _same(actor, run.policy(0).actor)
    # One that is under way does not need its start, but cannot start over without it.
    file.unlink()
    jobs = directory.jobs("vmap")
    add_starts(directory, jobs, write=True)
    with pytest.raises(rtd.UserError, match=f"began from {file} cannot start over: .* be read"):
        lanes._with_start(Group(jobs), states, jax.devices()[0])


FLAGS = [
    *("--env", "rover", "--algorithms", "td3", "--quiet"),
    *("--no-report", "--final-episodes", "2", "--normalise-observations"),
    *("--hidden-size=8", "--batch-size=4", "--learning-starts=20", "--eval-every=30"),
    *("--eval-episodes=1", "--total-steps=60"),
]


def test_a_sweep_goes_on_from_another_and_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(finish, "refresh_page", lambda *_, **__: None)
    first, second = str(tmp_path / "first"), str(tmp_path / "second")
    trained = [*FLAGS, "--disturbances", "ar1-slip-slow", "ar1-slip-fast", "--seeds", "1"]
    assert sweep.main([*trained, "--out", first, "--keep-checkpoints"]) == 0
    more = [*FLAGS, "--disturbances", "ar1-slip"]
    for start, seeds, message in (
        (first, 1, f"say which disturbance: {first}@ar1-slip-slow or {first}@ar1-slip-fast"),
        (f"{first}@ar1-slip-slow", 2, "has no seed 1 to start from"),
        (f"{first}@ar1-slip", 1, "has no td3 under ar1-slip to start from"),
    ):
        out = ["--out", second, "--start", start, "--seeds", str(seeds)]
        assert sweep.main([*more, *out]) == 2
        assert message in capsys.readouterr().err
    assert not (tmp_path / "second").exists()  # nothing was begun
    begun = [*more, "--start", f"{first}@ar1-slip-slow", "--seeds", "1"]
    assert sweep.main([*begun, "--out", second, "--freeze", "actor.current"]) == 0
    summary = (tmp_path / "second" / "summary.md").read_text()
    assert f"began from: actor, critics and optimisers of {first} rover ar1-slip-slow" in summary
    before, after = rtd.load_policy(first, disturbance="ar1-slip-slow"), rtd.load_policy(second)
    assert _same(before.actor["current"], after.actor["current"])
    assert not _same(before.actor["head"], after.actor["head"])
    # Without a checkpoint of the last step there is the actor alone. A kill between the writing of
    # a lane's file and the removal of its checkpoints leaves those of earlier steps.
    (cell,) = RunDirectory.open(second).cells
    for last in (tmp_path / "first" / "checkpoints").rglob("step-000000060.safetensors"):
        last.rename(last.with_name("step-000000040.safetensors"))
    assert starts_of(cell, [0])[0].about == f"actor of {first} rover ar1-slip-slow"
    shutil.rmtree(tmp_path / "first" / "checkpoints")
    assert starts_of(cell, [0])[0].about == f"actor of {first} rover ar1-slip-slow"
    # What is done needs its beginning no more.
    shutil.rmtree(tmp_path / "first")
    assert sweep.main([*begun, "--out", second, "--freeze", "actor.current"]) == 0


def test_a_path_may_contain_an_at_sign(tmp_path):
    plain, marked = tmp_path / "me", tmp_path / "me@host" / "run@1"
    for directory in (plain, marked):
        directory.mkdir(parents=True)
    for start, expected in (
        (marked, (marked, "")),
        (f"{marked}@ar1-slip", (marked, "ar1-slip")),
        (f"{plain}@none", (plain, "none")),
        (marked / "policy@2.safetensors", (marked / "policy@2.safetensors", "")),
    ):
        assert _place(str(start)) == expected


def test_what_fresh_moves_away_is_no_start(tmp_path, capsys):
    def command(disturbance, out, start):
        study = ["--disturbances", disturbance, "--seeds", "1", "--out", str(tmp_path / out)]
        return [*FLAGS, *study, "--fresh", "--start", str(start)]

    config = rtd.Config(**{**SMALL, "start": "elsewhere"})
    own, other = (
        RunDirectory.create(tmp_path / name, [rtd.Cell("rover", "ar1-slip", config)], [0], 2)
        for name in ("own", "other")
    )
    (tmp_path / "link").symlink_to(own.path)
    for start in (own.path, f"{own.path}@ar1-slip", own.path / "policy", tmp_path / "link"):
        assert sweep.main(command("ar1-slip", "own", start)) == 2
        error = capsys.readouterr().err
        assert f"--start {start} lies in {own.path}, which --fresh renames" in error
        assert error.count("\n") == 1
    # What is done there now is to be trained again: its start is looked at before anything moves.
    (cell,) = own.cells
    own.lanes.write_error(cell, 0, "makes the folder")
    own.lanes.lane_path(cell, 0).touch()
    assert own.lanes.is_done(cell, 0)
    assert sweep.main(command("ar1-slip", "own", f"{other.path}@none")) == 2
    assert "has no td3 under none to start from" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["link", "other", "own"]
