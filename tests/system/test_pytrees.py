"""Tests that JAX does not take a pytree of one type for a pytree of another."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import pytest
from flax import struct

import rtd3jax as rtd
from rtd3jax.envs.builtin import LISTED
from rtd3jax.envs.processes.process import Process
from rtd3jax.evaluation import returns, rollout
from rtd3jax.evaluation.gymnasium import _act
from rtd3jax.system.pytrees import TypedNode, node_types

PAIRS = 500
"""JAX takes eight of so many pairs of flax's dataclasses for each other."""


class Metres(TypedNode):
    length: jax.Array
    count: int = struct.field(pytree_node=False, default=2)


class Feet(TypedNode):
    length: jax.Array
    number: int = struct.field(pytree_node=False, default=2)


@struct.dataclass
class Left:
    """A policy."""

    size: jax.Array

    def init(self, key=None):
        """Nothing."""
        return ()

    def step(self, state, observation):
        """Left."""
        return -self.size, state


@struct.dataclass
class Right(Left):
    """Another policy with the same fields."""

    def step(self, state, observation):
        """Right."""
        return self.size, state


def test_a_typed_node_is_a_dataclass_and_a_pytree_as_those_of_flax():
    node = Metres(jnp.float32(3.0), count=4)
    ((path, leaf),), _ = jax.tree_util.tree_flatten_with_path(node)
    assert jax.tree_util.keystr(path) == ".length" and leaf == 3.0
    doubled = jax.jit(lambda tree: jax.tree.map(lambda leaf: 2 * leaf, tree))(node)
    assert doubled == Metres(jnp.float32(6.0), count=4) == node.replace(length=jnp.float32(6.0))
    with pytest.raises(dataclasses.FrozenInstanceError):
        node.length = 1.0
    assert struct.dataclass(Metres) is Metres


def test_types_and_static_fields_distinguish_structures():
    metres = jax.tree.structure(Metres(1.0))
    assert metres == jax.tree.structure(Metres(2.0))
    assert metres != jax.tree.structure(Metres(1.0, count=3))
    assert metres != jax.tree.structure(Feet(1.0))


def every_process(kind=Process):
    """Processes of this package, one of each class."""
    for cls in kind.__subclasses__():
        yield from every_process(cls)
        if cls.__module__.startswith("rtd3jax."):
            yield cls(jnp.zeros((2, 3))) if cls is rtd.Recorded else cls()


def test_no_two_processes_have_the_same_structure():
    processes = list(every_process())
    assert len(processes) > 15
    for one, other in itertools.combinations(processes, 2):
        assert jax.tree.structure(one) != jax.tree.structure(other), (one, other)


@pytest.mark.parametrize("env_id", LISTED)
def test_disturbances_of_different_processes_have_different_structures(env_id):
    params = {name: rtd.make(env_id, name).default_params for name in LISTED[env_id]}
    for one, other in itertools.combinations(params, 2):
        if node_types(params[one]) != node_types(params[other]):
            structures = [jax.tree.structure(params[name]) for name in (one, other)]
            assert structures[0] != structures[1], (one, other)


def test_the_types_of_all_nodes_are_found():
    tree = {"a": [Left(jnp.ones(1)), None], "b": (Metres(1.0),)}
    assert set(node_types(tree)) == {dict, list, tuple, Left, Metres, type(None)}
    assert node_types(Left(jnp.ones(1))) == (Left,) != node_types(Right(jnp.ones(1)))
    assert node_types(object()) == ()


def test_policies_with_equal_fields_are_not_taken_for_each_other():
    size, seen = jnp.ones(1), jnp.zeros(3)
    for _ in range(PAIRS):
        # New classes each time: whether JAX takes one for the other depends on their addresses.
        for base, sign in ((Left, "neg"), (Right, "size")):
            kind = struct.dataclass(type("Policy", (base,), {"__annotations__": {}}))
            traced = _act.trace(kind(size), (), seen, types=node_types(kind(size)))
            assert ("neg" in str(traced.jaxpr)) == (sign == "neg")


@pytest.mark.parametrize(
    ("module", "program", "play"),
    [(returns, "_episode_returns", rtd.evaluate), (rollout, "_play", rtd.rollout)],
)
def test_episodes_are_played_by_a_program_for_the_types_of_the_policy(
    module, program, play, monkeypatch
):
    asked, env = [], rtd.make("rover", max_steps_in_episode=2)
    kept = getattr(module, program)

    def record(*arguments):
        asked.append(arguments[-1])
        return kept(*arguments)

    monkeypatch.setattr(module, program, record)
    for kind in (Left, Right):
        play(kind(jnp.ones(2)), env, episodes=1)
    assert [kinds[: asked[0].index(Left) + 1].count(Left) for kinds in asked] == [1, 0]
