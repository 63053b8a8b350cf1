"""Gymnasium environments that are trained on: played, lost, resumed, refused."""

import dataclasses
import functools
import hashlib
import itertools
import pickle
import sys
import time
import warnings
from types import SimpleNamespace

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec

import rtd3jax as rtd
from rtd3jax.envs.compat import simulator
from rtd3jax.envs.compat.simulated import simulated_identity
from rtd3jax.envs.compat.simulator import Fault, Simulator, close_simulators, fault_of
from rtd3jax.envs.compat.simulator_state import simulator_handles
from rtd3jax.envs.compat.surface import surface_of
from rtd3jax.study.time_estimate import study_seconds
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.jobs import make_jobs
from rtd3jax.training.revival import revived

SMALL = rtd.Config(
    algorithm="td3",
    total_steps=60,
    learning_starts=20,
    eval_every=30,
    eval_episodes=2,
    hidden_size=8,
    batch_size=8,
    replay_capacity=60,
)


class Cart(gymnasium.Env):
    """A point that is pushed; ends where it leaves the track. It may misbehave."""

    observation_space = gymnasium.spaces.Dict(
        a=gymnasium.spaces.Box(-9, 9, (2,), np.float64), b=gymnasium.spaces.Box(-1, 1, (1,))
    )
    action_space = gymnasium.spaces.Box(np.float32([-1, -3]), np.float32([2, 3]))
    made = 0
    closed = 0
    begun = 0

    def __init__(self, fault=None, at=10, noise=False, lost=()):
        type(self).made += 1
        self.fault, self.at, self.noise, self.lost = fault, at, noise, lost
        self.count = 0
        self.random = np.random.default_rng() if noise else None

    def seen(self):
        return {"a": np.array([self.x, self.v]), "b": np.zeros(1, np.float32)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        assert seed is not None
        type(self).begun += 1
        self.x, self.v, self.time = self.np_random.uniform(-0.5, 0.5), 0.0, 0
        return self.seen(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.time += 1
        self.count += 1
        self.v += 0.1 * float(action[0]) + (1e-3 * self.random.normal() if self.noise else 0.0)
        self.x += 0.1 * self.v
        seen, reward = self.seen(), -(self.x**2)
        if self.count >= self.at:
            if self.fault == "raise":
                raise RuntimeError("the wheel broke")
            if self.fault == "hang":
                time.sleep(3)
            if self.fault == "nan":
                seen["a"][1] = np.nan
            if self.fault == "shape":
                seen["a"] = np.zeros(3)
            if self.fault == "reward":
                reward = "much"
            if self.fault in STRANGE:
                return STRANGE[self.fault](seen, reward)
            if self.fault == "four":
                return seen, reward, False, {}
        return seen, reward, abs(self.x) > 0.7, False, {}

    def close(self):
        type(self).closed += 1


STRANGE = {
    "flags": lambda seen, reward: (seen, reward, np.array([True, False]), False, {}),
    "no flag": lambda seen, reward: (seen, reward, False, [], {}),
    "rewards": lambda seen, reward: (seen, np.eye(2), False, False, {}),
    "huge reward": lambda seen, reward: (seen, 10**400, False, False, {}),
    "endless reward": lambda seen, reward: (seen, 10**5_000, False, False, {}),
    "wide reward": lambda seen, reward: (seen, -1e39, False, False, {}),
    "huge": lambda seen, reward: ({**seen, "a": [10**400, 0]}, reward, False, False, {}),
    "wide": lambda seen, reward: ({**seen, "a": np.array([1e39, 0])}, reward, False, False, {}),
    "no dict": lambda seen, reward: (SimpleNamespace(), reward, False, False, {}),
}
"""What `Cart` returns with these faults."""


def make(**kwargs):
    return Cart(**kwargs)


def environment(**kwargs):
    return rtd.from_gymnasium(make, keep=[0, 2], max_steps_in_episode=12, **kwargs)


def test_a_program_plays_what_a_loop_plays():
    env = rtd.from_gymnasium(make, max_steps_in_episode=12)
    assert env.element_names == ("a[0]", "a[1]", "b[0]")
    params = env.default_params
    _, state = jax.jit(env.reset)(jax.random.key(3), params)
    step = jax.jit(env.step)
    own = Cart()
    seen, _ = own.reset(seed=int(state.seed))
    lengths = []
    for number in range(60):
        action = jnp.array([2.0 * (-1) ** (number // 9), 0.5])
        key = jax.random.fold_in(jax.random.key(4), number)
        observation, state, reward, terminated, truncated, info = step(key, state, action, params)
        seen, own_reward, end, _, _ = own.step(
            np.clip(action, Cart.action_space.low, Cart.action_space.high)
        )
        np.testing.assert_array_equal(
            info["final_observation"], np.float32([*seen["a"], *seen["b"]])
        )
        assert float(reward) == np.float32(own_reward) and bool(terminated) == end
        assert bool(truncated) == (own.time == 12)
        if end or truncated:
            lengths.append(own.time)
            seen, _ = own.reset(seed=int(state.seed))
        np.testing.assert_array_equal(observation, np.float32([*seen["a"], *seen["b"]]))
    assert 12 in lengths and min(lengths) < 12


@pytest.mark.slow
@pytest.mark.parametrize("strategy", ["map", "vmap"])
def test_lanes_train_and_all_simulators_are_closed(strategy):
    close_simulators()
    made, closed = Cart.made, Cart.closed
    run = rtd.train(environment(), SMALL, seeds=range(2), progress=False, strategy=strategy)
    assert np.isfinite(run.returns).all() and not run.failures
    # One to be looked at, one for each lane; those of evaluations may serve both lanes.
    assert 1 + 2 + 2 <= Cart.made - made <= 1 + 2 + 4
    assert Cart.closed - closed == Cart.made - made
    again = rtd.train(environment(), SMALL, seeds=range(2), progress=False, strategy=strategy)
    np.testing.assert_array_equal(run.returns, again.returns)


def test_lanes_with_simulators_train_one_by_one_also_under_vmap():
    """JAX cannot batch the condition in which an evaluation calls a simulator."""
    jobs = make_jobs(environment(), SMALL, range(3))
    groups = make_groups(jobs, "vmap", 1)
    assert [(len(group.jobs), group.wave) for group in groups] == [(1, 0)] * 3
    assert [group.wave for group in make_groups(jobs, "vmap", 1, 2)] == [0, 0, 1]
    assert study_seconds(jobs, "vmap", lambda config: 1.0) > 0
    runs = [
        rtd.train(environment(), SMALL, seeds=range(3), progress=False, strategy=strategy)
        for strategy in ("map", "vmap")
    ]
    assert not runs[1].failures
    np.testing.assert_array_equal(runs[0].returns, runs[1].returns)


def test_side_by_side_episodes_are_those_one_by_one():
    env = rtd.from_gymnasium("Pendulum-v1")
    policy = rtd.constant_policy([0.5])
    returns = rtd.evaluate(policy, env, episodes=2, seed=1)
    played = rtd.rollout(policy, env, seed=1, episodes=2)
    np.testing.assert_allclose(returns, played.returns, rtol=1e-5)
    assert played.truncated[:, -1].all() and list(played.lengths) == [200, 200]


@pytest.mark.slow
def test_a_simulator_composes_with_a_disturbance_and_is_reset_at_ends_alone():
    env = rtd.disturb(environment(), rtd.Delay())
    rtd.check_env(environment())
    config = dataclasses.replace(SMALL, environments=2)
    run = rtd.train(env, config, seeds=[0], progress=False)
    assert np.isfinite(run.returns).all()
    assert rtd.make("gymnasium:Pendulum-v1", "dropout", p=0.2).name == "Pendulum-v1"


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ("raise", "step raised RuntimeError: the wheel broke"),
        ("hang", "did not return within 0.3 s"),
        ("nan", "element 1 of the observation of step is nan"),
        ("shape", "shape (3,) instead of (2,)"),
        ("reward", "the reward 'much' is not a number"),
        ("four", "step returned 4 values"),
        ("flags", "step returned terminated=array([ True, False]), which is not True or False"),
        ("no flag", "step returned truncated=[], which is not True or False"),
        ("rewards", "the reward array([[1., 0... [0., 1.]]) is not a number"),
        ("huge reward", "is not a number"),
        ("endless reward", "the reward of type int is not a number"),
        ("wide reward", "the reward is -1e+39, too large for float32"),
        ("huge", "the observation of step is unfit: int too large to convert to float"),
        ("wide", "the observation of step is unfit: element 0 is 1e+39, too large for float32"),
        ("no dict", "the observation of step is unfit: 'types.SimpleNamespace' object is not"),
    ],
)
def test_a_simulator_that_fails_says_how_and_stays_lost(fault, message):
    seconds = 0.3 if fault == "hang" else 60.0
    fleet = environment(fault=fault, at=2, step_seconds=seconds).fleet
    handle, _, _ = fleet.reset(-1, 5)
    place = fleet._busy[handle].place
    action = np.zeros(2, np.float32)
    _, simulator = fleet.at(handle, place, lambda count: [])
    simulator.step(action)
    for _ in range(2):
        with pytest.raises(Fault) as raised:
            simulator.step(action)
        assert message in str(raised.value) and "\n" not in str(raised.value)
    with pytest.raises(Fault):
        fleet.reset(handle, 6)


def test_a_large_element_that_is_not_observed_does_not_matter():
    env = rtd.from_gymnasium(make, keep=[1, 2], fault="wide", at=1, max_steps_in_episode=3)
    policy = rtd.constant_policy([0.1, 0.1])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.isfinite(rtd.evaluate(policy, env, 1)).all()
    close_simulators()


@pytest.mark.parametrize("fault", ["flags", "huge reward"])
def test_what_step_should_not_return_does_not_end_the_program(fault):
    env, policy = environment(fault=fault, at=2), rtd.constant_policy([0.1, 0.1])
    with pytest.warns(UserWarning, match="the simulator failed: "):
        assert np.isnan(rtd.evaluate(policy, env, 1)).all()
    close_simulators()


def test_other_lanes_go_on():
    number = itertools.count()

    class Own(Cart):
        """Counts only the simulators of this test that are closed."""

        closed = 0

    def some():  # to be looked at, another's, the first lane's, ...
        return Own(fault="raise" if next(number) == 2 else None, at=25)

    env = rtd.from_gymnasium(some, keep=[0], max_steps_in_episode=12)
    _, held = env.reset(jax.random.key(0), env.default_params)
    closed = Own.closed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        run = rtd.train(env, SMALL, seeds=range(2), progress=False)
    assert len(run.failures) == 1 and run.failures[0].step == 24
    assert "step raised RuntimeError: the wheel broke" in run.failures[0].reason
    healthy = 1 - run.failures[0].seed
    assert np.isfinite(run.returns[healthy]).all()
    # What someone else plays stays open and where it is; all else is closed.
    assert env.fleet.count == 1 and not env.fleet._busy[int(held.handle)]._closed
    assert Own.closed - closed == next(number) - 2
    close_simulators()


def test_a_free_simulator_stays_open_while_anyone_plays():
    fleet = environment().fleet
    first, second = (fleet.reset(-1, seed)[0] for seed in (1, 2))
    with fleet.in_use():
        with fleet.in_use():
            fleet.release(first)
        assert fleet.count == 2 and fleet.reset(-1, 3)[0] != first
        fleet.release(first + 2)
        fleet.drop([second])
        assert fleet.count == 1
    assert fleet.count == 0


def test_a_lost_lane_has_no_simulator_of_another_process():
    (job,) = make_jobs(environment(), SMALL, [0])
    state = jax.jit(job.program.init)(job.lane)
    lost = dataclasses.replace(state, failure=jnp.full_like(state.failure, 1))
    assert simulator_handles(revived(job.program, job.lane, lost, 30).env_state) == [-1]
    close_simulators()


def test_a_lane_that_gets_more_steps_takes_no_simulator():
    from rtd3jax.training.checkpoint_arrays import extended, to_arrays

    env = environment()
    (short,) = make_jobs(env, SMALL, [0])
    longer = dataclasses.replace(SMALL, total_steps=90, replay_capacity=90)
    (job,) = make_jobs(env, longer, [0])
    with env.fleet.in_use():
        state = jax.jit(short.program.init)(short.lane)
        before = dict(env.fleet._busy)
        arrays = extended(to_arrays(state), job.program, job.lane)
        assert env.fleet._busy == before and len(before) == 1
    assert len(arrays[".replay.transitions.terminated"]) == 90
    close_simulators()


@pytest.mark.parametrize("noise", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_resumed_lanes_end_with_the_same_bits(tmp_path, noise):
    (job,) = make_jobs(environment(noise=noise), SMALL, [0])
    program, lane = job.program, job.lane
    advance = jax.jit(program.advance)
    state = advance(lane, jax.jit(program.init)(lane), jnp.int32(0), jnp.int32(33))
    assert int(state.episode_step[0]) > 2
    kept = jax.tree.map(lambda leaf: leaf, state)
    whole = jax.block_until_ready(advance(lane, state, jnp.int32(33), jnp.int32(60)))
    close_simulators()  # as a new process: no simulator is where the lane was
    if not noise:
        resumed = advance(lane, revived(program, lane, kept, 33), jnp.int32(33), jnp.int32(60))
        for one, other in zip(
            jax.tree.leaves((whole.learner, whole.returns, whole.replay)),
            jax.tree.leaves((resumed.learner, resumed.returns, resumed.replay)),
            strict=True,
        ):
            np.testing.assert_array_equal(one, other)
        return
    with pytest.warns(UserWarning, match="not deterministic.*a fresh one begins"):
        fresh = revived(program, lane, kept, 33)
    assert int(fresh.episode_step[0]) == 0 and int(fresh.env_state.time) == 0
    done = advance(lane, fresh, jnp.int32(33), jnp.int32(60))
    assert int(done.failure) == 0
    # A lane whose simulator is lost while it is trained names the reason.
    state = advance(lane, jax.jit(program.init)(lane), jnp.int32(0), jnp.int32(33))
    close_simulators()
    with pytest.warns(UserWarning, match="not deterministic"):
        lost = jax.block_until_ready(advance(lane, state, jnp.int32(33), jnp.int32(60)))
    assert int(lost.failure) != 0
    assert "not deterministic" in fault_of(int(simulator_handles(lost.env_state)[0]))


class Discrete(Cart):
    action_space = gymnasium.spaces.Discrete(3)


class Unbounded(Cart):
    action_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,))


class Images(Cart):
    observation_space = gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)


@dataclasses.dataclass
class Unhashable:
    """A factory that is equal to others, and so has no hash."""

    at: int = 10

    def __call__(self):
        return Cart(at=self.at)


def fails():
    raise OSError("no licence")


def lacks_a_package():
    raise ModuleNotFoundError("No module named 'imageio'")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (Discrete, "choose an environment whose action space is a bounded Box"),
        (Unbounded, "give them finite bounds"),
        (Images, "images"),
        (fails, "no licence"),
        (lacks_a_package, "needs a package that is missing (No module named 'imageio'): pip"),
        ("Pendulumm-v1", "did you mean 'Pendulum-v1'"),
        (lambda: gymnasium.make_vec("Pendulum-v1", 2), "every lane makes its own"),
        (lambda: 3, "not a gymnasium.Env"),
        (Cart(), "a function that makes it"),
        (7, "neither an id"),
        (Unhashable(), "Unhashable cannot be hashed (unhashable type: 'Unhashable'), so"),
    ],
)
def test_what_is_refused_in_one_line(given, message):
    with pytest.raises(rtd.UserError) as raised:
        rtd.from_gymnasium(given)
    assert message in str(raised.value) and "\n" not in str(raised.value)


