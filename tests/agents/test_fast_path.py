"""Compares the fast implementation of TD3 with a straightforward one, over 200 updates."""

import jax
import jax.numpy as jnp
import optax

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.history import Steps, Window
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.learners import td3
from rtd3jax.agents.learners.base import Networks
from rtd3jax.agents.memory import lstm as fast
from rtd3jax.agents.networks import act, apply_network
from rtd3jax.agents.replay import Batch
from rtd3jax.registries import AGENTS

B, L, WIDTH, UPDATES = 8, 3, 8, 200
NUMBERS = Hyperparameters(
    *(jnp.float32(x) for x in (1e-3, 1e-3, 1.0, 0.9, 1.0, 0.005, 0.1, 0.2, 0.5, 0.0)),
    history_length=jnp.int32(L),
)


def _window(key, length):
    a, b, c, d, e = jax.random.split(key, 5)
    shapes = ((L, B, 3), (L, B, 1), (L, B, 1))
    past = Steps(*(jax.random.normal(k, s) for k, s in zip((a, b, c), shapes, strict=True)))
    return Window(past, length, jax.random.normal(d, (B, 3)), jax.random.normal(e, (B, 1)))


def _batch(key):
    a, b, c, d, e, f = jax.random.split(key, 6)
    length = jax.random.randint(a, (B,), 0, L + 1)
    return Batch(
        window=_window(b, length),
        action=jax.random.uniform(c, (B, 1), minval=-1.0, maxval=1.0),
        reward=jax.random.normal(d, (B,)),
        next_window=_window(e, jnp.minimum(length + 1, L)),
        terminated=jax.random.bernoulli(f, 0.1, (B,)),
        carry=None,
        next_carry=None,
    )


def _straightforward(learner, networks, batch, key):
    """One step of TD3 as one writes it down: joint losses, automatic differentiation, optax."""
    y = td3.target(networks, learner, batch, key, NUMBERS)

    def critics_loss(critics):
        values = [apply_network(networks.critic, c, batch.window, batch.action) for c in critics]
        return sum(jnp.mean((value[:, 0] - y) ** 2) for value in values)

    def actor_loss(actor):
        action = act(networks.actor, actor, batch.window)
        return -jnp.mean(apply_network(networks.critic, critics[0], batch.window, action))

    adam = optax.scale_by_adam()

    def descend(params, gradient, state):
        with jax.numpy_dtype_promotion("standard"):
            direction, state = adam.update(gradient, state)
        return jax.tree.map(lambda p, d: p - 1e-3 * d, params, direction), state

    def average(online, target):
        return jax.tree.map(lambda o, t: 0.995 * t + 0.005 * o, online, target)

    critics, critic_state = descend(
        learner.critics, jax.grad(critics_loss)(learner.critics), learner.critic_optimizer
    )
    actor, actor_state = descend(
        learner.actor, jax.grad(actor_loss)(learner.actor), learner.actor_optimizer
    )
    return td3.TD3State(
        actor=actor,
        critics=critics,
        target_actor=average(actor, learner.target_actor),
        target_critics=average(critics, learner.target_critics),
        actor_optimizer=actor_state,
        critic_optimizer=critic_state,
    )


def _fast(learner, networks, batch, key):
    keys, count = jnp.stack((key, key)), jnp.int32(1)
    return td3.TD3(policy_delay=1).update(networks, learner, batch, keys, NUMBERS, count)[0]


def _reference_lstm(params, inputs, exists, carry=None, precision="float32"):
    return fast.reference(params, inputs, exists, carry or fast.zero_carry(B, WIDTH))


def test_200_updates_agree_to_float32_rounding(monkeypatch):
    agent = AGENTS["lstm-td3-1ha1hc"]
    networks = Networks(*(make_part(agent, r, "lstm", 3, 1, WIDTH) for r in ("actor", "critic")))

    def train(update):
        def step(learner, key):
            batch_key, noise_key = jax.random.split(key)
            return update(learner, networks, _batch(batch_key), noise_key), None

        learner = td3.TD3().init(jax.random.key(0), networks)
        keys = jax.random.split(jax.random.key(1), UPDATES)
        return jax.jit(lambda first: jax.lax.scan(step, first, keys)[0])(learner), learner

    quick, start = train(_fast)
    monkeypatch.setattr(fast, "lstm", _reference_lstm)
    slow, _ = train(_straightforward)

    def farthest(one, other):
        pairs = zip(*(jax.tree.leaves((x.actor, x.critics)) for x in (one, other)), strict=True)
        return max(float(jnp.abs(a - b).max()) for a, b in pairs)

    assert farthest(quick, start) > 0.1
    assert farthest(quick, slow) < 2e-6
