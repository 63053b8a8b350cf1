"""The rover on soil: against a slow integration, in limits, and as an environment among others."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from soil_oracle import forces, loaded

import rtd3jax as rtd
from rtd3jax.envs.registry import description_of, make
from rtd3jax.envs.rover_soil import DRY_SAND, REGOLITH, Ground, RoverSoil, RoverSoilParams
from rtd3jax.envs.rover_soil.controllers import adaptive_slip
from rtd3jax.envs.rover_soil.environment import Motion, drive, sides, wheel_load
from rtd3jax.envs.rover_soil.registration import GROUNDS
from rtd3jax.envs.rover_soil.soil import local_soil
from rtd3jax.errors import UserError

STEPS = 60


def roll(env, actions, keys):
    """Episodes without reset: observations [E, T, 2], rewards [E, T], states [E, T, ...]."""
    return _rolled(env, env.default_params, jnp.asarray(actions, jnp.float32), keys)


def _roll(env, params, actions, keys):
    def episode(key):
        _, state = env.reset_env(key, params)

        def body(state, action):
            observation, state, reward, _, _ = env.step_env(key, state, action, params)
            return state, (observation, reward, state.replace(ground=()))

        return jax.lax.scan(body, state, actions)[1]

    return jax.vmap(episode)(keys)


_rolled = jax.jit(_roll, static_argnums=0)
AHEAD = np.tile([0.5, 0.0], (STEPS, 1))


def keys(count=8, seed=0):
    return jax.random.split(jax.random.key(seed), count)


def slow_drive(params, soil, slope, start, command, substeps=2_000):
    """The same step by explicit Euler in float64, with the sinkage solved in each."""
    radius, width = params.wheel_radius, params.wheel_width
    load = 0.5 * params.mass * params.gravity * np.cos(slope)
    hub, rim = np.array(start.hub, np.float64), np.array(start.rim, np.float64)
    seconds = params.step_seconds / substeps
    table = np.linspace(0.0, 1.0, 41)
    rows = np.array([loaded(soil, radius, width, load, s, 801)[1:] for s in table])
    for _ in range(substeps):
        slip = (rim - hub) / np.maximum(rim, hub)
        pull, torque = (np.interp(slip, table, rows[:, k]) for k in (0, 1))
        motor = np.clip(params.motor_gain * (command - rim) / radius, -10.0, 10.0)
        force = pull.sum() / params.mass - params.gravity * np.sin(slope)
        turn = (pull[1] - pull[0]) * params.wheelbase / (2 * params.yaw_inertia)
        hub = hub + seconds * (force + np.array([-1, 1]) * turn * params.wheelbase / 2)
        rim = rim + seconds * radius / params.wheel_inertia * (motor - torque)
    return hub, rim


@pytest.mark.parametrize("soil", [DRY_SAND, REGOLITH], ids=["sand", "regolith"])
def test_a_step_is_the_slow_integrations(soil):
    params = RoverSoilParams()
    local = local_soil(soil, params.wheel_width)
    local = jax.tree.map(lambda part: jnp.broadcast_to(part, (2,)), local)
    slope = np.radians(2.0)
    depth = loaded(soil, 0.15735, 0.165, 80.0, 0.2)[0]
    entry = np.full(2, np.arccos(1 - depth / 0.15735))
    start = Motion(*(jnp.asarray(x, jnp.float32) for x in ([0.4, 0.45], [0.5, 0.55], entry)))
    command = np.array([0.55, 0.75])
    found = jax.jit(drive)(params, local, jnp.float32(slope), start, jnp.float32(command))
    hub, rim = slow_drive(params, soil, slope, start, command)
    # First order in substeps of 25 ms, while the speeds change by a third.
    np.testing.assert_allclose(found.hub, hub, atol=0.01)
    np.testing.assert_allclose(found.rim, rim, atol=0.003)


@jax.jit
def thirty_steps(soil, slope, start, command):
    def step(_, motion):
        return drive(RoverSoilParams(), soil, slope, motion, command)

    return jax.lax.fori_loop(0, 30, step, start)


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_a_steady_drive_is_the_wheels_equilibrium(degrees):
    """Each wheel pulls what gravity pulls back, and its motor bears the soil's torque."""
    params = RoverSoilParams()
    soil = jax.tree.map(lambda part: jnp.broadcast_to(part, (2,)), local_soil(REGOLITH, 0.165))
    slope = jnp.float32(np.radians(degrees))
    start = Motion(jnp.zeros(2), jnp.zeros(2), jnp.full((2,), 0.4, jnp.float32))
    motion = thirty_steps(soil, slope, start, jnp.array([0.6, 0.6], jnp.float32))
    slip = float(1 - motion.hub[0] / motion.rim[0])
    load = float(wheel_load(params, slope)[0])
    entry = float(motion.entry[0])
    vertical, pull, torque = forces(REGOLITH, 0.15735, 0.165, entry, slip)
    assert vertical == pytest.approx(load, rel=1e-3)
    weight = params.mass * params.gravity / 2
    assert pull == pytest.approx(weight * np.sin(np.radians(degrees)), abs=1e-3 * weight)
    held = params.motor_gain * (0.6 - float(motion.rim[0])) / params.wheel_radius
    assert torque == pytest.approx(held, rel=1e-2)


