"""A mixture: every episode is one of its members' episodes, from beginning to end."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.envs.disturbed import seen_elements
from rtd3jax.study.lane_files import cell_name

STEPS = 30


class Add(rtd.Process):
    """Adds ``value`` at every step, and once more for each step that it has counted."""

    value: float = 1.0

    def init(self, key, horizon, size):
        return jnp.zeros((), jnp.float32)

    def step(self, key, state, signal):
        return signal + self.value + state, state + 1.0


def play(process, episodes, size=3):
    """What becomes of zeros: [episodes, STEPS, size]."""

    def episode(key):
        key, first = jax.random.split(key)
        state = process.init(first, STEPS, size)

        def step(state, key):
            signal, state = process.step(key, state, jnp.zeros((size,), jnp.float32))
            return state, signal

        return jax.lax.scan(step, state, jax.random.split(key, STEPS))[1]

    return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(1), episodes)))


def test_an_episode_is_one_members_from_beginning_to_end():
    members = Add(10.0), Add(200.0), Add(3000.0)
    played = play(rtd.Mixture(members, weights=(2, 1, 1)), 2000)
    expected = np.array([member.value for member in members])[:, None] + np.arange(STEPS)
    kinds = np.abs(played[:, :1, 0] - expected[:, 0]).argmin(1)
    np.testing.assert_array_equal(played, np.repeat(expected[kinds][..., None], 3, -1))
    shares = np.bincount(kinds, minlength=3) / len(kinds)
    # Four standard errors of a share of one half among 2,000 episodes.
    np.testing.assert_allclose(shares, [0.5, 0.25, 0.25], atol=0.045)


def test_a_weight_of_zero_never_acts_and_members_draw_independently():
    silent = play(rtd.Mixture((Add(1.0), rtd.GaussianNoise(0.5)), weights=(0, 1)), 500)
    assert abs(silent.std() - 0.5) < 0.01
    first, second = rtd.Mixture((rtd.Sine(), rtd.Sine())).init(jax.random.key(0), 200, 3).members
    assert first.amplitude != second.amplitude


@pytest.mark.parametrize(
    ("name", "kinds"),
    [
        ("random-sine/noise:sigma=0.1", {"sine", "noise"}),
        ("none/random-sine", {"none", "sine"}),
        ("random-sine+hidden/noise+hidden", {"sine", "noise"}),
    ],
)
def test_the_pendulum_by_name(name, kinds):
    """Noise is never zero, a sine often is: the first observation tells an episode's kind."""
    env = rtd.make("pendulum", name)
    played = rtd.rollout(rtd.constant_policy([0.0]), env, seed=0, episodes=24)
    kept = seen_elements(env, env.default_params, 3)
    assert kept == ([0, 1] if "hidden" in name else [0, 1, 2])
    offset = np.asarray(played.seen, np.float64) - np.asarray(played.true)[..., kept]
    found = set()
    for episode in offset:
        quiet = np.abs(episode).max(-1) < 1e-5
        found.add("none" if quiet.all() else "sine" if quiet[0] else "noise")
    assert found == kinds


def test_the_rovers_slip_may_be_of_either_kind():
    env = rtd.make("rover", "ar1-slip/sine-slip")
    assert isinstance(env.default_params.slip, rtd.Mixture)
    assert rtd.evaluate(rtd.constant_policy([0.5, 0.0]), env, episodes=5).shape == (5,)


def test_an_agent_trains_on_it_and_its_reward_is_the_true_one():
    env = rtd.make("pendulum", "noise/random-sine")
    assert env.reward_from == "state"
    config = rtd.Config(
        algorithm="td3", total_steps=60, hidden_size=4, batch_size=4, learning_starts=10,
        eval_every=30, eval_episodes=1,
    )  # fmt: skip
    run = rtd.train(env, config, seeds=[0], progress=False)
    assert np.isfinite(run.returns).all()


def test_directories_tell_a_mixture_from_other_names():
    config = rtd.Config(algorithm="td3", total_steps=60, learning_starts=10, batch_size=4)
    names = [cell_name(rtd.Cell("pendulum", d, config)) for d in ("a/b", "a-b", "a+b")]
    assert len(set(names)) == 3
    assert not any("/" in name for name in names)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (
            lambda: rtd.make("pendulum", "noise/action-delay"),
            "disturb the same channel, not the act",
        ),
        (lambda: rtd.make("pendulum", "noise/hidden"), "have different sizes"),
        (lambda: rtd.make("pendulum", "noise/"), "unknown disturbance ''"),
        (lambda: rtd.make("pendulum", "noise/hidden+"), "unknown disturbance ''"),
        (lambda: rtd.make("pendulum", "noise/random-sine", weights=(1,)), "1 weights for 2"),
        (lambda: rtd.make("pendulum", "noise/random-sine", weights=(0, 0)), "must be positive"),
        (
            lambda: rtd.disturb(
                rtd.make("rover"), rtd.Mixture((rtd.Dropout(),) * 2, (1, float("nan")))
            ),
            "weights=(1, nan) must be a tuple of finite numbers",
        ),
        (
            lambda: rtd.disturb(rtd.make("rover"), rtd.Mixture((rtd.Dropout(),), "1")),
            "must be a tuple of finite numbers",
        ),
        (lambda: rtd.make("pendulum", "noise", weights=(1, 2)), "no parameter 'weights'"),
        (
            lambda: rtd.make("pendulum", "noise/noise", sigma=1.0),
            "is a parameter of noise and of noise",
        ),
        (lambda: rtd.make("pendulum", "noise/random-sine", sigma=-1.0), "sigma"),
        (lambda: rtd.disturb(rtd.make("rover"), rtd.Mixture()), "no members"),
    ],
)
def test_what_makes_no_sense_is_one_line(make, says):
    with pytest.raises(rtd.UserError) as raised:
        make()
    assert says in str(raised.value)
    assert "\n" not in str(raised.value)
