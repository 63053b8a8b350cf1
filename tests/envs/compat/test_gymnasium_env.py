"""Tests our environments with Gymnasium's checker, and its rules about ends and seeds."""

import gc
import subprocess
import sys
import types
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import struct
from gymnasium.utils.env_checker import check_env
from gymnax.environments import environment, spaces

import rtd3jax as rtd
from rtd3jax.envs.builtin import LISTED
from rtd3jax.envs.compat import gymnasium as gymnasium_env
from rtd3jax.envs.compat.frames import Episode
from rtd3jax.envs.compat.gymnasium import gymnasium_id
from rtd3jax.errors import UserError


@struct.dataclass
class State:
    time: jax.Array
    position: jax.Array


class Falling(environment.Environment):
    """Terminates where its position passes one; four steps at most; declares no space."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=4)

    def reset_env(self, key, params):
        position = jax.random.uniform(key, (), jnp.float32, 0.0, 0.1)
        return position[None], State(jnp.int32(0), position)

    def step_env(self, key, state, action, params):
        position = state.position + action[0]
        state = State(state.time + jnp.int32(1), position)
        return position[None], state, position, position > 1.0, {"where": {"x": position}}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


@pytest.mark.parametrize(
    "env_id",
    [gymnasium_id("pendulum", "random-sine"), gymnasium_id("rover", "ar1-slip")],
)
def test_gymnasiums_checker_is_content_with_registered_environments(env_id):
    env = gymnasium.make(env_id)
    with warnings.catch_warnings():
        # It would like bounded observations and actions within one: advice, not rules.
        warnings.filterwarnings("ignore", message=".*Box.*")
        warnings.filterwarnings("error", message=".*[Rr]ender.*")
        check_env(env.unwrapped)
    assert env.unwrapped.spec.id == env_id


@pytest.mark.parametrize("env_id", ["CartPole-v1", "MountainCarContinuous-v0"])
def test_it_is_content_with_gymnaxs_own(env_id):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*(Box|spec).*")
        check_env(rtd.to_gymnasium(rtd.make(env_id)))


def test_every_environment_and_disturbance_is_registered():
    for env_id, disturbances in LISTED.items():
        for disturbance in disturbances:
            assert gymnasium_id(env_id, disturbance) in gymnasium.registry
    assert "rtd3jax/Pendulum-random-sine-v0" in gymnasium.registry
    assert "rtd3jax/Rover-ar1-slip-v0" in gymnasium.registry
    assert "rtd3jax/RoverSoil-mixed-v0" in gymnasium.registry
    env = gymnasium.make("rtd3jax/Rover-dropout-v0", p=0.5, max_steps_in_episode=7)
    assert env.unwrapped.params.process.p == 0.5
    assert env.unwrapped.params.max_steps_in_episode == 7


def test_importing_brings_in_no_optional_package():
    code = (
        "import rtd3jax, sys; "
        "assert not {'torch', 'stable_baselines3', 'brax', 'mujoco', 'pygame'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_time_limit_is_truncated_and_the_final_observation_is_the_old_episodes():
    env = rtd.to_gymnasium(Falling())
    first, info = env.reset(seed=1)
    assert first.dtype == np.float32 and info == {}
    for step in range(1, 5):
        observation, reward, terminated, truncated, info = env.step(np.array([0.2], np.float32))
        np.testing.assert_allclose(observation, first + 0.2 * step, rtol=1e-5)
        assert isinstance(reward, float) and type(terminated) is type(truncated) is bool
        assert (terminated, truncated) == (False, step == 4)
        np.testing.assert_allclose(info["where"]["x"], observation[0])
        assert isinstance(info["where"]["x"], np.ndarray)
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.array([0.2], np.float32))
    assert env.reset()[0] != first


def test_a_termination_is_terminated():
    env = rtd.to_gymnasium(Falling())
    env.reset(seed=1)
    _, _, terminated, truncated, _ = env.step(np.ones(1, np.float32))
    assert (terminated, truncated) == (True, False)


def rollout(env, seed, steps=5):
    seen = [env.reset(seed=seed)[0]]
    for _ in range(steps):
        observation, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
        seen += [observation, reward]
    return np.concatenate([np.ravel(part) for part in seen])


def test_a_seed_decides_episode_and_disturbance():
    env, other = (gymnasium.make("rtd3jax/Pendulum-noise-v0") for _ in range(2))
    np.testing.assert_array_equal(rollout(env, 3), rollout(other, 3))
    assert not np.array_equal(rollout(env, 3), rollout(env, 4))
    assert not np.array_equal(rollout(env, None), rollout(env, None)), "episodes go on to differ"


def test_noise_is_new_at_every_step():
    env = rtd.to_gymnasium(rtd.make("pendulum", "noise"))
    env.reset(seed=0)
    noise = []
    for _ in range(20):
        observation, _, _, _, info = env.step(np.zeros(1, np.float32))
        noise.append(observation - info["true_observation"])
    assert len(np.unique(np.round(noise, 4))) > 50


def test_parameters_may_be_given():
    env = rtd.make("rover", "ar1-slip")
    params = env.default_params.replace(max_steps_in_episode=1)
    env = rtd.to_gymnasium(env, params=params)
    env.reset(seed=0)
    assert env.step(np.zeros(2))[3]


class Hiding(Falling):
    def step(self, key, state, action, params=None):
        return *super().step(key, state, action, params)[:5], {}


class Matrix(Falling):
    def observation_space(self, params):
        return spaces.Box(-1.0, 1.0, (2, 2))


class Tuples(Falling):
    def action_space(self, params):
        return spaces.Tuple((spaces.Box(-1.0, 1.0, (1,)),))


@pytest.mark.parametrize(
    ("env", "match"),
    [
        (object(), "no method reset"),
        (Hiding(), "final_observation"),
        (Matrix(), "make them the same"),
        (Tuples(), "neither Box nor Discrete"),
    ],
)
def test_what_cannot_be_one_is_named(env, match):
    with pytest.raises(UserError, match=match):
        rtd.to_gymnasium(env, params=getattr(env, "default_params", ()))


def test_stable_baselines3_trains_on_it():
    sb3 = pytest.importorskip("stable_baselines3")
    from stable_baselines3.common import env_checker

    env_checker.check_env(rtd.to_gymnasium(rtd.make("rover", "ar1-slip")))
    env = gymnasium.make("rtd3jax/Pendulum-random-sine-v0")
    model = sb3.TD3(
        "MlpPolicy",
        env,
        learning_starts=100,
        batch_size=16,
        policy_kwargs={"net_arch": [8]},
        seed=0,
    )
    model.learn(300)
    assert model.num_timesteps == 300 and model.replay_buffer.size() == 300
    # The one time limit within is stored as such: its done does not stop bootstrapping.
    ends = np.flatnonzero(model.replay_buffer.dones[:300])
    np.testing.assert_array_equal(ends, [199])
    assert model.replay_buffer.timeouts[199] == 1.0


def turning(frames):
    """Pixels of the plant's half that differ between the first frame and the last."""
    return int(np.any(frames[0][:, :300] != frames[-1][:, :300], axis=-1).sum())


