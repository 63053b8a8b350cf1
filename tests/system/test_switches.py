"""Tests of JAX's switches: each works, or is refused with one line."""

import dataclasses
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rtd3jax as rtd
from rtd3jax.envs.interface import foreign_code
from rtd3jax.training import executables
from rtd3jax.training.jobs import make_jobs

WORKING = [
    *("JAX_DEBUG_NANS=1", "JAX_DEBUG_INFS=1", "JAX_ENABLE_X64=1", "JAX_CHECK_TRACER_LEAKS=1"),
    *("JAX_NUMPY_RANK_PROMOTION=raise", "JAX_NUMPY_DTYPE_PROMOTION=strict"),
    *("JAX_DEFAULT_MATMUL_PRECISION=highest", "JAX_DEFAULT_MATMUL_PRECISION=bfloat16"),
    *("JAX_DEFAULT_PRNG_IMPL=rbg", "JAX_THREEFRY_PARTITIONABLE=0", "JAX_LOG_COMPILES=1"),
    *("JAX_EXPLAIN_CACHE_MISSES=1", "JAX_PLATFORMS=cpu", "JAX_DEFAULT_DEVICE=cpu"),
]

TINY = dict(
    total_steps=40,
    hidden_size=4,
    batch_size=4,
    learning_starts=10,
    eval_every=20,
    eval_episodes=1,
)

EVERYTHING = (
    f"""
tiny = {TINY!r}
"""
    + """
import sys
import numpy as np
import rtd3jax as rtd
from rtd3jax import sweep
from rtd3jax.study import references

references.EPISODES = 2
env = rtd.make("rover", "ar1-slip")
run = rtd.train(env, rtd.Config("h-td3", history_length=2, **tiny), [0], progress=False)
assert not run.failures and np.isfinite(run.returns).all()
rtd.evaluate(run.policy(0), env, episodes=2)
action, _ = run.policy(0).step(run.policy(0).init(), np.zeros(2, np.float32))
assert np.isfinite(action).all()
rtd.check_env(env)
environment = rtd.to_gymnasium(env)
environment.reset(seed=0)
environment.step(environment.action_space.sample())
command = "--env rover --disturbances ar1-slip --algorithms td3 --seeds 1 --final-episodes 2"
flags = [f"--{name.replace('_', '-')}={value}" for name, value in tiny.items()]
sys.exit(sweep.main([*command.split(), *flags, "--quiet", "--no-report", "--out", sys.argv[1]]))
"""
)


def with_switch(switch, code, *arguments):
    name, value = switch.split("=")
    cache = jax.config.jax_compilation_cache_dir
    return subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *map(str, arguments)],
        env={**os.environ, "JAX_COMPILATION_CACHE_DIR": cache, name: value},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize("switch", WORKING)
def test_everything_works_under_it(switch, tmp_path):
    done = with_switch(switch, EVERYTHING, tmp_path / "run")
    assert done.returncode == 0, done.stderr[-2000:]