@pytest.mark.parametrize("seconds", ["60", None, True, 0, np.inf, np.ones(2)])
def test_a_limit_that_is_no_number_of_seconds_is_refused(seconds):
    with pytest.raises(rtd.UserError, match="must be a number of seconds above 0"):
        rtd.from_gymnasium(make, step_seconds=seconds)


@pytest.mark.parametrize("keep", [[], [0, 0], [5], [-1], [0.5], "ab", 1.5, slice(3, 3)])
def test_elements_that_cannot_be_kept_are_refused(keep):
    with pytest.raises(rtd.UserError, match="keep="):
        rtd.from_gymnasium(make, keep=keep)


@pytest.mark.slow
def test_the_sweep_trains_by_name(tmp_path):
    from rtd3jax.sweep import main

    out = tmp_path / "run"
    words = "--env gymnasium:Pendulum-v1 --algorithms td3 --seeds 1 --quiet --no-report "
    words += "--total-steps 60 --learning-starts 20 --eval-every 60 --eval-episodes 1 "
    words += f"--hidden-size 8 --batch-size 8 --final-episodes 1 --out {out}"
    assert main(words.split()) == 0
    assert "gymnasium:Pendulum-v1" in (out / "summary.md").read_text("utf-8")


def test_a_longer_time_limit_than_the_ids_own():
    env = rtd.from_gymnasium("Pendulum-v1", max_steps_in_episode=210)
    step = jax.jit(env.step)
    _, state = env.reset(jax.random.key(0), env.default_params)
    for number in range(210):
        _, state, *_, truncated, _ = step(
            jax.random.key(1), state, jnp.zeros(1), env.default_params
        )
        assert bool(truncated) == (number == 209)
    close_simulators()


