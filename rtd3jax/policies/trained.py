"""`Policy`: a trained policy for use outside the trainer."""

import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.history import Steps, empty_steps, present, put_step, window_at
from rtd3jax.agents.memory.base import Carry, Params
from rtd3jax.agents.networks import Network, act, advance
from rtd3jax.agents.normalise import Normaliser, as_read
from rtd3jax.config import ACTINGS, Acting
from rtd3jax.errors import UserError, check_choice
from rtd3jax.policies.export.formats import writer_of
from rtd3jax.policies.export.model import Model, fold
from rtd3jax.registries import AGENTS
from rtd3jax.system.files import array_bytes, check_target, flatten, write_new
from rtd3jax.system.versions import versions_of

FORMAT = 2
"""Format of saved policies; it increases when older versions cannot read the files.

Actors of format 1 read actions in the environment's units."""

_LONG = 2**30
"""Steps of an episode after which its counter starts from a small number: 12 days at 1 kHz."""

CARRY_FORMAT = 3
"""Format of saved policies that act with a running carry; otherwise equal to `FORMAT`."""

NORMALISED_FORMAT = 4
"""Format of saved policies that normalise observations, with or without a running carry."""

KIND = "policy"


@struct.dataclass
class PolicyState:
    """The state of a policy in an episode.

    Attributes:
        steps: ring of the last `Policy.ring_size` steps, with normalised observations; None with a
            running carry.
        previous_action: [A], in the units of tokens; zero before the first step.
        time: int32 [], number of steps of the episode so far.
        carry: the memory's running carry, leaves [1, ...]; None without one.
    """

    steps: Steps | None
    previous_action: jax.Array
    time: jax.Array
    carry: Carry | None = None