@pytest.mark.parametrize(
    "env_id", ["rtd3jax/Pendulum-hidden-v0", "rtd3jax/Rover-ar1-slip-v0", "Pendulum-delay"]
)
def test_an_episode_is_drawn_until_its_last_step(env_id):
    if "/" in env_id:
        env = gymnasium.make(env_id, render_mode="rgb_array", max_steps_in_episode=3)
    else:
        environment = rtd.make("pendulum", "delay", steps=2)
        params = environment.default_params
        params = params.replace(env=params.env.replace(max_steps_in_episode=3))
        env = rtd.to_gymnasium(environment, params=params, render_mode="rgb_array")
    env.reset(seed=0)
    frames, over = [env.render()], False
    while not over:
        *_, over, _ = env.step(np.ones(env.action_space.shape, np.float32))
        frames.append(env.render())
    assert len(frames) == 4
    assert all(f.shape == (360, 640, 3) and f.dtype == np.uint8 for f in frames)
    assert turning(frames) > 100
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), frames[0])


def test_what_has_no_drawing_shows_its_signals():
    env = rtd.to_gymnasium(Falling(), render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.render()
    env.reset(seed=0)
    env.step(np.ones(1))
    assert env.render().shape == (360, 640, 3)


class Fall:
    """The scene of a point: a bar as high as what was last seen of it."""

    def __init__(self, params):
        self.drawn = []

    def first(self, state):
        return np.array([float(jnp.ravel(jax.tree.leaves(state)[0])[0])])

    def draw(self, axes, observations, actions):
        self.drawn.append((len(observations), len(actions)))
        axes.axhspan(0.0, 1.0, color="#ff0000")


def test_an_environment_with_a_scene_is_drawn_by_it(monkeypatch):
    monkeypatch.setattr(Falling, "scene", lambda self, params: Fall(params), raising=False)
    env = rtd.to_gymnasium(Falling(), render_mode="rgb_array")
    env.reset(seed=0)
    env.step(np.ones(1))
    left = env.render()[:, :300]
    assert np.all(left == (255, 0, 0), axis=-1).mean() > 0.5
    assert env._episode._scene.drawn == [(2, 1)]


def test_the_pendulum_stands_where_its_angle_says():
    env = rtd.to_gymnasium(rtd.make("pendulum"))
    episode = Episode(env.environment, env.params)
    for angle, right in ((np.pi / 2, False), (-np.pi / 2, True)):
        episode.begin(np.zeros(3), types.SimpleNamespace(theta=angle, theta_dot=0.0))
        blue = np.all(episode.frame()[:, :310] == (0, 114, 178), axis=-1)
        columns = np.flatnonzero(blue.any(axis=0))
        assert (columns.mean() > 166) == right  # the axle's column


def test_without_a_mode_nothing_is_drawn_nor_kept():
    env = gymnasium.make("rtd3jax/Rover-ar1-slip-v0")
    env.reset(seed=0)
    with pytest.warns(UserWarning, match="render_mode"):
        assert env.unwrapped.render() is None
    assert env.unwrapped._episode is None
    with pytest.raises(UserError, match="render_mode 'ansi' is unknown"):
        rtd.to_gymnasium(Falling(), render_mode="ansi")


def test_vector_environments_and_lists_of_frames_work_too():
    name = "rtd3jax/Rover-ar1-slip-v0"
    many = gymnasium.make_vec(name, num_envs=2, vectorization_mode="sync", render_mode="rgb_array")
    many.reset(seed=0)
    many.step(many.action_space.sample())
    assert [frame.shape for frame in many.render()] == [(360, 640, 3)] * 2
    listed = gymnasium.make(name, render_mode="rgb_array_list")
    listed.reset(seed=0)
    listed.step(listed.action_space.sample())
    assert len(listed.render()) == 2


def test_stable_baselines3_makes_and_checks_ours_by_name():
    pytest.importorskip("stable_baselines3")
    from stable_baselines3.common import env_checker, env_util

    many = env_util.make_vec_env("rtd3jax/Rover-ar1-slip-v0", n_envs=2)
    many.reset()
    assert many.render().ndim == 3
    env_checker.check_env(gymnasium.make("rtd3jax/Rover-ar1-slip-v0", render_mode="rgb_array"))


class Uncached:
    """Falling, unknown to JAX's caches: gymnax's own compiled methods keep their environment."""

    default_params = ()

    def reset(self, key, params):
        return jnp.zeros(1), State(jnp.int32(0), jnp.float32(0.0))

    def step(self, key, state, action, params):
        seen = jnp.zeros(1)
        return seen, state, jnp.float32(0.0), False, False, {"final_observation": seen}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))