def test_an_episode_longer_than_the_log_of_actions_is_refused():
    env = rtd.from_gymnasium("Pendulum-v1", max_steps_in_episode=3)
    longer = env.default_params.replace(max_steps_in_episode=4)
    policy = rtd.constant_policy([0.5])
    disturbed = rtd.disturb(env, rtd.Delay())
    for made, params in (
        (env, longer),
        (disturbed, disturbed.default_params.replace(env=longer)),
    ):
        with pytest.raises(rtd.UserError, match="=4 is beyond the 3 steps with .* a larger max_"):
            rtd.evaluate(policy, made, 1, params=params)
    shorter = env.default_params.replace(max_steps_in_episode=2)
    assert rtd.rollout(policy, env, 1, params=shorter).lengths[0] == 2
    # Where the parameters are traced the simulator itself refuses.
    _, state = env.reset(jax.random.key(0), longer)
    step = jax.jit(env.step_env)
    with pytest.warns(UserWarning, match="its episode goes on beyond the 3 steps"):
        for _ in range(4):
            observation, state, *_ = jax.block_until_ready(
                step(jax.random.key(1), state, jnp.zeros(1), longer)
            )
    assert np.isnan(observation).all() and "3 steps" in env.fleet.fault(int(state.handle))
    close_simulators()


