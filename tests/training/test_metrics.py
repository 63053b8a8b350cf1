"""Tests that metrics of learning are averages over the steps between two evaluations."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnax.environments import environment, spaces

import rtd3jax as rtd
from rtd3jax.agents.learners.base import Measured
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.metrics import averaged, empty_averages, note_reward, note_update


def test_averages_are_over_what_was_measured_in_the_interval():
    averages = empty_averages(("critic_loss", "actor_loss"), 3, 1)
    nothing = Measured(jnp.float32(0), jnp.float32(0))
    for loss, actor in ((2.0, None), (4.0, -1.0), (9.0, None)):
        found = nothing if actor is None else Measured(jnp.float32(actor), jnp.float32(1))
        critic = Measured(jnp.float32(loss), jnp.float32(1))
        averages = note_update(averages, {"critic_loss": critic, "actor_loss": found})
    for reward, done in ((1.0, False), (2.0, True), (5.0, False)):
        averages = note_reward(averages, jnp.float32([reward]), jnp.asarray([done]))
    averages = averaged(averages, jnp.int32(0))
    np.testing.assert_array_equal(averages.curves[0], [5.0, -1.0, 3.0])
    # An episode that is under way counts where it ends; an interval without measurements has none.
    averages = note_reward(averages, jnp.float32([1.0]), jnp.asarray([True]))
    averages = averaged(averages, jnp.int32(1))
    np.testing.assert_array_equal(averages.curves[1], [np.nan, np.nan, 6.0])
    assert np.isnan(averages.curves[2]).all()


class Params(struct.PyTreeNode):
    max_steps_in_episode: int = 5


class Steady(environment.Environment):
    """Every step is rewarded with one."""

    @property
    def default_params(self):
        return Params()

    def reset_env(self, key, params):
        return jnp.zeros(1), jnp.int32(0)

    def step_env(self, key, state, action, params):
        return jnp.zeros(1), state + 1, jnp.float32(1.0), state + 1 >= 5, {}

    def is_truncated(self, state, params):
        return jnp.asarray(False)

    def action_space(self, params=None):
        return spaces.Box(-1.0, 1.0, (1,))


def test_a_run_has_the_metrics_of_each_interval():
    config = rtd.Config(
        algorithm="td3",
        total_steps=80,
        learning_starts=20,
        batch_size=16,
        hidden_size=8,
        eval_every=20,
        eval_episodes=1,
        gamma=0.0,
    )
    run = rtd.train(Steady(), config, seeds=[0, 1], progress=False)
    metrics = run.metrics
    assert all(curve.shape == (2, 4) for curve in metrics.values())
    np.testing.assert_array_equal(metrics["exploration_return"], 5.0)  # also of random steps
    assert np.isnan(metrics["critic_loss"][:, 0]).all()
    both = metrics["critic_loss_1"] + metrics["critic_loss_2"]
    np.testing.assert_allclose(metrics["critic_loss"][:, 1:], both[:, 1:], rtol=1e-5)
    np.testing.assert_allclose(metrics["target"][:, 1:], 1.0)  # without a future, the reward
    assert (metrics["critic_loss"][:, 3] < metrics["critic_loss"][:, 1]).all()
    shares = metrics["saturated_actions"][:, 1:]
    assert ((shares >= 0) & (shares <= 1)).all()
    for name in ("critic_gradient_norm", "actor_gradient_norm", "actor_loss"):
        assert np.isfinite(metrics[name][:, 1:]).all(), name


@pytest.mark.parametrize(
    ("delay", "updates"), [(1, [16, 32]), (2, [16, 32]), (3, [15, 30]), (40, [40])]
)
def test_the_actors_norm_is_measured_at_about_every_sixteenth_update(delay, updates):
    config = rtd.Config("td3", policy_delay=delay, hidden_size=4, batch_size=4, total_steps=50)
    (job,) = make_jobs(Steady(), dataclasses.replace(config, learning_starts=10), [0])
    agent, keys = job.program.agent, jax.random.split(jax.random.key(0), 3)
    numbers, replay = job.lane.hyperparameters, jax.jit(job.program.init)(job.lane).replay
    batch = agent.sample(replay, keys[0], jnp.int32(20), numbers.history_length, None)
    update, learner = jax.jit(agent.update), jax.jit(agent.init)(keys[0])
    found = []
    for count in range(1, 45):
        _, metrics = update(learner, batch, keys[1:], numbers, jnp.int32(count))
        found += [count] if float(metrics["actor_gradient_norm"].times) else []
    assert found == updates


def test_the_actors_norm_is_that_of_its_gradient():
    from rtd3jax.agents.learners.td3 import _as_measured, _norm

    gradient = {
        "memory": {"input_kernel": jnp.array([[2.0]]), "recurrent_kernel": jnp.array([[4.0]])},
        "head": {"bias": jnp.array([1.0, -2.0])},
    }
    before = jax.tree.map(lambda g: 7.0 - g, gradient)
    after = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, before, gradient)
    # Only the gradient of the recurrent kernel may be read from the gradient itself.
    readable = jax.tree.map(jnp.zeros_like, gradient)
    readable["memory"]["recurrent_kernel"] = gradient["memory"]["recurrent_kernel"]
    found = _norm(jnp.asarray(True), _as_measured(readable, before, after))
    np.testing.assert_allclose(found.total, 5.0, rtol=1e-5)
    assert float(_norm(jnp.asarray(False), gradient).times) == 0.0
