"""Compares controllers with oracles in numpy and scipy, and tests them on the plants."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import rtd3jax as rtd
from rtd3jax.envs.controllers import riccati_gain
from rtd3jax.envs.pendulum.environment import PendulumState
from rtd3jax.envs.pendulum.swing_up import swing_up_policy
from rtd3jax.envs.rover.registration import feedforward_pi
from rtd3jax.study import references


def top(**changed):
    zero = jnp.zeros((), jnp.float32)
    state = PendulumState(theta=zero, theta_dot=zero, last_u=zero, time=jnp.int32(0))
    return state.replace(**{name: jnp.float32(value) for name, value in changed.items()})


def play(policy, observations):
    """Actions [T, A] for ``observations`` [T, O]."""
    state, actions = policy.init(), []
    for observation in observations:
        action, state = policy.step(state, jnp.asarray(observation, jnp.float32))
        actions.append(np.asarray(action))
    return np.array(actions)


def test_a_function_plays_like_any_policy():
    def proportional(last, observation):
        """Half the last command, and half of what would be right."""
        command = 0.5 * last + 0.5 * jnp.stack([0.5 - observation[0], 0.0])
        return command, command

    env = rtd.make("rover", "ar1-slip", max_steps_in_episode=20)
    policy = rtd.function_policy(proportional, np.zeros(2))
    played = rtd.rollout(policy, env, seed=2)
    last = np.zeros(2)
    for seen, action in zip(played.seen[0], played.actions[0], strict=False):
        last = 0.5 * last + 0.5 * np.array([0.5 - seen[0], 0.0])
        np.testing.assert_allclose(action, last, atol=1e-6)
    np.testing.assert_allclose(rtd.evaluate(policy, env, 1, 2), played.returns, rtol=1e-5)


def test_a_function_keeps_the_types_of_its_state():
    env = rtd.make("pendulum", max_steps_in_episode=3)
    for start, one in ((0, 1), (0.0, 1), (np.float32(0.0), 1.0)):
        count = rtd.function_policy(lambda n, _, one=one: (n * 1.0, n + one), start)
        np.testing.assert_array_equal(rtd.rollout(count, env).actions[0, :, 0], [0, 1, 2])


def branching(state, observation):
    return (1.0 if observation[0] > 0 else -1.0), state


@pytest.mark.parametrize(
    ("function", "match"),
    [
        (branching, "branching cannot be compiled: use jnp.where"),
        (lambda s, o: np.sin(np.asarray(o)[:1]), "cannot be compiled"),
        (lambda s, o: o[:1], r"must return \(action, state\), not "),
        (lambda s, o: (o[:1], (s, s)), "must return a state of the same shapes"),
        (lambda s, o: (o[:1], jnp.zeros(3)), r"same shapes as its argument: \(\), not \(3,\)"),
        (lambda s, o: (o[:2], s), r"action has shape \(2,\), the environment's \(1,\)"),
    ],
)
def test_what_a_function_does_wrong_is_one_line(function, match):
    with pytest.raises(rtd.UserError, match=match) as caught:
        rtd.evaluate(rtd.function_policy(function, 0.0), rtd.make("pendulum"), episodes=1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("start", [0, False, {"sum": np.int32(0)}])
def test_an_integer_state_that_would_lose_fractions_is_refused(start):
    def integrate(state, observation):
        return observation[:1], jax.tree.map(lambda part: part + 0.1 * observation[0], state)

    with pytest.raises(rtd.UserError, match="lose its fractions: begin with a float") as caught:
        rtd.evaluate(rtd.function_policy(integrate, start), rtd.make("pendulum"), episodes=1)
    assert "\n" not in str(caught.value)


def test_what_is_no_function_or_no_state_is_one_line():
    with pytest.raises(rtd.UserError, match="needs a function, not 3"):
        rtd.function_policy(3)
    with pytest.raises(rtd.UserError, match="state of a function_policy holds arrays"):
        rtd.function_policy(branching, {"mode": "swing"})


def test_pid_is_its_equation():
    env = rtd.make("rover", "ar1-slip")
    kp, ki, kd, setpoint = np.array([0.3, 0.1]), 0.5, np.array([0.0, 0.02]), np.array([0.1, 0.0])
    forward = np.array([0.4, 0.05])
    policy = rtd.pid_policy(
        env, kp, ki, kd, setpoint=setpoint, feedforward=forward, seconds=0.1, ignored=1
    )
    seen = np.random.default_rng(0).uniform(-0.3, 0.3, (12, 2))
    errors = setpoint - seen
    errors[0] = 0.0
    changes = np.diff(errors, axis=0, prepend=0.0) / 0.1
    changes[:2] = 0.0
    expected = forward + kp * errors + ki * 0.1 * np.cumsum(errors, axis=0) + kd * changes
    np.testing.assert_allclose(play(policy, seen), expected, atol=1e-5)


def test_pid_heeds_the_elements_that_it_is_given():
    env = rtd.make("pendulum")
    actions = play(rtd.pid_policy(env, 0.5, elements=(2,)), [[1, 0, 3], [1, 0, -2]])
    np.testing.assert_allclose(actions, [[-1.5], [1.0]])


@pytest.mark.parametrize("sign", [1, -1])
def test_the_integral_does_not_wind_up(sign):
    """After long at the bound it leaves it as soon as the error turns."""
    policy = rtd.pid_policy(rtd.make("pendulum"), ki=0.5 * sign, elements=(2,))
    errors = [-1.0] * 50 + [1.0] * 3
    actions = play(policy, [[1, 0, sign * error] for error in errors])[:, 0]
    np.testing.assert_allclose(actions[[2, 3, 49]], [1.5, 2.0, 2.0])
    np.testing.assert_allclose(actions[50:], [1.5, 1.0, 0.5])


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"kp": [1.0, 2.0, 3.0]}, "kp must be a finite number or 2 of them"),
        ({"ki": np.nan}, "ki must be a finite number or 2 of them, not nan"),
        ({"kd": "much"}, "kd must be numbers, not 'much'"),
        ({"elements": (0, 2)}, "elements must be 2 integers from 0 to 1"),
        ({"elements": (0,)}, "elements must be 2 integers from 0 to 1"),
        ({"elements": 1}, "elements must be 2 integers from 0 to 1, not 1"),
        ({"elements": (0.0, 1.0)}, "elements must be 2 integers from 0 to 1"),
        ({"elements": (False, True)}, "elements must be 2 integers from 0 to 1"),
        ({"elements": ((0,), 1)}, "elements must be 2 integers from 0 to 1"),
        ({"seconds": 0}, "seconds must be greater than 0, not 0"),
        ({"seconds": "1"}, "seconds must be greater than 0, not '1'"),
        ({"seconds": None}, "seconds must be greater than 0, not None"),
        ({"ignored": -1}, "ignored must be an integer of at least 0, not -1"),
    ],
)
def test_gains_that_make_no_sense_are_one_line(arguments, match):
    with pytest.raises(rtd.UserError, match=match):
        rtd.pid_policy(rtd.make("rover"), **arguments)


def test_the_regulator_is_the_textbooks():
    """The pendulum at the top by hand, and scipy's solution of the Riccati equation."""
    a = np.array([[1 + 15 * 0.05**2, 0.05], [15 * 0.05, 1.0]])
    b = np.array([[3 * 0.05**2], [3 * 0.05]])
    for q, r in ((None, None), ([4.0, 0.5, 0.0], 0.2)):
        cost_x, cost_u = (np.diag([1.0, 0.1]), 0.001) if q is None else (np.diag(q[:2]), r)
        value = solve_discrete_are(a, b, cost_x, np.array([[cost_u]]))
        gain = np.linalg.solve(cost_u + b.T @ value @ b, b.T @ value @ a)[0]
        policy = rtd.lqr_policy(rtd.make("pendulum"), top(), q=q, r=r)
        np.testing.assert_allclose(policy.gain[0], [0, *gain], rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(policy.at, [1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(play(policy, [[1, 0.01, 0]])[0, 0], -0.01 * gain[0], rtol=1e-3)


def test_riccati_with_a_cross_term_is_scipys():
    chance = np.random.default_rng(1)
    a, b, root = (chance.normal(size=shape) for shape in ((4, 4), (4, 2), (6, 6)))
    cost = root @ root.T
    q, r, cross = cost[:4, :4], cost[4:, 4:], cost[:4, 4:]
    value = solve_discrete_are(a, b, q, r, s=cross)
    expected = np.linalg.solve(r + b.T @ value @ b, b.T @ value @ a + cross.T)
    np.testing.assert_allclose(riccati_gain(a, b, q, r, cross), expected, rtol=1e-6, atol=1e-8)


def test_the_regulator_holds_the_pendulum():
    env = rtd.make("pendulum", "temporal-bias")
    _, state = env.reset(jax.random.key(0))
    policy = rtd.lqr_policy(env, state.replace(env=top()))
    plain = rtd.make("pendulum").base
    state, observation = top(theta=0.2), jnp.array([np.cos(0.2), np.sin(0.2), 0.0])
    for _ in range(60):
        action, _ = policy.step((), observation)
        observation, state, *_ = plain.step(jax.random.key(1), state, action)
    assert abs(float(state.theta)) < 1e-3


@pytest.mark.parametrize(
    ("disturbance", "state", "arguments", "match"),
    [
        ("none", {"theta": 0.4}, {}, "needs an equilibrium: theta changes by"),
        ("hidden", {}, {}, "observation does not determine theta_dot"),
        ("none", {}, {"q": [1.0, 1.0, 0.0]}, "pass both q and r"),
        ("none", {}, {"q": [1.0, 1.0], "r": 1.0}, r"q must have shape \(3,\) or \(3, 3\)"),
        ("none", {}, {"q": [-1.0, 0.0, 0.0], "r": 1.0}, "a cost that is not negative"),
        ("none", {}, {"q": [1.0, 0.0, 0.0], "r": 0.0}, "a positive cost of the action"),
    ],
)
def test_a_regulator_that_cannot_be_is_one_line(disturbance, state, arguments, match):
    with pytest.raises(rtd.UserError, match=match) as caught:
        rtd.lqr_policy(rtd.make("pendulum", disturbance), top(**state), **arguments)
    assert "\n" not in str(caught.value)


def test_another_environments_state_is_one_line():
    with pytest.raises(rtd.UserError, match="rover could not be linearised"):
        rtd.lqr_policy(rtd.make("rover"), top())


def test_a_regulator_sees_the_gradients_of_a_rover():
    env, command = rtd.make("rover"), jnp.array([0.5, 0.0])
    _, state, *_ = env.step(jax.random.key(0), env.reset(jax.random.key(0))[1], command)
    policy = rtd.lqr_policy(env, state, command)
    np.testing.assert_allclose(policy.gain, 0.0, atol=1e-6)  # a rover does at once what it is told
    assert float(rtd.evaluate(policy, env, 1)[0]) == pytest.approx(0.0, abs=1e-6)


def test_a_regulator_names_what_it_cannot_know_of_a_rover_on_soil():
    env, command = rtd.make("rover-soil", max_steps_in_episode=60), jnp.array([0.5, 0.0])
    _, state = env.reset(jax.random.key(0))
    for _ in range(50):
        _, state, *_ = env.step(jax.random.key(0), state, command)
    leaves = jax.tree_util.tree_leaves_with_path(state)
    sizes = [(path[0].name, leaf.size) for path, leaf in leaves if leaf.dtype == jnp.float32]
    cost = [np.full(n, float(name in ("speed", "yaw_rate"))) for name, n in sizes]
    with pytest.raises(rtd.UserError, match="the observation does not determine"):
        rtd.lqr_policy(env, state, command, q=np.concatenate(cost), r=0.1)


def test_the_rovers_controller_is_near_the_best():
    env = rtd.make("rover", "ar1-slip")
    mean = float(rtd.evaluate(feedforward_pi(env), env, 1_000, 0).mean())
    assert -1.45 < mean < -1.2, "the ceiling is -1.20, the constant command has -5.3"


def test_the_pendulums_controller_swings_it_up():
    env = rtd.make("pendulum")
    played = rtd.rollout(swing_up_policy(env), env, seed=0, episodes=200)
    assert played.true[:, -60:, 0].min() > 0.99, "every episode ends at the top"
    assert -160 < played.returns.mean() < -135
    hidden = rtd.make("pendulum", "hidden")
    assert rtd.evaluate(swing_up_policy(hidden), hidden, 200, 0).mean() > -170


def test_a_baseline_that_has_nothing_to_say_is_left_out():
    assert swing_up_policy(rtd.make("pendulum", "hidden", element=1)) is None
    assert feedforward_pi(rtd.disturb(rtd.make("rover"), rtd.Hidden(element=0))) is None
    for which, expected in (("hidden", ["random", "swing-up"]), ("hidden:element=0", ["random"])):
        cell = rtd.Cell("pendulum", which, rtd.Config(algorithm="td3"))
        assert [row.name for row in references.references_on(cell)] == expected