def test_tables_that_print_alike_are_two_environments():
    def make(table):
        return gymnasium.make("Pendulum-v1")

    one, other = np.zeros(2_000), np.zeros(2_000)
    other[1_000] = 1.0
    made = [rtd.from_gymnasium(make, table=table) for table in (one, other, one.copy())]
    assert made[0] != made[1] and made[0] == made[2]


def test_another_lanes_fault_is_not_that_of_a_restored_one():
    """Handles are numbers of a process: in the next one they belong to others."""
    env = rtd.from_gymnasium("Pendulum-v1")
    _, state = env.reset(jax.random.key(0), env.default_params)
    taken = env.fleet._busy[int(state.handle)]
    taken.fault = "another lane's"
    found = env.restored(state)
    assert int(found.handle) != int(state.handle) and env.fleet.fault(int(found.handle)) is None
    open_before = env.fleet.count
    env.step(jax.random.key(1), found, jnp.zeros(1), env.default_params)
    assert env.fleet.count == open_before  # the restored one is the one that steps
    close_simulators()


def test_one_that_hangs_is_waited_for_once(monkeypatch):
    """It keeps its fault, for the lane's message; every later training would wait for it again."""

    class Plain:
        def reset(self, seed):
            return np.zeros(1), {}

        def close(self):
            """Nothing is open."""

    simulator, waited = Simulator(Plain, lambda observation: observation, 5.0), []
    simulator.reset(0)

    def hang(call, seconds):
        waited.append(seconds)
        raise TimeoutError

    monkeypatch.setattr(simulator._thread, "do", hang)
    simulator.close()
    simulator.close()
    assert waited == [5.0]