@struct.dataclass
class Policy:
    """A deterministic actor with its window; it works under jit and vmap.

    Attributes:
        actor: the actor's parameters.
        bounds: the range of the environment's action.
        history_length: int32 [], l.
        centre_token: [A], the value in tokens for an action at the centre of its range: zero, but
            for policies of format 1 the centre in half ranges.
        algorithm: the name of the agent.
        window_tokens: past tokens in the window's arrays, at least l.
        observation_size: O.
        action_shape: shape of the environment's action.
        memory: the name of the recurrent cell.
        acting: ``window`` reads the last l steps at every step; ``carry`` updates the memory's
            carry from the start of the episode, and reads one token per step for any l.
        normaliser: normalises observations before the network reads them; None without one.
    """

    actor: Params
    bounds: Bounds
    history_length: jax.Array
    centre_token: jax.Array
    algorithm: str = struct.field(pytree_node=False)
    window_tokens: int = struct.field(pytree_node=False)
    observation_size: int = struct.field(pytree_node=False)
    action_shape: tuple[int, ...] = struct.field(pytree_node=False)
    memory: str = struct.field(pytree_node=False, default="lstm")
    acting: Acting = struct.field(pytree_node=False, default="window")
    normaliser: Normaliser | None = None

    @property
    def width(self) -> int:
        """H, the width of every layer."""
        return int(self.actor["head"]["bias"].shape[-1])

    @property
    def ring_size(self) -> int:
        """The number of steps that the state of a window holds."""
        return max(self.window_tokens, 1)

    @property
    def network(self) -> Network:
        """The actor as a module."""
        sizes = self.observation_size, int(np.prod(self.action_shape, dtype=int))
        return make_part(AGENTS[self.algorithm], "actor", self.memory, *sizes, self.width)

    def init(self, key: jax.Array | None = None) -> PolicyState:
        """The state before the first step of an episode; ``key`` is not used."""
        check_choice("acting", self.acting, ACTINGS)
        action_size = self.bounds.low.shape[0]
        has_running_carry = self.acting == "carry"
        return PolicyState(
            steps=None
            if has_running_carry
            else empty_steps(self.ring_size, self.observation_size, action_size),
            previous_action=jnp.zeros((action_size,), jnp.float32),
            time=jnp.int32(0),
            carry=self.network.zero_carry(1) if has_running_carry else None,
        )

    def step(self, state: PolicyState, observation: jax.Array) -> tuple[jax.Array, PolicyState]:
        """The action for ``observation`` [O], and the next state, which contains both.

        Outside `jax.jit` and `jax.vmap`, this method is compiled at the first call, and refuses
        observations that are not finite. In traced code it cannot refuse them, and they enter the
        state.

        Raises:
            UserError: when the observation is not finite, or has another size than in training; the
                state then stays unchanged.
        """
        traced = any(
            isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((self, state, observation))
        )
        if traced:
            observation = jnp.asarray(observation, jnp.float32)
            self._check_shape(observation.shape)
            return self._step(state, observation)
        with np.errstate(over="ignore"):
            reading = np.asarray(observation, np.float32)
        self._check_shape(reading.shape)
        if not np.isfinite(reading).all():
            raise UserError(
                f"the observation {reading.tolist()} is not finite, and the state is unchanged: "
                "step with the last valid observation, or start a new episode with policy.init()"
            )
        return _compiled_step(self, state, reading)

    def _check_shape(self, shape: tuple[int, ...]) -> None:
        expected = (self.observation_size,)
        if shape == expected:
            return
        if len(shape) == 2 and shape[1:] == expected:
            raise UserError(
                f"the policy steps one plant, with observations of shape {expected}, not {shape}: "
                "pass observation[0], or for a batch use jax.vmap(policy.step) with one state for "
                "each plant"
            )
        raise UserError(
            f"the policy expects observations of shape {expected}, not {shape}: it was trained on "
            "another environment"
        )

    def _step(self, state: PolicyState, observation: jax.Array) -> tuple[jax.Array, PolicyState]:
        observation = as_read(observation, self.normaliser)
        if state.steps is None:
            return self._step_with_carry(state, observation)
        time = state.time[None]
        window = window_at(
            state.steps,
            time,
            time,
            state.time,
            self.window_tokens,
            self.history_length,
            observation[None],
            state.previous_action[None],
        )
        action = act(self.network, self.actor, window)[0]
        token = action + self.centre_token
        steps = put_step(state.steps, state.time, Steps(observation, state.previous_action, token))
        time = state.time + jnp.int32(1)
        # Long before int32 overflows, the counter returns to an equal slot of the full ring.
        whole = _LONG // self.ring_size * self.ring_size - self.ring_size
        time = jnp.where(time >= _LONG, time - jnp.int32(whole), time)
        state = PolicyState(steps, token, time)
        return self.bounds.to_environment(action).reshape(self.action_shape), state

    def _step_with_carry(
        self, state: PolicyState, observation: jax.Array
    ) -> tuple[jax.Array, PolicyState]:
        network, window = self.network, present(observation[None], state.previous_action[None])
        action = act(network, self.actor, window, state.carry)[0]
        token = action + self.centre_token
        carry = state.carry
        if carry is not None:
            carry = advance(network, self.actor, window, token[None], carry)
        state = PolicyState(None, token, state.time + jnp.int32(1), carry)
        return self.bounds.to_environment(action).reshape(self.action_shape), state

    def save(self, path: str | os.PathLike, overwrite: bool = False) -> None:
        """Write the policy to a safetensors file, for `rtd3jax.load_policy`.

        Raises:
            UserError: when the file exists and ``overwrite`` is false, or cannot be written; when
                weights are not finite; for a batch of policies.
        """
        check_target(path, overwrite)
        write_new(path, array_bytes(self._arrays(), self._metadata()), overwrite)

    def export(self, path: str | os.PathLike, format: str, overwrite: bool = False) -> None:
        """Write the policy in a format that runs without rtd3jax.

        Args:
            path: the path of the file.
            format: ``onnx`` (needs the package onnx), ``stablehlo`` (needs flatbuffers; see
                `rtd3jax.load_stablehlo`) or ``numpy`` (one Python file with a class ``Player``).
            overwrite: whether to replace an existing file.

        Raises:
            UserError: as `save` does; for an unknown format; when its package is missing.
        """
        content_of = writer_of(format, str(path))
        check_target(path, overwrite)
        actor, reads = self._actor(), AGENTS[self.algorithm].actor
        cell = self.memory if reads.memory else None
        model = Model(
            memory=reads.memory,
            memory_has_current=reads.memory_has_current,
            current=reads.current,
            history_length=int(self.history_length),
            observation_size=self.observation_size,
            action_shape=self.action_shape,
            arrays=fold(
                actor,
                cell,
                self.bounds.low,
                self.bounds.high,
                self.centre_token,
                self.normaliser,
            ),
            metadata=self._metadata(),
            cell=cell,
            network=self.network,
            params=actor,
            acting=self.acting,
        )
        write_new(path, content_of(model), overwrite)

    def _actor(self) -> Params:
        """The parameters on the host, after a check that they are finite."""
        if self.history_length.ndim != 0:
            raise UserError("this is a batch of policies; save or export them one by one")
        actor = jax.tree.map(np.asarray, self.actor)
        for name, array in flatten(actor).items():
            if not np.all(np.isfinite(array)):
                raise UserError(f"the policy's weights are not finite ({name}); do not use it")
        return actor

    def _arrays(self) -> dict[str, np.ndarray]:
        """The arrays of a saved policy."""
        return {**flatten(self._actor()), **self._normaliser_arrays()}

    def _normaliser_arrays(self) -> dict[str, np.ndarray]:
        if self.normaliser is None:
            return {}
        names = ("mean", "scale")
        return {f"normaliser.{n}": np.asarray(getattr(self.normaliser, n)) for n in names}

    def parameters(self) -> dict[str, np.ndarray]:
        """All learned arrays under dotted names, ``actor...`` and ``normaliser...``."""
        return {**flatten(self.actor, "actor"), **self._normaliser_arrays()}

    def interface(self) -> dict[str, Any]:
        """Sizes and bounds of the policy's environment, as in the headers of files."""
        return {
            "observation_size": self.observation_size,
            "action_shape": list(self.action_shape),
            "action_low": np.asarray(self.bounds.low).tolist(),
            "action_high": np.asarray(self.bounds.high).tolist(),
        }

    @property
    def _format(self) -> int:
        if self.normaliser is not None:
            return NORMALISED_FORMAT
        return CARRY_FORMAT if self.acting == "carry" else FORMAT

    def _metadata(self) -> dict[str, Any]:
        """The header of a saved policy."""
        check_choice("acting", self.acting, ACTINGS)
        return {
            "kind": KIND,
            "format": self._format,
            "algorithm": self.algorithm,
            "history_length": int(self.history_length),
            **self.interface(),
            "centre_token": np.asarray(self.centre_token).tolist(),
            "hidden_size": self.width,
            "memory": self.memory,
            "acting": self.acting,
            "versions": versions_of(("rtd3jax", "jax", "jaxlib", "numpy")),
        }


@jax.jit
def _compiled_step(
    policy: Policy, state: PolicyState, observation: jax.Array
) -> tuple[jax.Array, PolicyState]:
    return policy._step(state, observation)
