"""Tests the texts that identify environments in files: they differ with everything that matters."""

import dataclasses
import functools
import os
import re
import subprocess
import sys
import threading
from types import SimpleNamespace

import gymnax
import jax
import numpy as np
import pytest
from gymnax.environments import environment

import rtd3jax as rtd
from rtd3jax.envs.words import in_words
from rtd3jax.training.plant import plant_of


class Plain(environment.Environment):
    """An environment as gymnax's users write them."""

    def __init__(self, **options):
        super().__init__()
        vars(self).update(options)


@dataclasses.dataclass(frozen=True)
class Gain(environment.Environment):
    gain: float


class Slotted:
    __slots__ = ("mass",)

    def __init__(self, mass):
        self.mass = mass


def scaled(factor):
    def reward(x, offset=1.0):
        return factor * x + offset

    return reward


def first(x):
    return x in {"left", "right"}


def second(x):
    return x not in {"left", "right"}


second.__qualname__ = first.__qualname__  # as an edited cell of a notebook defines it


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (Plain(weights=(1.0, 2.0)), Plain(weights=(5.0, 6.0))),
        (Plain(weights=[1.0, 2.0]), Plain(weights=[1.0, 3.0])),
        (Plain(weights=np.arange(3)), Plain(weights=np.arange(3) + 1)),
        (Plain(weights=np.arange(9_000)), Plain(weights=np.arange(9_000)[::-1])),
        (Plain(weights=jax.numpy.zeros(2)), Plain(weights=jax.numpy.ones(2))),
        (Plain(weights=np.zeros((2, 0))), Plain(weights=np.zeros((0, 2)))),
        (Plain(weights=np.array([1, "a"], object)), Plain(weights=np.array([2, "a"], object))),
        (Plain(weights=np.float32(1)), Plain(weights=np.float32(2))),
        (Plain(key=jax.random.key(1)), Plain(key=jax.random.key(2))),
        (Plain(table={"r": 1.0}), Plain(table={"r": 5.0})),
        (Plain(table={"r": {"s": (1, [2.0])}}), Plain(table={"r": {"s": (1, [3.0])}})),
        (Plain(names={"a", "b"}), Plain(names={"a", "c"})),
        (Plain(part=SimpleNamespace(mass=1)), Plain(part=SimpleNamespace(mass=2))),
        (Plain(part=Slotted(1)), Plain(part=Slotted(2))),
        (Plain(reward=lambda x: x), Plain(reward=lambda x: 2 * x)),
        (Plain(reward=scaled(1.0)), Plain(reward=scaled(2.0))),
        (Plain(reward=jax.jit(scaled(1.0))), Plain(reward=jax.jit(scaled(2.0)))),
        (Plain(reward=first), Plain(reward=second)),
        (
            Plain(reward=functools.partial(first, x=1)),
            Plain(reward=functools.partial(first, x=2)),
        ),
        (Gain(1.0), Gain(5.0)),
        (rtd.disturb(rtd.make("rover"), rtd.Delay()).base, Gain(1.0)),
    ],
)
def test_other_options_are_another_text(one, other):
    assert in_words(one) != in_words(other)
    assert in_words(one) == in_words(one)
    texts = [plant_of(env, env.default_params)["plant"] for env in (one, other)]
    assert texts[0] != texts[1]
    assert not re.search(r"0x[0-9a-f]{6}", "".join(texts))


def test_the_brax_environment_inside_is_part_of_the_text():
    class Inside:
        def __init__(self, reward):
            self.reward = reward

    kept = {"default_params": None, "observation_key": None, "keep": (0,)}
    one, other = (rtd.envs.compat.brax.BraxEnv(Inside({"r": r}), **kept) for r in (1.0, 5.0))
    assert in_words(one) != in_words(other)


@pytest.mark.parametrize(
    ("env", "text"),
    [
        (rtd.make("rover", "ar1-slip"), "Rover() with RoverParams(slip=Ar1Slip())"),
        (
            rtd.make("rover-soil", "mixed"),
            "RoverSoil() with RoverSoilParams(ground=Ground(soil=Soil(), other=Soil()))",
        ),
        (
            rtd.make("pendulum", "random-sine"),
            "Disturbed(Pendulum(), 'state') with DisturbedParams(env=EnvParams(), "
            "observation=Sine(elements=(0, 1, 2), waves=1), action=NoDisturbance(), "
            "reward=NoDisturbance())",
        ),
        (
            rtd.make("pendulum", "noise/dropout", weights=(2, 1)),
            "Disturbed(Pendulum(), 'state') with DisturbedParams(env=EnvParams(), "
            "observation=Mixture(processes=(GaussianNoise(), Dropout(hold=True)), weights=(2, 1)), "
            "action=NoDisturbance(), reward=NoDisturbance())",
        ),
        (
            rtd.disturb(rtd.make("pendulum"), rtd.Recorded(np.arange(30.0).reshape(10, 3))),
            "Disturbed(Pendulum(), 'state') with DisturbedParams(env=EnvParams(), "
            "observation=Recorded(channel='observation', elements=(), independent=False, "
            "mirror=False), action=NoDisturbance(), reward=NoDisturbance())",
        ),
        (rtd.make("Reacher-misc"), "Reacher('Reacher-misc') with EnvParams()"),
        (gymnax.make("Reacher-misc")[0], "Reacher(num_joints=2) with EnvParams()"),
        (gymnax.make("Pendulum-v1")[0], "Pendulum() with EnvParams()"),
        (Plain(mass=2.0, name_="a"), "Plain(mass=2.0, name_='a') with EnvParams()"),
    ],
)
def test_texts_that_files_have_stay(env, text):
    assert plant_of(env, env.default_params)["plant"] == text


def test_what_has_no_value_is_named_by_its_type():
    class Opaque:
        """Its repr has an address."""

    def parts():
        return {"a": Opaque(), "b": object(), "c": threading.Lock(), "d": iter([]), "e": np}

    one, other = Plain(**parts()), Plain(**parts())
    assert in_words(one) == in_words(other) and "0x" not in in_words(one)


def test_what_refers_to_itself_or_is_deep_has_a_text():
    deep = last = []
    for _ in range(5_000):
        last.append([])
        last = last[0]
    ring = [SimpleNamespace() for _ in range(40)]
    for node in ring:
        node.all = ring
    doubled = ()
    for _ in range(60):
        doubled = (doubled, doubled)
    own = {}
    own["self"] = own
    env = Plain(deep=deep, ring=ring, doubled=doubled, own=own)
    env.step_alone = env.step
    env.again = env
    assert len(in_words(env)) < 20_000
    ring[-1].mass = 1.0
    assert in_words(Plain(ring=ring)) != in_words(Plain(ring=ring[:-1]))


def test_a_cached_property_does_not_change_the_text():
    class Lazy(Plain):
        @functools.cached_property
        def table(self):
            return np.arange(3)

    env = Lazy(mass=1.0)
    before = in_words(env)
    assert env.table.size and in_words(env) == before


SCRIPT = """
from rtd3jax.envs.words import in_words
class Part:
    pass
def of(x, hook=lambda y: y in {"left", "right", "up"}):
    return Part() if x in {"a", "b", "c"} else hook
print(in_words((of, {"a", "b", "c"}, Part(), lambda: of, frozenset({("a", 1), ("b", 2)}))))
"""


def test_the_text_is_the_same_in_every_process():
    texts = [
        subprocess.run(
            [sys.executable, "-c", SCRIPT],
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout
        for seed in ("1", "2")
    ]
    assert texts[0] == texts[1] and "__main__.of " in texts[0]