def test_whoever_plays_leaves_no_simulator_busy():
    env, policy = environment(), rtd.constant_policy([0.1, 0.1])
    for _ in range(2):
        rtd.rollout(policy, env, episodes=3)
        assert env.fleet.count == 3 and not env.fleet._busy
        rtd.rollout(policy, rtd.disturb(env, rtd.Dropout()), episodes=3)
        assert env.fleet.count == 3 and not env.fleet._busy
    rtd.check_env(env)
    assert env.fleet.count == 0
    played = rtd.to_gymnasium(rtd.disturb(env, rtd.Dropout()))
    for seed in range(3):
        played.reset(seed=seed)
        played.step(np.zeros(2, np.float32))
        assert env.fleet.count == 1
    played.close()
    assert not env.fleet._busy
    with pytest.raises(gymnasium.error.ResetNeeded):
        played.step(np.zeros(2, np.float32))


def test_the_reason_of_a_failing_simulator_is_a_finding():
    with pytest.raises(rtd.UserError, match="step returned 4 values"), pytest.warns(UserWarning):
        rtd.check_env(environment(fault="four", at=2))


def test_actions_of_whole_numbers_are_rounded():
    """A cast alone would send 1 for no action below exactly 1."""
    whole = gymnasium.spaces.Box(-2, 2, (2,), np.int32)
    seen = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    example = SimpleNamespace(action_space=whole, observation_space=seen, spec=None)
    surface = surface_of(example, "whole", None, 5)[0]
    for action, sent in ((0.6, 1), (-0.6, -1), (0.4, 0), (1.99, 2), (9.0, 2)):
        np.testing.assert_array_equal(surface.command(np.full(2, action, np.float32)), sent)


