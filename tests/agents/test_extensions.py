"""Tests of user extensions: an agent, a memory and a learner are trained, swept and exported."""

import dataclasses

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from flax import struct

import rtd3jax as rtd
from rtd3jax import report, sweep
from rtd3jax.agents.learners.base import measured
from rtd3jax.agents.networks import act, apply_network, init_network
from rtd3jax.training.jobs import make_jobs

TINY = dict(
    history_length=2,
    total_steps=60,
    hidden_size=8,
    batch_size=8,
    learning_starts=20,
    eval_every=30,
    eval_episodes=1,
)


class EchoMemory(rtd.Memory):
    """A leaky average of its tokens."""

    def setup(self):
        self.rate = self.param("rate", lambda key: jnp.zeros((self.width,)))

    def zero(self, batch):
        return jnp.zeros((batch, self.width))

    def step(self, carry, token):
        rate = jax.nn.sigmoid(self.rate)[None, :]
        return carry + rate * (token - carry)


class TanhEncoder(nn.Module):
    inputs: int
    outputs: int

    @nn.compact
    def __call__(self, x):
        return nn.tanh(nn.Dense(self.outputs)(x))


@struct.dataclass
class DdpgState:
    actor: dict
    critic: dict
    optimizer: optax.OptState


@dataclasses.dataclass(frozen=True)
class Ddpg:
    """Deterministic policy gradients with one critic and no target networks."""

    metrics = ("critic_loss",)
    adam = optax.scale_by_adam()

    def init(self, key, networks):
        actor_key, critic_key = jax.random.split(key)
        actor = init_network(actor_key, networks.actor)
        critic = init_network(critic_key, networks.critic)
        return DdpgState(actor, critic, self.adam.init((actor, critic)))

    def update(self, networks, state, batch, keys, numbers, count):
        def value(critic, window, action):
            return apply_network(networks.critic, critic, window, action)[:, 0]

        after = act(networks.actor, state.actor, batch.next_window)
        bootstrap = value(state.critic, batch.next_window, after)
        y = batch.reward + numbers.gamma * jnp.where(batch.terminated, 0.0, bootstrap)

        def losses(params):
            actor, critic = params
            error = value(critic, batch.window, batch.action) - y
            action = act(networks.actor, actor, batch.window)
            climbed = value(jax.lax.stop_gradient(critic), batch.window, action)
            return jnp.mean(error**2) - jnp.mean(climbed), jnp.mean(error**2)

        params = (state.actor, state.critic)
        (_, loss), gradient = jax.value_and_grad(losses, has_aux=True)(params)
        with jax.numpy_dtype_promotion("standard"):
            step, optimizer = self.adam.update(gradient, state.optimizer)
        rate = numbers.critic_learning_rate
        actor, critic = jax.tree.map(lambda p, s: p - rate * s, params, step)
        return DdpgState(actor, critic, optimizer), {"critic_loss": measured(loss)}


@pytest.fixture(scope="module", autouse=True)
def registered():
    rtd.register_memory("echo", EchoMemory, replace=True)
    rtd.register_learner("ddpg", lambda config: Ddpg(), replace=True)
    actor = rtd.NetworkSpec(memory=("observation", "previous_action"), memory_has_current=True)
    critic = rtd.NetworkSpec(memory=("observation", "action"), memory_has_current=True)
    rtd.register_agent("rdpg", rtd.Variant(actor, critic, learner="ddpg"), replace=True)
    reads = rtd.NetworkSpec(current=("observation",))
    values = rtd.NetworkSpec(current=("observation", "action"))
    rtd.register_agent("dpg", rtd.Variant(reads, values, learner="ddpg"), replace=True)
    rtd.register_agent(
        "tanh-td3", rtd.Variant(actor, critic, encoder=TanhEncoder, colour="#123456"), replace=True
    )


