"""Compares the PyTorch reference with rtd3jax for equal weights and batches."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.history import Steps
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.learners import td3
from rtd3jax.agents.learners.base import Networks
from rtd3jax.agents.memory.lstm import Carry, zero_carry
from rtd3jax.agents.replay import Transition, empty_replay, gather, put_carries, put_transitions
from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.registries import AGENTS

torch = pytest.importorskip("torch", reason="PyTorch is not installed: pip install '.[bench]'")

from experiments.benchmarks.numpy_environment import Ring, Rover  # noqa: E402
from experiments.benchmarks.torch_reference import Learner, tensors  # noqa: E402

CAPACITY, STEPS, LENGTH, OBS, A, WIDTH = 30, 47, 2, 3, 2, 8
NUMBERS = [40, 46, 17, 18, 19, 20, 30, 31, 45]  # oldest and newest rows, and episodes' starts
HYPERPARAMETERS = dict(
    actor_learning_rate=1e-3,
    critic_learning_rate=1e-3,
    final_learning_rate_fraction=1.0,
    gamma=0.9,
    reward_scale=1.0,
    tau=0.1,
    exploration_noise=0.1,
    target_noise=0.4,
    target_noise_clip=0.3,
    actor_noise=0.0,
)


@pytest.fixture(scope="module")
def replays():
    """Both replays after the same steps, the ring having wrapped; episodes of 10 steps."""
    ours, theirs = (
        empty_replay(CAPACITY, OBS, A, zero_carry(1, WIDTH)),
        Ring(CAPACITY, OBS, A, WIDTH),
    )
    random = np.random.default_rng(0)
    for number in range(STEPS):
        observation, after = random.standard_normal((2, OBS)).astype(np.float32)
        previous, action = random.standard_normal((2, A)).astype(np.float32)
        carry = random.standard_normal((2, WIDTH)).astype(np.float32)
        episode_step, terminated = number % 10, number % 7 == 0
        row = Transition(
            Steps(*map(jnp.asarray, (observation, previous, action))),
            jnp.float32(number),
            jnp.asarray(after),
            jnp.asarray(terminated),
            jnp.int32(episode_step),
        )
        ours = put_transitions(ours, jnp.int32(number), jax.tree.map(lambda x: x[None], row))
        ours = put_carries(ours, jnp.int32(number), Carry(*map(jnp.asarray, carry[:, None])))
        theirs.put(previous, observation, action, float(number), after, terminated, episode_step)
        theirs.put_carry(number, carry)
    return ours, theirs


@pytest.fixture(scope="module")
def batches(replays):
    ours, theirs = replays
    number = jnp.array(NUMBERS, jnp.int32)
    return (
        gather(ours, number, jnp.int32(STEPS), LENGTH, LENGTH),
        theirs.gather(np.array(NUMBERS), LENGTH),
    )


def _parts(window):
    """Our window as theirs: past, missing, current."""
    past = jnp.concatenate(
        (window.past.previous_action, window.past.observation, window.past.action), -1
    )
    current = jnp.concatenate((window.previous_action, window.observation), -1)
    return past, ~window.exists, current


def test_the_windows_are_the_same(batches):
    ours, theirs = batches
    assert ours.window.length.tolist() == [0, 2, 0, 1, 2, 0, 0, 1, 2]
    for window, other in ((ours.window, theirs.window), (ours.next_window, theirs.next_window)):
        past, missing, current = map(np.asarray, _parts(window))
        np.testing.assert_array_equal(other.missing[:-1, :, 0], missing)
        np.testing.assert_array_equal(other.missing[-1], 0)
        np.testing.assert_array_equal(other.past[~missing], past[~missing])
        np.testing.assert_array_equal(other.current, current)
    np.testing.assert_array_equal(theirs.action, ours.action)
    np.testing.assert_array_equal(theirs.reward, ours.reward)
    np.testing.assert_array_equal(theirs.terminated, ours.terminated)
    for carry, other in ((ours.carry, theirs.carry), (ours.next_carry, theirs.next_carry)):
        np.testing.assert_array_equal(other, np.stack(carry, axis=1))


def test_no_past_at_all_is_an_empty_window(replays):
    batch = replays[1].gather(np.array(NUMBERS), 0)
    assert batch.window.past.shape[0] == batch.next_window.past.shape[0] == 0
    np.testing.assert_array_equal(batch.next_window.current[:, :A], batch.action)


def _load(network, params, spec):
    """Put our parameters into their network; columns stand in the order of a token there."""
    order = ("previous_action", "observation", "action")
    sizes = {"previous_action": A, "observation": OBS, "action": A}

    def linear(layer, entry, parts=None):
        kernel = np.asarray(entry["kernel"])
        if parts:
            places = np.split(np.arange(len(kernel)), np.cumsum([sizes[p] for p in parts])[:-1])
            named = dict(zip(parts, places, strict=True))
            kernel = kernel[np.concatenate([named[part] for part in order if part in named])]
        layer.weight.copy_(torch.tensor(kernel.T))
        layer.bias.copy_(torch.tensor(np.asarray(entry["bias"])))

    with torch.no_grad():
        if spec.memory:
            linear(network.encoder, params["encoder"], spec.memory)
            lstm = {name: torch.tensor(np.asarray(leaf)) for name, leaf in params["memory"].items()}
            network.lstm.weight_ih_l0[:, :WIDTH] = lstm["input_kernel"].T
            network.lstm.weight_hh_l0.copy_(lstm["recurrent_kernel"].T)
            network.lstm.bias_ih_l0.copy_(lstm["input_bias"])
            network.lstm.bias_hh_l0.copy_(lstm["recurrent_bias"])
        if spec.current:
            linear(network.current, params["current"], spec.current)
        linear(network.head, params["head"])
        linear(network.output, params["output"])


def _networks(learner, variant):
    """The networks of either learner, with their specifications."""
    return [
        (learner.actor, variant.actor),
        (learner.target_actor, variant.actor),
        *((critic, variant.critic) for critic in learner.critics),
        *((critic, variant.critic) for critic in learner.target_critics),
    ]


def _assert_same(theirs, learner, variant):
    """Their networks compute what ours would, weight by weight."""
    expected = Learner(variant, OBS, A, WIDTH)
    for (network, spec), (params, _) in zip(
        _networks(expected, variant), _networks(learner, variant), strict=True
    ):
        _load(network, params, spec)
    for (network, _), (other, _) in zip(
        _networks(theirs, variant), _networks(expected, variant), strict=True
    ):
        for (name, got), (_, want) in zip(
            network.named_parameters(), other.named_parameters(), strict=True
        ):
            np.testing.assert_allclose(
                got.detach().numpy(), want.detach().numpy(), atol=1e-5, err_msg=name
            )


def _learner(variant):
    """A learner all of whose networks differ; drawn by numpy, which compiles nothing."""
    random = np.random.default_rng(3)
    shapes = jax.eval_shape(lambda: td3.TD3().init(jax.random.key(0), _modules(variant)))
    zeros = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes)
    networks = {
        name: jax.tree.map(
            lambda leaf: random.uniform(-0.4, 0.4, leaf.shape).astype(np.float32),
            getattr(shapes, name),
        )
        for name in ("actor", "critics", "target_actor", "target_critics")
    }
    return zeros.replace(**networks)


def _modules(variant):
    return Networks(*(make_part(variant, r, "lstm", OBS, A, WIDTH) for r in ("actor", "critic")))


@functools.partial(jax.jit, static_argnums=0)
def _update(variant, before, batch):
    """Our target, loss and learner after one update, and the noise that it drew."""
    numbers = {k: jnp.float32(v) for k, v in HYPERPARAMETERS.items()}
    numbers = Hyperparameters(**numbers, history_length=jnp.int32(LENGTH))
    key = jax.random.key(5)
    gaussian = jax.random.normal(key, (len(NUMBERS), A), jnp.float32)
    networks = _modules(variant)
    y = td3.target(networks, before, batch, key, numbers)
    learner, keys = td3.TD3(policy_delay=1), jnp.stack((key, key))
    after, metrics = learner.update(networks, before, batch, keys, numbers, jnp.int32(1))
    return y, metrics["critic_loss"].total, after, gaussian


@pytest.mark.parametrize("name", ALGORITHMS)
def test_an_update_is_the_same(batches, name):
    variant = AGENTS[name]
    batch, other_batch = batches
    other_batch = tensors(other_batch)
    if not variant.critic_reads_carries:
        batch = batch.replace(carry=None, next_carry=None)
        other_batch = other_batch._replace(carry=None, next_carry=None)
    before = _learner(variant)
    y, loss, after, gaussian = _update(variant, before, batch)
    theirs = Learner(
        variant,
        OBS,
        A,
        WIDTH,
        gamma=0.9,
        tau=0.1,
        learning_rate=1e-3,
        noise=0.4,
        noise_clip=0.3,
    )
    for (network, spec), (params, _) in zip(
        _networks(theirs, variant), _networks(before, variant), strict=True
    ):
        _load(network, params, spec)
    gaussian = torch.tensor(np.asarray(gaussian))
    np.testing.assert_allclose(theirs.target(other_batch, gaussian), y, atol=1e-5)
    np.testing.assert_allclose(theirs.update_critics(other_batch, gaussian), loss, rtol=1e-5)
    theirs.update_actor_and_targets(other_batch)
    _assert_same(theirs, after, variant)


def test_the_rover_is_the_same():
    import rtd3jax as rtd
    from rtd3jax.envs.rover.slip import Ar1SlipState

    env = rtd.make("rover", "ar1-slip", sigma=0.0)
    theirs = Rover(np.random.default_rng(0))
    theirs.reset()
    observation, state = env.reset(jax.random.key(0), env.default_params)
    state = state.replace(slip=Ar1SlipState(jnp.array([0.3, 0.1], jnp.float32)))
    theirs._left, theirs._right = 0.3, 0.1
    theirs._random = type("Still", (), {"standard_normal": lambda self, n: np.zeros(n)})()
    for action in ([0.4, -0.3], [3.0, 0.2], [-0.5, -7.0]):
        action = np.array(action, np.float32)
        observation, state, reward, *_ = env.step(
            jax.random.key(1), state, jnp.asarray(action), env.default_params
        )
        got, got_reward, done = theirs.step(action)
        np.testing.assert_allclose(got, observation, atol=1e-6)
        assert got_reward == pytest.approx(float(reward), abs=1e-6) and not done