class Shaped(Cart):
    """The reward is that of a function."""

    def __init__(self, shaping):
        super().__init__()
        self.shaping = shaping

    def step(self, action):
        seen, _, _, truncated, info = super().step(action)
        return seen, self.shaping(), False, truncated, info


def shaping():
    """A function that `pickle` stores by its name."""
    return 1.0


def another(reward):
    """A function of the same name, as an edited cell of a notebook defines it."""

    def shaping():
        return reward

    shaping.__qualname__ = "shaping"
    return shaping


@pytest.mark.parametrize("given", [lambda f: f, lambda f: {"by": [f, 2.0]}])
def test_an_edited_function_is_another_environment(monkeypatch, given):
    def make(shaping):
        return Shaped(shaping if callable(shaping) else shaping["by"][0])

    policy, made = rtd.constant_policy([0.1, 0.1]), []
    for reward in (1.0, 2.0):
        monkeypatch.setattr(sys.modules[__name__], "shaping", another(reward))
        made += [
            rtd.from_gymnasium(make, max_steps_in_episode=3, shaping=given(shaping))
            for _ in range(2)
        ]
        assert made[-1] == made[-2] and hash(made[-1]) == hash(made[-2])
        np.testing.assert_array_equal(rtd.evaluate(policy, made[-1], 1), [3.0 * reward])
    assert made[0] != made[2]
    assert simulated_identity(made[0]) == simulated_identity(made[2])  # files know the name only
    close_simulators()


@dataclasses.dataclass(frozen=True)
class Options:
    """Data of an environment, and a function."""

    reward: float
    shaping: object


def test_equal_options_are_the_same_environment(monkeypatch):
    def make(options):
        return Shaped(options.shaping)

    def environment_with(reward):
        options = Options(reward, shaping)
        return rtd.from_gymnasium(make, max_steps_in_episode=3, options=options)

    first, equal, other = map(environment_with, (1.0, 1.0, 2.0))
    assert first == equal and first.fleet is equal.fleet and first != other
    monkeypatch.setattr(sys.modules[__name__], "shaping", another(1.0))
    assert environment_with(1.0) not in (first, other)
    close_simulators()


def made_with(at):
    return lambda: Cart(at=at)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (functools.partial(Cart, at=7), functools.partial(Cart, at=9)),
        (functools.partial(make, at=7), functools.partial(make, at=9)),
        (made_with(7), made_with(9)),
        (lambda: Cart(at=7), lambda: Cart(at=9)),
        (functools.partial(made_with(7)), functools.partial(made_with(9))),
    ],
)
def test_files_know_what_a_function_makes(one, other):
    texts = [simulated_identity(rtd.from_gymnasium(env, keep=[0])) for env in (one, other, one)]
    assert texts[0] != texts[1] and texts[0] == texts[2]
    assert "0x" not in "".join(texts)