def mean_slip(ground, actions=AHEAD):
    _, _, states = roll(RoverSoil(RoverSoilParams(ground=ground)), actions, keys())
    return np.asarray(states.slip)[:, 20:].mean()


def constant_slope(degrees):
    """Fields of infinite length: the same slope everywhere, drawn per episode."""
    return Ground(REGOLITH, REGOLITH, variation=0.0, slope=degrees, slope_length=1e6)


def test_slip_rises_uphill_and_falls_downhill():
    env = RoverSoil(RoverSoilParams(ground=constant_slope(5.0)))
    many = keys()
    _, _, states = roll(env, AHEAD, many)
    slip = np.asarray(states.slip)[:, -1].mean(axis=1)

    def ahead(key, ground):
        start, zero = ground.init(key, 1, 2), jnp.float32(0.0)
        return ground.at(start, jnp.zeros((2, 2)), zero, jnp.float32(0.165))[1]

    slopes = jax.jit(jax.vmap(ahead, (0, None)))(many, env.default_params.ground)
    order = np.argsort(np.asarray(slopes))
    assert (np.diff(slip[order]) > -1e-3).all()
    assert slip[order][0] < 0 < slip[order][-1]


def test_sand_slips_more_than_regolith_and_a_mixture_lies_between():
    sand, mixed, regolith = (mean_slip(GROUNDS[n]) for n in ("dry-sand", "mixed", "regolith"))
    assert 0.0 < regolith < 0.03 < mixed < 0.12 < sand < 0.3


def test_the_rover_turns_as_commanded_and_backs_off():
    env = make("rover-soil", "regolith", variation=0.0)
    turn, _, states = roll(env, np.tile([0.3, 0.5], (STEPS, 1)), keys())
    assert 0.4 < float(turn[0, -1, 1]) < 0.5 and float(states.heading[0, -1]) > 4.0
    back, _, states = roll(env, np.tile([-0.5, 0.0], (STEPS, 1)), keys())
    assert -0.5 < float(back[0, -1, 0]) + 0.5 < -0.45
    ahead, _, _ = roll(env, AHEAD, keys())
    np.testing.assert_allclose(back[..., 0] + 0.5, -(ahead[..., 0] + 0.5), atol=1e-4)


def test_a_rover_at_rest_stays_and_on_a_slope_it_creeps():
    still = np.zeros((STEPS, 2))
    _, _, states = roll(make("rover-soil", "regolith"), still, keys())
    np.testing.assert_allclose(states.speed, 0.0, atol=1e-5)
    env = RoverSoil(RoverSoilParams(ground=constant_slope(5.0)))
    _, _, states = roll(env, still, keys())
    assert np.abs(states.speed).max() < 0.05


def test_random_commands_keep_every_number_finite():
    env = make("rover-soil", "mixed-slope", slope=8.0, variation=2.0)
    wild = np.random.default_rng(0).uniform(-3, 3, (STEPS, 2))
    observations, rewards, states = roll(env, wild, keys())
    assert all(np.isfinite(np.asarray(x)).all() for x in jax.tree.leaves(states))
    np.testing.assert_allclose(rewards, -np.sum(np.asarray(observations) ** 2, -1), rtol=1e-5)
    assert np.abs(states.slip).max() <= 1.0 and np.abs(observations).max() < 5.0


def test_vmapped_is_looped_and_the_same_key_gives_the_same_bits():
    env, many = make("rover-soil", "mixed-slope"), keys(3)
    together, again = roll(env, AHEAD, many), roll(env, AHEAD, many)
    for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    for k in range(3):
        alone = roll(env, AHEAD, many[k : k + 1])
        for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(np.asarray(one)[k], np.asarray(other)[0], atol=2e-5)