def test_spaces_are_kept_as_long_as_their_environment(monkeypatch):
    monkeypatch.setattr(gymnasium_env, "_seen", {})
    monkeypatch.setattr(gymnasium_env, "_MOST_SEEN", 3)
    for _ in range(2):
        environment = Uncached()
        made = rtd.to_gymnasium(environment)
        assert list(gymnasium_env._seen) == [id(environment)]
        del made, environment
        gc.collect()
        assert not gymnasium_env._seen
    for steps in range(5):
        gymnasium.make("rtd3jax/Rover-none-v0", max_steps_in_episode=steps + 1)
    assert len(gymnasium_env._seen) == 3


def test_a_forked_process_is_told_to_spawn(monkeypatch):
    environment, name = rtd.make("rover"), "rtd3jax/Rover-ar1-slip-v0"
    env, named = rtd.to_gymnasium(environment), gymnasium.make(name)
    env.reset(seed=0)
    monkeypatch.setattr(gymnasium_env, "_PROCESS", -1)
    for forked in (env, rtd.to_gymnasium(environment), gymnasium.make(name)):
        assert forked.observation_space == named.observation_space
        with pytest.raises(UserError, match='context="spawn"') as caught:
            forked.reset(seed=0)
        assert "\n" not in str(caught.value)
    drawn = rtd.to_gymnasium(environment, render_mode="rgb_array")
    with pytest.raises(gymnasium.error.ResetNeeded):
        drawn.render()
    for call in (lambda: env.step(env.action_space.sample()), lambda: named.reset(seed=0)):
        with pytest.raises(UserError, match="forked"):
            call()
    with pytest.raises(UserError, match="forked"):
        rtd.to_gymnasium(rtd.make("pendulum"))