@pytest.mark.parametrize(
    ("agent", "memory"),
    [
        ("rdpg", "lstm"),
        ("lstm-td3", "echo"),
        pytest.param("tanh-td3", "gru", marks=pytest.mark.slow),
        pytest.param("h-td3", "min-gru", marks=pytest.mark.slow),
    ],
)
def test_what_was_added_trains_saves_loads_and_leaves(tmp_path, agent, memory):
    env = rtd.make("rover", "ar1-slip")
    config = rtd.Config(algorithm=agent, memory=memory, **TINY)
    run = rtd.train(env, config, seeds=[0], progress=False)
    assert not run.failures and np.isfinite(run.returns).all()
    assert np.isfinite(run.metrics["critic_loss"]).all()
    policy = run.policy(0)
    start = init_network(jax.random.key(0), policy.network)
    assert jax.tree.structure(start) == jax.tree.structure(policy.actor)
    policy.save(tmp_path / "p.safetensors")
    loaded = rtd.load_policy(tmp_path / "p.safetensors")
    assert loaded.memory == memory
    seen = np.random.default_rng(0).normal(size=(6, 2)).astype(np.float32)
    policy.export(tmp_path / "p.stablehlo", format="stablehlo")
    program = rtd.load_stablehlo(tmp_path / "p.stablehlo")
    state, loaded_state, program_state = policy.init(), loaded.init(), program.init()
    players = []
    if memory in ("lstm", "gru", "min-gru") and agent != "tanh-td3":
        policy.export(tmp_path / "p.py", format="numpy")
        names: dict = {}
        exec((tmp_path / "p.py").read_text(), names)
        players = [names["Player"]()]
    else:
        with pytest.raises(rtd.UserError, match="as stablehlo"):
            policy.export(tmp_path / "p.py", format="numpy")
        with pytest.raises(rtd.UserError, match="as stablehlo"):
            policy.export(tmp_path / "p.onnx", format="onnx")
    step = jax.jit(policy.step)
    for observation in seen:
        action, state = step(state, observation)
        again, loaded_state = loaded.step(loaded_state, observation)
        played, program_state = program.step(program_state, observation[None])
        np.testing.assert_allclose(again, action, atol=1e-6)
        np.testing.assert_allclose(played[0], action, atol=1e-5)
        for player in players:
            np.testing.assert_allclose(player.step(observation), action, atol=1e-5)


def test_the_actor_of_an_added_learner_waits_as_long_as_it_is_told():
    env = rtd.make("rover", "ar1-slip")
    config = rtd.Config(algorithm="dpg", **{**TINY, "history_length": None, "actor_starts": 40})
    (job,) = make_jobs(env, config, [0])
    agent, keys = job.program.agent, jax.random.split(jax.random.key(0), 4)
    numbers = job.lane.hyperparameters
    batch = agent.sample(agent.empty_replay(), keys[0], jnp.int32(20), numbers.history_length, None)
    update = jax.jit(agent.update)
    states = [jax.jit(agent.init)(keys[1])]
    for count in range(1, 22):
        states.append(update(states[-1], batch, keys[2:], numbers, jnp.int32(count))[0])

    def moved(part):
        """The updates that moved it."""
        leaves = [jax.tree.leaves(getattr(state, part)) for state in states]
        pairs = zip(leaves, leaves[1:], strict=False)
        same = (all(map(np.array_equal, one, other)) for one, other in pairs)
        return [count for count, still in enumerate(same, start=1) if not still]

    # Updates begin at step 20: the twenty-first is that of step 40.
    assert moved("actor") == [21] and moved("critic") == list(range(1, 22))


def test_what_an_added_learner_cannot_freeze_is_one_line():
    fields = {**TINY, "history_length": None, "freeze": "critics.head"}
    with pytest.raises(rtd.UserError, match="learner 'ddpg' has no field 'critics', only actor, c"):
        make_jobs(rtd.make("rover", "ar1-slip"), rtd.Config(algorithm="dpg", **fields), [0])


def test_a_seventh_agent_sweeps_draws_reports_and_loads(tmp_path, pictures):
    out = tmp_path / "run"
    flags = [f"--{name.replace('_', '-')}={value}" for name, value in TINY.items()]
    flags = [flag for flag in flags if "history" not in flag]
    arguments = [
        *("--env", "rover", "--disturbances", "ar1-slip", "--algorithms", "rdpg", "td3"),
        *("--history-lengths", "2", "--no-report"),
        *("--seeds", "1", "--final-episodes", "2", "--out", str(out), "--quiet", *flags),
    ]
    assert sweep.main(arguments) == 0
    assert report.main([str(out)]) == 0
    page = (out / "report.html").read_text()
    assert "rdpg" in page and (out / "learning_curves.png").exists()
    assert rtd.load_policy(out, algorithm="rdpg").algorithm == "rdpg"


def test_agents_that_cannot_be_trained_are_one_line():
    reads = rtd.NetworkSpec(current=("observation",))
    critic = rtd.NetworkSpec(current=("observation", "action"))
    cases = (
        (rtd.Variant(reads, critic, learner="sac"), "learner 'sac' is unknown"),
        (rtd.Variant(reads, reads), "critic does not read the current action"),
        (rtd.Variant(critic, critic), "reads the action that it must choose"),
        (rtd.Variant(rtd.NetworkSpec(), critic), "its actor reads nothing"),
        (rtd.Variant(rtd.NetworkSpec(current=("reward",)), critic), "reads 'reward'"),
    )
    for variant, message in cases:
        with pytest.raises(rtd.UserError, match=message):
            rtd.register_agent("mine", variant)
    lists = rtd.NetworkSpec(current=["observation"]), rtd.NetworkSpec(current=[*critic.current])
    assert rtd.Variant(*lists) == rtd.Variant(reads, critic) and hash(rtd.Variant(*lists))
    with pytest.raises(rtd.UserError, match="'td3' is already registered"):
        rtd.register_agent("td3", rtd.Variant(reads, critic))