def test_float64_gives_the_same_drive():
    env, few = make("rover-soil", "mixed-slope"), keys()
    single = roll(env, AHEAD, few)[0]
    params = RoverSoilParams()
    local = jax.tree.map(lambda x: np.broadcast_to(x, (2,)), local_soil(DRY_SAND, 0.165))
    start = Motion(np.array([0.3, 0.4]), np.array([0.4, 0.5]), np.array([0.4, 0.4]))
    command = np.asarray(sides(jnp.float32(0.5), jnp.float32(0.1), jnp.float32(0.5)))

    def as_type(dtype):
        return jax.tree.map(lambda x: jnp.asarray(x, dtype), (local, start, command))

    soil, begin, wanted = as_type(jnp.float32)
    narrow = drive(params, soil, jnp.float32(0.02), begin, wanted)
    with jax.enable_x64(True):
        soil, begin, wanted = as_type(jnp.float64)
        wide = drive(params, soil, jnp.float64(0.02), begin, wanted)
    assert wide.hub.dtype == jnp.float64 and np.isfinite(single).all()
    for one, other in zip(narrow, wide, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


@pytest.mark.parametrize(
    "name",
    [
        "mixed-slope",
        *(
            pytest.param(n, marks=pytest.mark.slow)
            for n in ("none", *GROUNDS)
            if n != "mixed-slope"
        ),
    ],
)
def test_every_ground_passes_the_check(name):
    env = make("rover-soil", name)
    rtd.check_env(env)


def test_it_is_the_rover_to_a_policy():
    soil, rover = make("rover-soil", "dry-sand"), make("rover", "ar1-slip")
    for env in (soil, rover):
        assert env.default_params.max_steps_in_episode == 200
    own, its = (env.action_space(env.default_params) for env in (soil, rover))
    np.testing.assert_array_equal(own.low, its.low)
    np.testing.assert_array_equal(own.high, its.high)
    first, _ = soil.reset(jax.random.key(0))
    np.testing.assert_array_equal(first, rover.reset(jax.random.key(0))[0])
    policy = rtd.bayes_policy(rover)
    returns = np.asarray(rtd.evaluate(policy, soil, 4, 0))
    assert returns.shape == (4,) and (returns < 0).all() and (returns > -40).all()


def test_it_composes_with_faults_and_sensor_processes():
    env = make("rover-soil", "mixed-slope+dropout", p=0.2)
    assert env.default_params.env.ground.slope == 2.0
    assert env.default_params.observation == rtd.Dropout(p=0.2)
    first, _ = env.reset(jax.random.key(0))
    assert first.shape == (2,)
    assert make("rover-soil", "dry-sand", slope=1.0).default_params.ground.slope == 1.0


@pytest.mark.slow
def test_with_a_fault_it_passes_the_check():
    rtd.check_env(make("rover-soil", "mixed-slope+dropout", p=0.2))


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda: make("rover-soil", "dry-sand+regolith"), "its ground is one Ground, not a Chain"),
        (lambda: make("rover-soil", "dry-sand", mass=0.0), "mass=0.0 must be greater than 0"),
        (lambda: make("rover-soil", "dry-sand", mass=5000.0), "sinks deeper than its radius"),
        (lambda: make("rover-soil", "dry-sand", variation=9.0), "variation=9.0 must be at most 2"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(call, said):
    with pytest.raises(UserError) as caught:
        call()
    assert said in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.slow
def test_baselines_beat_the_constant_command():
    env = make("rover-soil", "dry-sand")
    means = {}
    for name, make_one in description_of(env, "rover-soil").baselines.items():
        made = make_one(env)
        policy = rtd.constant_policy(made) if isinstance(made, tuple) else made
        means[name] = float(np.mean(rtd.evaluate(policy, env, 64, 3)))
    assert set(means) == {"constant", "feedforward-pi", "adaptive-slip"}
    assert means["constant"] < min(means["adaptive-slip"], means["feedforward-pi"])


def test_the_adaptive_controller_finds_a_constant_slip():
    """On wheels that slip by a fifth and a third it commands what is left to command."""
    policy = adaptive_slip(make("rover-soil", "dry-sand"))
    state, observation = policy.init(), jnp.array([-0.5, 0.0], jnp.float32)
    step = jax.jit(policy.step)
    for _ in range(60):
        action, state = step(state, observation)
        rims = sides(action[0], action[1], jnp.float32(0.5))
        hubs = rims * jnp.array([0.8, 2 / 3], jnp.float32)
        errors = [0.5 * (hubs[0] + hubs[1]) - 0.5, (hubs[1] - hubs[0]) / 0.5]
        observation = jnp.stack(errors)
    np.testing.assert_allclose(observation, 0.0, atol=1e-4)
    np.testing.assert_allclose(state.slip, [0.2, 1 / 3], atol=1e-4)


def test_the_adaptive_controller_forgets_a_slip_beyond_its_limits():
    """At the limit of the speed, it measures against what the rover drives and not what it wants.

    With a slip of 0.6, a speed of 0.5 m/s would need 1.25 m/s, and 1 m/s are allowed.
    """
    policy = adaptive_slip(make("rover-soil", "dry-sand"))
    state, observation = policy.init(), jnp.array([-0.5, 0.0], jnp.float32)
    step = jax.jit(policy.step)
    for _ in range(60):
        action, state = step(state, observation)
        hub = 0.4 * jnp.clip(action[0], -1.0, 1.0)
        observation = jnp.stack([hub - 0.5, jnp.float32(0.0)])
    np.testing.assert_allclose(action, [1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(state.slip, 0.6, atol=1e-4)


def test_parameters_that_are_given_later_are_checked_too():
    env = make("rover-soil", "dry-sand")
    heavy = env.default_params.replace(mass=5000.0)
    with pytest.raises(UserError, match="sinks deeper than its radius"):
        rtd.evaluate(rtd.constant_policy([0.5, 0.0]), env, 1, params=heavy)


def test_controllers_have_nothing_to_say_where_an_error_is_hidden():
    env = rtd.disturb(make("rover-soil", "dry-sand"), rtd.Hidden(element=1))
    baselines = description_of(env, "rover-soil").baselines
    assert baselines["adaptive-slip"](env) is None and baselines["feedforward-pi"](env) is None
    assert baselines["constant"](env) == (0.5, 0.0)
