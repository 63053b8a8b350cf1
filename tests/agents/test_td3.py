"""Compares targets, losses and updates with the formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.history import Steps, Window
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.learners import td3
from rtd3jax.agents.learners.base import Networks
from rtd3jax.agents.networks import act, apply_network
from rtd3jax.agents.noise import add_noise
from rtd3jax.agents.replay import Batch
from rtd3jax.registries import AGENTS

B, L, WIDTH = 6, 2, 16
target = jax.jit(td3.target, static_argnums=0)
update_actor_and_targets = jax.jit(td3.update_actor_and_targets, static_argnums=0)


def _numbers(**changes):
    numbers = dict(
        actor_learning_rate=1e-2,
        critic_learning_rate=2e-2,
        final_learning_rate_fraction=0.25,
        gamma=0.9,
        reward_scale=1.0,
        tau=0.1,
        exploration_noise=0.1,
        target_noise=0.2,
        target_noise_clip=0.3,
        actor_noise=0.0,
    )
    values = {name: jnp.float32(value) for name, value in (numbers | changes).items()}
    return Hyperparameters(**values, history_length=jnp.int32(L))


def _window(key):
    a, b, c, d, e = jax.random.split(key, 5)
    past = Steps(
        jax.random.normal(a, (L, B, 3)),
        jax.random.normal(b, (L, B, 1)),
        jax.random.normal(c, (L, B, 1)),
    )
    length = jnp.array([0, 1, 2, 2, 2, 2], jnp.int32)
    return Window(past, length, jax.random.normal(d, (B, 3)), jax.random.normal(e, (B, 1)))


def _batch():
    keys = jax.random.split(jax.random.key(5), 4)
    return Batch(
        window=_window(keys[0]),
        action=jax.random.uniform(keys[1], (B, 1), minval=-1.0, maxval=1.0),
        reward=jnp.arange(B, dtype=jnp.float32),
        terminated=jnp.array([True, False, False, True, False, False]),
        next_window=_window(keys[2]),
        carry=None,
        next_carry=None,
    )


@pytest.fixture(params=["td3", "lstm-td3-1ha1hc", "lstm-td3"])
def problem(request):
    parts = (make_part(AGENTS[request.param], r, "lstm", 3, 1, WIDTH) for r in ("actor", "critic"))
    networks = Networks(*parts)
    learner = td3.TD3().init(jax.random.key(0), networks)
    other = td3.TD3().init(jax.random.key(1), networks)
    learner = learner.replace(
        target_actor=other.actor, target_critics=other.critics
    )  # so that targets and online networks cannot be taken for one another
    return networks, learner, _batch()


def test_target_is_the_formula(problem):
    networks, learner, batch = problem
    got = target(networks, learner, batch, jax.random.key(9), _numbers())
    noise = np.clip(0.2 * np.asarray(jax.random.normal(jax.random.key(9), (B, 1))), -0.3, 0.3)
    output = apply_network(networks.actor, learner.target_actor, batch.next_window)
    action = np.clip(np.tanh(np.asarray(output)) + noise, -1.0, 1.0)
    values = [
        np.asarray(apply_network(networks.critic, critic, batch.next_window, jnp.asarray(action)))
        for critic in learner.target_critics
    ]
    assert not np.allclose(*values)
    scaled = target(networks, learner, batch, jax.random.key(9), _numbers(reward_scale=5))
    np.testing.assert_allclose(scaled - got, 4 * np.asarray(batch.reward), rtol=1e-4, atol=1e-5)
    bootstrap = 0.9 * np.minimum(*values)[:, 0] * ~np.asarray(batch.terminated)
    np.testing.assert_allclose(got, np.asarray(batch.reward) + bootstrap, rtol=1e-5, atol=1e-6)


def test_target_noise_is_clipped(problem):
    networks, learner, batch = problem
    wide = target(networks, learner, batch, jax.random.key(1), _numbers(target_noise=99))
    still = target(
        networks,
        learner,
        batch,
        jax.random.key(1),
        _numbers(target_noise=99, target_noise_clip=0),
    )
    none = target(networks, learner, batch, jax.random.key(1), _numbers(target_noise=0))
    np.testing.assert_allclose(still, none, rtol=1e-6)
    assert not np.allclose(wide, none)


def test_the_loss_of_a_critic_is_its_mean_squared_error(problem):
    networks, learner, batch = problem
    y = jnp.linspace(-1.0, 1.0, B)
    for critic in learner.critics:
        value = apply_network(networks.critic, critic, batch.window, batch.action)[:, 0]
        got = td3.critic_loss(critic, networks.critic, batch, y)[0]
        np.testing.assert_allclose(got, np.mean((value - y) ** 2), rtol=1e-5)


def test_the_actor_climbs_the_first_critic(problem):
    networks, learner, batch = problem

    def loss(actor):
        action = jnp.tanh(apply_network(networks.actor, actor, batch.window))
        return -jnp.mean(apply_network(networks.critic, learner.critics[0], batch.window, action))

    compiled = jax.jit(jax.value_and_grad(td3.actor_loss, has_aux=True), static_argnums=2)
    (value, _), gradient = compiled(
        learner.actor,
        learner.critics[0],
        networks,
        batch,
        jax.random.key(3),
        jnp.float32(0.0),
    )
    expected, expected_gradient = jax.jit(jax.value_and_grad(loss))(learner.actor)
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert np.any(expected_gradient["head"]["kernel"])
    for a, b in zip(*map(jax.tree.leaves, (gradient, expected_gradient)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-6)


def test_actor_noise_averages_the_value_over_the_actions_around(problem):
    networks, learner, batch = problem
    noise, draws = 0.3, 4_000
    greedy = np.asarray(act(networks.actor, learner.actor, batch.window))
    around = np.random.default_rng(0).normal(size=(draws, B, 1)) * noise
    actions = jnp.asarray(np.clip(greedy[None] + around, -1.0, 1.0), jnp.float32)

    def value(action):
        return apply_network(networks.critic, learner.critics[0], batch.window, action)[:, 0]

    expected = -np.asarray(jax.vmap(value)(actions)).mean()
    keys = jax.random.split(jax.random.key(3), draws)
    got = jax.vmap(
        lambda key: td3.actor_loss(
            learner.actor, learner.critics[0], networks, batch, key, jnp.float32(noise)
        )[0]
    )(keys)
    error = float(got.std()) / np.sqrt(draws)
    assert abs(float(got.mean()) - expected) < 6 * error
    assert abs(float(np.mean(value(jnp.asarray(greedy)))) + expected) > 12 * error


def test_updates_are_adam_and_polyak(problem):
    networks, learner, batch = problem
    y = target(networks, learner, batch, jax.random.key(2), _numbers())

    def both(critics):
        return sum(td3.critic_loss(critic, networks.critic, batch, y)[0] for critic in critics)

    updated, metrics = td3.update_critics(
        networks, learner, batch, jax.random.key(2), _numbers(), jnp.asarray(True)
    )
    with jax.numpy_dtype_promotion("standard"):
        adam = optax.adam(2e-2)
        gradient = jax.jit(jax.grad(both))(learner.critics)
        steps, _ = adam.update(gradient, adam.init(learner.critics))
    expected = optax.apply_updates(learner.critics, steps)
    for a, b, g in zip(*map(jax.tree.leaves, (updated.critics, expected, gradient)), strict=True):
        # Adam's first step is the gradient's sign, but where rounding is not small beside it.
        clear = np.abs(g) > 1e-5
        assert clear.mean() > 0.5
        np.testing.assert_allclose(np.asarray(a)[clear], np.asarray(b)[clear], atol=1e-6)
    assert updated.actor is learner.actor and updated.target_critics is learner.target_critics
    assert float(metrics["critic_loss"].total) == pytest.approx(
        float(both(learner.critics)), rel=1e-6
    )

    after, actor_metrics = update_actor_and_targets(
        networks, updated, batch, jax.random.key(3), _numbers(), jnp.asarray(True)
    )
    triples = (
        (after.actor, learner.target_actor, after.target_actor),
        (updated.critics, learner.target_critics, after.target_critics),
    )
    for online, before, moved in triples:
        for o, b, t in zip(*map(jax.tree.leaves, (online, before, moved)), strict=True):
            np.testing.assert_allclose(t, 0.9 * np.asarray(b) + 0.1 * np.asarray(o), atol=1e-6)
    assert not np.allclose(after.actor["head"]["kernel"], learner.actor["head"]["kernel"])


def test_noise_has_its_scale_and_actions_stay_within():
    action = jnp.zeros((20_000, 1))
    noisy = add_noise(jax.random.key(0), action, jnp.float32(0.1))
    assert float(jnp.std(noisy)) == pytest.approx(0.1, rel=0.02)
    wild = add_noise(jax.random.key(0), action, jnp.float32(10.0))
    assert float(wild.min()) == -1.0 and float(wild.max()) == 1.0


def test_actions_in_the_environments_units_are_within_its_bounds():
    low, high = jnp.array([-2.0, 0.1, 1e-3, -3e38]), jnp.array([4.0, 0.7, 3e-3, 3e38])
    bounds = Bounds(low, high)
    for action, expected in ((-1.0, low), (1.0, high), (0.0, [1.0, 0.4, 2e-3, 0.0])):
        got = bounds.to_environment(jnp.full((4,), action))
        np.testing.assert_allclose(got, expected, rtol=1e-6)
        assert bool(jnp.all((got >= low) & (got <= high)))


def test_learning_rates_fall_linearly_to_their_final_fraction():
    numbers = _numbers()
    for progress, share in ((0.0, 1.0), (0.5, 0.625), (1.0, 0.25)):
        now = numbers.decayed(jnp.float32(progress))
        np.testing.assert_allclose(now.actor_learning_rate, 1e-2 * share, rtol=1e-6)
        np.testing.assert_allclose(now.critic_learning_rate, 2e-2 * share, rtol=1e-6)
    assert float(now.gamma) == float(numbers.gamma)


def test_actor_noise_reaches_the_actor_alone(problem):
    networks, learner, batch = problem
    still, smoothed, again = (
        update_actor_and_targets(
            networks,
            learner,
            batch,
            jax.random.key(3),
            _numbers(actor_noise=noise),
            jnp.asarray(False),
        )[0]
        for noise in (0.0, 0.5, 0.5)
    )
    kernels = [after.actor["head"]["kernel"] for after in (still, smoothed, again)]
    assert not np.allclose(kernels[0], kernels[1])
    np.testing.assert_array_equal(kernels[1], kernels[2])
    for a, b in zip(
        *map(jax.tree.leaves, (still.target_critics, smoothed.target_critics)), strict=True
    ):
        np.testing.assert_array_equal(a, b)