def test_files_know_ids_and_classes_by_their_names():
    assert simulated_identity(rtd.from_gymnasium("Pendulum-v1")) == (
        "Pendulum-v1 keep=(0, 1, 2) limit=200"
    )
    assert simulated_identity(rtd.from_gymnasium(Cart, keep=[0], max_steps_in_episode=5)) == (
        "Cart keep=(0,) limit=5"
    )
    # A digest of what `pickle` stores of the keywords.
    assert simulated_identity(rtd.from_gymnasium(Cart, keep=[0], at=3)) == (
        f"Cart keep=(0,) limit=10000 {DIGEST}"
    )


DIGEST = hashlib.sha256(pickle.dumps([("at", 3)])).hexdigest()[:16]


def test_files_know_keywords_that_cannot_be_pickled_by_their_code():
    def made(hook):
        env = rtd.from_gymnasium(Shaped, max_steps_in_episode=3, shaping=hook)
        return env, simulated_identity(env)

    hooks = [(lambda: 1.0) for _ in range(2)]
    (one, text), (other, same) = map(made, hooks)
    assert one != other and text == same  # in this process, each is its own simulators
    assert text != made(lambda: 2.0)[1]
    assert str(id(hooks[0])) not in text and "<lambda> " in text


def test_a_function_that_counts_its_calls_has_one_text():
    number = itertools.count()

    def some():
        return Cart(at=10 + next(number))

    env = rtd.from_gymnasium(some, keep=[0])
    text = simulated_identity(env)
    some()
    assert simulated_identity(env) == text


class Changed(Cart):
    """The class after it was edited."""


def test_an_id_that_is_registered_again_is_another_environment(monkeypatch):
    def register(entry_point):
        spec = EnvSpec("Cart-v0", entry_point, max_episode_steps=12)
        monkeypatch.setitem(gymnasium.registry, "Cart-v0", spec)
        return rtd.from_gymnasium("Cart-v0")

    def plays(env):
        _, state = env.reset(jax.random.key(0), env.default_params)
        simulator = env.fleet._busy[int(state.handle)]
        env.fleet.release(int(state.handle))  # it is free for the next episode
        return type(simulator._env.unwrapped)

    first = register(Cart)
    assert first == rtd.from_gymnasium("Cart-v0") and plays(first) is Cart
    second = register(Changed)
    assert first != second and plays(second) is Changed
    assert simulated_identity(first) == simulated_identity(second)
    third = register(f"{__name__}:Shown")
    assert plays(third) is Cart
    monkeypatch.setattr(sys.modules[__name__], "Shown", Changed)
    fourth = rtd.from_gymnasium("Cart-v0")
    assert third != fourth and plays(fourth) is Changed
    close_simulators()


Shown = Cart


def test_more_episodes_than_simulators_are_played_in_parts(monkeypatch):
    env = rtd.disturb(environment(), rtd.GaussianNoise(0.1))
    fleet, policy = env.base.fleet, rtd.random_policy(env)

    def play():
        close_simulators()
        played = rtd.rollout(policy, env, seed=2, episodes=3)
        return rtd.evaluate(policy, env, 3, seed=2), played.seen, played.actions, played.lengths

    begun = Cart.begun
    whole, once = play(), Cart.begun - begun
    assert fleet.count == 3
    monkeypatch.setattr(simulator, "MOST", 4)  # two for an evaluation, two for lanes beside it
    before, begun = Cart.made, Cart.begun
    for one, other in zip(whole, play(), strict=True):
        np.testing.assert_array_equal(one, other)
    assert fleet.count == Cart.made - before == 2
    assert Cart.begun - begun <= once  # no episode is replayed
    keys = jax.random.split(jax.random.key(0), 5)
    with pytest.raises(rtd.UserError, match="play at most 4 episodes together, not 5: lower"):
        jax.vmap(env.reset, (0, None))(keys, env.default_params)
    close_simulators()
