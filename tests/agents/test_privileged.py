"""Tests of critics that read the undisturbed observation."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.agents.learners.td3 import target
from rtd3jax.agents.networks import act
from rtd3jax.training.jobs import make_jobs

AGENT = "lstm-td3-privileged"
STEPS = 260  # more than one episode of the pendulum, which has 200 steps
FIELDS = dict(
    algorithm=AGENT,
    history_length=3,
    hidden_size=4,
    batch_size=4,
    total_steps=STEPS,
    learning_starts=STEPS,
    eval_every=STEPS,
    eval_episodes=1,
)


def _advanced(env, **changes):
    (job,) = make_jobs(env, rtd.Config(**{**FIELDS, **changes}), [0])
    state = jax.jit(job.program.init)(job.lane)
    state = jax.jit(job.program.advance)(job.lane, state, jnp.int32(0), jnp.int32(STEPS))
    return job, state


@pytest.mark.parametrize("environments", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_without_a_disturbance_the_replay_holds_the_observations_twice(environments):
    _, state = _advanced(rtd.make("pendulum", "noise", sigma=0.0), environments=environments)
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:STEPS], state.replay.transitions)
    assert np.abs(rows.step.observation).max() > 0
    np.testing.assert_array_equal(rows.truth.observation, rows.step.observation)
    # Also at the end of an episode, where the next row is the first of another episode.
    np.testing.assert_array_equal(rows.truth.next_observation, rows.next_observation)


@pytest.fixture(scope="module")
def hidden():
    return _advanced(
        rtd.make("pendulum", "hidden"),
        normalise_observations=True,
        replay="segments",
        segment_length=2,
    )


def test_under_a_disturbance_the_replay_holds_what_the_sensors_hide(hidden):
    _, state = hidden
    rows = jax.tree.map(lambda leaf: np.asarray(leaf)[:STEPS], state.replay.transitions)
    seen, truth = rows.step.observation, rows.truth.observation
    assert (seen.shape, truth.shape) == ((STEPS, 2), (STEPS, 3))
    np.testing.assert_array_equal(truth[:, :2], seen)
    # The hidden element is the velocity: the angle follows from it (steps of 0.05 s).
    after = rows.truth.next_observation
    angle, angle_after = (np.arctan2(t[:, 1], t[:, 0]) for t in (truth, after))
    change = (angle_after - angle + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(change, 0.05 * after[:, 2], atol=1e-4)


def test_the_truth_is_normalised_by_statistics_of_its_own(hidden):
    """The hidden element too, which the observation does not have."""
    job, state = hidden
    truth = np.asarray(state.replay.transitions.truth.observation)[:STEPS]
    np.testing.assert_allclose(state.true_statistics.mean, truth.mean(0), rtol=1e-4, atol=1e-5)
    normalisers = state.statistics.normaliser(), state.true_statistics.normaliser()
    length = jnp.int32(job.program.window_tokens)
    key, count = jax.random.key(0), jnp.int32(STEPS)
    raw = job.program.agent.sample(state.replay, key, count, length, None)
    read = job.program.agent.sample(state.replay, key, count, length, *normalisers)
    want = (np.asarray(raw.window.true_observation) - truth.mean(0)) / truth.std(0)
    np.testing.assert_allclose(read.window.true_observation, want, rtol=1e-3, atol=1e-3)
    assert read.next_window.true_observation.shape == want.shape


@pytest.mark.parametrize("replay", ["segments", pytest.param("windows", marks=pytest.mark.slow)])
def test_the_target_depends_on_the_truth_and_the_action_does_not(replay, hidden):
    job, state = hidden if replay == "segments" else _advanced(rtd.make("pendulum", "hidden"))
    agent, hyperparameters = job.program.agent, job.lane.hyperparameters
    batch = agent.sample(state.replay, jax.random.key(1), jnp.int32(STEPS), jnp.int32(3), None)
    assert batch.window.true_observation.shape == (4, 3)

    def y(batch):
        return target(agent.networks, state.learner, batch, jax.random.key(2), hyperparameters)

    following = batch.next_window
    other = dataclasses.replace(following, true_observation=following.true_observation + 1.0)
    assert not np.allclose(y(batch), y(dataclasses.replace(batch, next_window=other)))
    policy = job.program.policy(job.lane, state)
    assert policy.observation_size == 2
    actor = agent.networks.actor, state.learner.actor
    np.testing.assert_array_equal(act(*actor, following), act(*actor, other))


def test_it_learns_under_both_strategies_and_its_policy_can_be_saved(tmp_path):
    env = rtd.make("pendulum", "random-sine")
    config = rtd.Config(**{**FIELDS, "learning_starts": 20, "total_steps": 60, "eval_every": 60})
    one, other = (
        rtd.train(env, config, [0, 1], strategy=strategy, progress=False)
        for strategy in ("map", "vmap")
    )
    np.testing.assert_allclose(one.returns, other.returns, rtol=1e-3)
    one.policy(0).save(tmp_path / "policy.safetensors")
    loaded = rtd.load_policy(tmp_path / "policy.safetensors")
    returns = [rtd.evaluate(p, env, 2, seed=0) for p in (one.policy(0), loaded)]
    np.testing.assert_array_equal(*returns)


def test_an_environment_that_does_not_tell_the_truth_is_refused():
    with pytest.raises(rtd.UserError, match="disturb it with rtd.disturb"):
        make_jobs(rtd.make("rover"), rtd.Config(**FIELDS), [0])


def test_an_actor_must_not_read_the_truth():
    spec = rtd.NetworkSpec(current=("true_observation",))
    critic = rtd.NetworkSpec(current=("observation", "action"))
    with pytest.raises(rtd.UserError, match="critics only"):
        rtd.register_agent("cheat", rtd.Variant(actor=spec, critic=critic))
