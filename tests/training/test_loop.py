"""Tests the stored data of a lane: boundaries, final observations, carries."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

from rtd3jax.agents.networks import act, carry_before
from rtd3jax.agents.replay import gather, gather_segments
from rtd3jax.config import Config
from rtd3jax.training.lane import make_lane
from rtd3jax.training.loop import make_program

STEPS = 60


@struct.dataclass
class State:
    time: jax.Array
    episode: jax.Array


class Clock(environment.Environment):
    """Shows (a random number of the episode, steps since its start); ends after 7 steps, or 4.

    Episodes whose number is odd terminate after 4 steps; the others are cut after 7.
    """

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=7)

    def _see(self, state):
        return jnp.stack((state.episode, state.time)).astype(jnp.float32)

    def reset_env(self, key, params):
        state = State(jnp.int32(0), jax.random.randint(key, (), 0, 1000, jnp.int32))
        return self._see(state), state

    def step_env(self, key, state, action, params):
        state = State(state.time + jnp.int32(1), state.episode)
        terminated = (state.episode % 2 == 1) & (state.time == 4)
        return self._see(state), state, jnp.sum(action) * 1.0, terminated, {}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


@pytest.fixture(scope="module", params=["window", "carry"])
def lane(request):
    """h-td3 that never learns, so that every stored carry can be computed again.

    With a carry that runs on, its history is as long as the longest episode.
    """
    env = Clock()
    replay = "windows" if request.param == "window" else "segments"
    config = Config(
        algorithm="h-td3",
        history_length=3 if request.param == "window" else 7,
        replay=replay,
        acting=request.param,
        total_steps=STEPS,
        hidden_size=4,
        batch_size=4,
        learning_starts=STEPS,
        eval_every=STEPS,
        eval_episodes=1,
    )
    program = make_program(env, config, 2, (1,))
    lane = make_lane(config, 0, env.default_params)
    start = program.init(lane)
    # Cut unevenly: chunks must not matter.
    state = start
    advance = jax.jit(program.advance)
    for begin, end in ((0, 1), (1, 20), (20, STEPS)):
        state = advance(lane, state, jnp.int32(begin), jnp.int32(end))
    return program, lane, state


@pytest.fixture(scope="module")
def rows(lane):
    return jax.tree.map(np.asarray, lane[2].replay.transitions)


def test_next_observations_belong_to_the_same_episode(rows):
    seen, then = rows.step.observation, rows.next_observation
    np.testing.assert_array_equal(then[:, 0], seen[:, 0])
    np.testing.assert_array_equal(then[:, 1], seen[:, 1] + 1)


def test_ages_and_previous_actions_start_anew_with_each_episode(rows):
    np.testing.assert_array_equal(rows.episode_step, rows.step.observation[:, 1])
    first = rows.episode_step == 0
    assert first.sum() > 8 and not rows.step.previous_action[first].any()
    later = np.flatnonzero(~first)
    np.testing.assert_array_equal(rows.step.previous_action[later], rows.step.action[later - 1])


def test_only_terminations_are_marked_terminated(rows):
    odd, episode_step = rows.step.observation[:, 0] % 2 == 1, rows.episode_step
    np.testing.assert_array_equal(rows.terminated, odd & (episode_step == 3))
    assert rows.terminated.any() and (episode_step == 6).any()


def test_stored_carries_are_the_actors_own(lane):
    program, _, state = lane
    # The newest row's next carry is known only once the agent has acted again.
    numbers = jnp.arange(STEPS - 1, dtype=jnp.int32)
    length = program.window_tokens
    batch = gather(state.replay, numbers, jnp.int32(STEPS), length, length)
    actor, network = state.learner.actor, program.agent.acting_actor
    for stored, window in ((batch.carry, batch.window), (batch.next_carry, batch.next_window)):
        for got, want in zip(stored, carry_before(network, actor, window), strict=True):
            # A cell state is as large as its age.
            np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-6)


def test_the_newest_row_has_its_next_carry_when_its_episode_is_cut(lane):
    """As at the restart of a simulator, where no next step of this episode stores it."""
    program, one, state = lane
    assert int(state.episode_step[0]) > 0
    number, length = jnp.array([STEPS - 1], jnp.int32), program.window_tokens
    cut = jax.jit(program.cut)(one, state, jnp.int32(STEPS))
    batch = gather(cut.replay, number, jnp.int32(STEPS), length, length)
    want = carry_before(program.agent.acting_actor, state.learner.actor, batch.next_window)
    for got, own in zip(batch.next_carry, want, strict=True):
        assert np.any(own)
        np.testing.assert_allclose(got, own, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("burn_in_gradient", [True, False])
def test_segments_go_on_from_the_carry_that_was_stored(lane, burn_in_gradient):
    """While the actor stays the same, a short burn-in from there is as good as a whole episode."""
    program, _, state = lane
    if program.config.acting_mode == "window":
        pytest.skip("no carry runs on")
    count, length, burn_in = jnp.int32(STEPS), 3, 2
    first = jnp.arange(STEPS - length, dtype=jnp.int32)
    rows = state.replay, first, count, burn_in, burn_in, length, burn_in_gradient
    stored = gather_segments(*rows, critic_reads_carries=False, actor_reads_carries=True)
    number = (first[None, :] + jnp.arange(length)[:, None]).reshape(-1)
    whole = gather(state.replay, number, count, program.window_tokens, program.window_tokens)
    actor, network = state.learner.actor, program.agent.acting_actor
    for name in ("window", "next_window"):
        want = act(network, actor, getattr(whole, name))
        np.testing.assert_allclose(act(network, actor, getattr(stored, name)), want, atol=1e-6)
        from_nothing = gather_segments(*rows, critic_reads_carries=True)
        short = act(network, actor, getattr(from_nothing, name))
        assert np.abs(np.asarray(short - want)).max() > 1e-4


def test_the_last_evaluation_is_at_the_end(lane):
    assert np.isfinite(np.asarray(lane[2].returns)).all() and lane[0].evaluations == 1


@pytest.mark.parametrize("update_every, critic, actor", [(1, 11, 5), (4, 3, 1)])
def test_updates_come_every_so_many_steps_after_the_random_ones(update_every, critic, actor):
    config = Config(
        algorithm="td3",
        total_steps=20,
        hidden_size=32,
        batch_size=4,
        learning_starts=9,  # steps 9 to 19 may learn
        update_every=update_every,
        eval_every=20,
        eval_episodes=1,
    )
    env = Clock()
    program = make_program(env, config, 2, (1,))
    advance = jax.jit(program.advance)

    def trained(**changes):
        lane = make_lane(dataclasses.replace(config, **changes), 0, env.default_params)
        return advance(lane, program.init(lane), jnp.int32(0), jnp.int32(20)).learner

    learner, smoothed = trained(), trained(actor_noise=0.5)
    assert int(learner.critic_optimizer.count) == critic
    assert int(learner.actor_optimizer.count) == actor
    # The number that a configuration gives reaches the updates.
    gradients = [one.actor_optimizer.mu["head"]["kernel"] for one in (learner, smoothed)]
    assert not np.array_equal(*gradients)