def wide(tree):
    """Floats of more than 32 bits in it."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return [jax.tree_util.keystr(path) for path, leaf in leaves if leaf.dtype == np.float64]


@pytest.mark.parametrize("env_id", rtd.ENVIRONMENTS)
def test_environments_stay_in_single_precision_where_double_is_allowed(env_id):
    with jax.enable_x64(True):
        for disturbance in rtd.DISTURBANCES[env_id]:
            env = rtd.make(env_id, disturbance)
            params, action = env.default_params, jnp.zeros(env.num_actions, jnp.float32)
            with foreign_code():
                first, state = jax.eval_shape(env.reset, jax.random.key(0), params)
                seen, after, reward, *_ = jax.eval_shape(
                    env.step, jax.random.key(0), state, action, params
                )
            assert wide((first, state, seen, after, reward)) == [], disturbance
            types = [[leaf.dtype for leaf in jax.tree.leaves(s)] for s in (state, after)]
            assert types[0] == types[1], disturbance


@pytest.mark.parametrize("algorithm", rtd.ALGORITHMS)
def test_agents_are_trained_in_single_precision_where_double_is_allowed(algorithm):
    length = None if algorithm == "td3" else 2
    config = rtd.Config(algorithm, length, normalise_observations=True, **TINY)
    with jax.enable_x64(True):
        (job,) = make_jobs(rtd.make("pendulum", "random-sine"), config, [0])
        step = jax.ShapeDtypeStruct((), jnp.int32)
        state = jax.eval_shape(job.program.init, job.lane)
        after = jax.eval_shape(job.program.advance, job.lane, state, step, step)
    assert wide(state) == wide(after) == []


def test_a_platform_that_is_not_there_is_named_with_the_remedy():
    done = with_switch("JAX_PLATFORMS=tpu", "import rtd3jax")
    last = done.stderr.splitlines()[-1]
    assert "UserError: JAX finds no device with JAX_PLATFORMS=tpu" in last and "unset it" in last


def test_a_transfer_guard_is_refused_but_does_not_hinder_the_import():
    code = "import sys; from rtd3jax import sweep; sys.exit(sweep.main(['--env', 'rover']))"
    done = with_switch("JAX_TRANSFER_GUARD=disallow", code)
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert done.stderr.startswith("error: JAX_TRANSFER_GUARD forbids transfers that rtd3jax needs")


@pytest.mark.parametrize(
    "guard",
    [jax.transfer_guard, jax.transfer_guard_host_to_device, jax.transfer_guard_device_to_host],
)
def test_every_direction_of_the_guard_is_seen(guard):
    for level, refused in (("disallow", True), ("disallow_explicit", True), ("allow", False)):
        with guard(level):
            (finding,) = rtd.find_problems(object())
        assert ("TRANSFER_GUARD" in finding.problem) == refused


def test_without_jit_an_environment_can_be_looked_into_and_not_trained_on():
    env = rtd.make("rover", "ar1-slip", max_steps_in_episode=2)
    compiled = rtd.evaluate(rtd.random_policy(env), env, episodes=2)
    with jax.disable_jit():
        with pytest.raises(rtd.UserError, match="training cannot run with JAX_DISABLE_JIT"):
            rtd.train(env, rtd.Config("td3"), [0])
        looked_into = rtd.evaluate(rtd.random_policy(env), env, episodes=2)
    np.testing.assert_allclose(looked_into, compiled, rtol=1e-5)


def lowered(program, lane):
    state = jax.eval_shape(program.init, lane)
    step = jnp.int32(0)
    return jax.jit(program.advance).lower(lane, state, step, step).as_text()


def test_a_context_of_the_caller_reaches_the_threads_that_compile(monkeypatch):
    """JAX's contexts act in one thread only; executables of other settings are not used."""
    seen, real = [], executables._compile

    def compiled(program, lane, batched, device):
        seen.append("HIGHEST" in lowered(program, lane))
        return real(program, lane, batched, device)

    monkeypatch.setattr(executables, "_programs", {})
    monkeypatch.setattr(executables, "_compile", compiled)
    env, config = rtd.make("rover", "ar1-slip"), rtd.Config("td3", **TINY)

    def train():
        return rtd.train(env, config, [0], progress=False).returns

    plain = train()
    with jax.default_matmul_precision("highest"):
        train()
    np.testing.assert_array_equal(train(), plain)
    assert seen == [False, True]


def test_a_generator_that_depends_on_the_company_of_a_lane_is_not_used():
    env, config = rtd.make("rover", "ar1-slip"), rtd.Config("td3", **TINY)

    def train(seeds):
        return rtd.train(env, config, seeds, progress=False, strategy="vmap").returns

    usual = train([0, 1, 2])
    with jax.default_prng_impl("unsafe_rbg"):
        np.testing.assert_allclose(train([2, 0, 1])[[1, 2, 0]], usual, rtol=1e-5)
        policy = rtd.random_policy(env)
        returns = rtd.evaluate(policy, env, episodes=3)
    np.testing.assert_array_equal(rtd.evaluate(policy, env, episodes=3), returns)


def test_a_training_does_not_continue_with_other_settings(tmp_path, monkeypatch):
    env, config = rtd.make("rover", "ar1-slip"), rtd.Config("td3", **TINY)

    def train(steps):
        longer = dataclasses.replace(config, total_steps=steps)
        return rtd.train(env, longer, [0], progress=False, checkpoint_dir=tmp_path)

    train(40)
    with jax.threefry_partitionable(False), pytest.raises(rtd.UserError) as raised:
        train(80)
    assert "settings (jax_threefry_partitionable: None there, False here)" in str(raised.value)
    assert not train(80).failures


@pytest.mark.parametrize(
    ("env_id", "disturbance"),
    [
        ("pendulum", "random-sine"),
        ("pendulum", "noise+dropout+gain-drift"),
        ("pendulum", "noise/ornstein-uhlenbeck"),
        ("pendulum", "temporal-bias"),
        ("rover", "ar1-slip"),
        ("rover", "sine-slip+action-delay"),
        ("rover-soil", "mixed-slope"),
    ],
)
def test_no_environment_uses_a_key_twice(env_id, disturbance):
    env, key = rtd.make(env_id, disturbance), jax.random.key(0)
    action = jnp.zeros(env.num_actions, jnp.float32)
    with jax.debug_key_reuse(True):
        _, state = jax.jit(env.reset)(key, env.default_params)
        jax.jit(env.step)(jax.random.key(1), state, action, env.default_params)
