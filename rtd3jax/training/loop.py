"""One lane: act, learn, step, store; and evaluate now and then. All of it is one jitted loop.

The order within a step lets h-td3 find every carry where it looks for it: a transition can be
sampled from the step after it, when the behaviour actor has computed the carry of its successor.
"""

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax

from rtd3jax.agents.lstm import Carry, zero_carry
from rtd3jax.agents.networks import carry_before
from rtd3jax.agents.replay import (
    Replay,
    Transition,
    empty_replay,
    put_carry,
    put_transition,
    sample,
)
from rtd3jax.agents.td3 import (
    Bounds,
    Hyperparameters,
    Learner,
    act,
    add_noise,
    init_learner,
    update_actor_and_targets,
    update_critics,
)
from rtd3jax.agents.variants import VARIANTS
from rtd3jax.agents.windows import Steps, Window, next_window, past_tokens
from rtd3jax.config import Config, traced_fields
from rtd3jax.envs.interface import action_bounds, foreign_code
from rtd3jax.evaluate import episode_returns
from rtd3jax.policy import Policy

HEALTHY, ENVIRONMENT_NOT_FINITE, LOSS_NOT_FINITE = 0, 1, 2

# Streams of a lane's random numbers; each is folded into the lane's key once.
_INIT, _RESET, _STEPS, _EVALUATION = range(4)


@struct.dataclass
class Lane:
    """What tells lanes of one program apart.

    Attributes:
        seed: uint32 [].
        hyperparameters: numbers of the configuration.
        env_params: the environment's parameters.
    """

    seed: jax.Array
    hyperparameters: Hyperparameters
    env_params: Any


@struct.dataclass
class LaneState:
    """Everything that a lane is between two steps. ``K`` evaluations.

    Attributes:
        learner: networks and optimisers.
        replay: what was seen.
        env_state: the environment's own.
        observation: [O], the one to act upon.
        previous_action: [A], in half ranges as all actions of an agent; zero at an episode's start.
        age: int32 [], steps done in the episode.
        returns: [K], mean return of each evaluation so far.
        true_returns: [K], the same of the undisturbed state's reward.
        failure: int32 [], HEALTHY, or what was first seen not to be finite.
        failed_at: int32 [], the step of that.
    """

    learner: Learner
    replay: Replay
    env_state: Any
    observation: jax.Array
    previous_action: jax.Array
    age: jax.Array
    returns: jax.Array
    true_returns: jax.Array
    failure: jax.Array
    failed_at: jax.Array


@dataclasses.dataclass(frozen=True)
class Program:
    """What is static: lanes with equal programs share one compilation.

    Attributes:
        env: the environment, compared by its `__eq__`.
        config: with traced fields at their defaults; see `make_program`.
        observation_size: O.
        action_shape: shape of the environment's action.
    """

    env: Any
    config: Config
    observation_size: int
    action_shape: tuple[int, ...]

    @property
    def tokens(self) -> int:
        """Past tokens in the window's arrays."""
        assert self.config.history_length is not None
        return self.config.history_length

    @property
    def evaluations(self) -> int:
        """K."""
        return -(-self.config.total_steps // self.config.eval_every)

    def init(self, lane: Lane) -> LaneState:
        """The lane before its first step."""
        config = self.config
        key = jax.random.key(lane.seed)
        with foreign_code():
            observation, env_state = self.env.reset(
                jax.random.fold_in(key, _RESET), lane.env_params
            )
        bounds = self.bounds(lane)
        action_size = bounds.low.shape[0]
        variant = VARIANTS[config.algorithm]
        assert config.replay_capacity is not None
        return LaneState(
            learner=init_learner(
                jax.random.fold_in(key, _INIT),
                variant,
                self.observation_size,
                action_size,
                config.hidden_size,
            ),
            replay=empty_replay(
                config.replay_capacity,
                self.observation_size,
                action_size,
                config.hidden_size if variant.stores_carry else None,
            ),
            env_state=env_state,
            observation=observation.astype(jnp.float32),
            previous_action=jnp.zeros((action_size,), jnp.float32),
            age=jnp.int32(0),
            returns=jnp.full((self.evaluations,), jnp.nan, jnp.float32),
            true_returns=jnp.full((self.evaluations,), jnp.nan, jnp.float32),
            failure=jnp.int32(HEALTHY),
            failed_at=jnp.int32(-1),
        )

    def advance(self, lane: Lane, state: LaneState, start: jax.Array, stop: jax.Array) -> LaneState:
        """The lane after steps ``start`` to ``stop - 1`` (int32 []), however they are cut."""
        return lax.fori_loop(start, stop, lambda step, s: self._step(lane, s, step), state)

    def policy(self, lane: Lane, actor: Any) -> Policy:
        """The deterministic policy of these actor parameters."""
        return Policy(
            actor=actor,
            bounds=self.bounds(lane),
            history_length=lane.hyperparameters.history_length,
            centre_token=jnp.zeros((math.prod(self.action_shape),), jnp.float32),
            algorithm=self.config.algorithm,
            tokens=self.tokens,
            observation_size=self.observation_size,
            action_shape=self.action_shape,
        )

    def bounds(self, lane: Lane) -> Bounds:
        """The range of the environment's action under the lane's environment parameters."""
        return Bounds(*action_bounds(self.env, lane.env_params))

    def _step(self, lane: Lane, state: LaneState, step: jax.Array) -> LaneState:
        variant, numbers = VARIANTS[self.config.algorithm], lane.hyperparameters
        root = jax.random.key(lane.seed)
        act_key, learn_key, env_key = jax.random.split(
            jax.random.fold_in(jax.random.fold_in(root, _STEPS), step), 3
        )

        window = self._window(state, step, numbers.history_length)
        carry = None
        replay = state.replay
        if variant.stores_carry:
            carry = carry_before(state.learner.actor, variant.actor, window)
            replay = _keep_carry(replay, step, carry, state.age)
        action = self._act(state.learner, window, carry, act_key, numbers, step)

        learner, loss = self._learn(state.learner, replay, learn_key, numbers, step)

        command = self.bounds(lane).to_environment(action).reshape(self.action_shape)
        with foreign_code():
            observation, env_state, reward, terminated, truncated, info = self.env.step(
                env_key, state.env_state, command, lane.env_params
            )
        final_observation = info["final_observation"].astype(jnp.float32)
        reward = reward.astype(jnp.float32)
        done = terminated.astype(bool) | truncated.astype(bool)
        # Losses are not negative, and actions not above one.
        never = (loss < 0.0) & jnp.all(action > 1.0)
        replay = put_transition(
            replay,
            _after(step, never),
            Transition(
                step=Steps(state.observation, state.previous_action, action),
                reward=reward,
                next_observation=final_observation,
                terminated=terminated.astype(bool),
                age=state.age,
            ),
        )
        if variant.stores_carry:
            replay = self._keep_final_carry(
                replay, learner, window, action, final_observation, numbers, done, step
            )
        finite = jnp.all(jnp.isfinite(final_observation)) & jnp.isfinite(reward)
        state = dataclasses.replace(
            state,
            learner=learner,
            replay=replay,
            env_state=env_state,
            observation=observation.astype(jnp.float32),
            previous_action=jnp.where(done, 0.0, action),
            age=jnp.where(done, 0, state.age + 1).astype(jnp.int32),
        )
        state = _note_failure(state, step, ~finite, ENVIRONMENT_NOT_FINITE)
        state = _note_failure(state, step, ~jnp.isfinite(loss), LOSS_NOT_FINITE)
        return self._evaluate(lane, state, step + 1)

    def _window(self, state: LaneState, step: jax.Array, history_length: jax.Array) -> Window:
        past, length = past_tokens(
            state.replay.transitions.step, step[None], state.age[None], step, self.tokens
        )
        return Window(
            past=past,
            length=jnp.minimum(length, history_length),
            observation=state.observation[None],
            previous_action=state.previous_action[None],
        )

    def _act(self, learner, window, carry, key, numbers, step) -> jax.Array:
        """Uniform before learning starts, then the actor's action with noise: [A]."""
        uniform_key, noise_key = jax.random.split(key)
        greedy = act(learner.actor, VARIANTS[self.config.algorithm], window, carry)
        noisy = add_noise(noise_key, greedy, numbers.exploration_noise)[0]
        uniform = jax.random.uniform(uniform_key, noisy.shape, jnp.float32, -1.0, 1.0)
        return jnp.where(step < self.config.learning_starts, uniform, noisy)

    def _learn(self, learner, replay, key, numbers, step) -> tuple[Learner, jax.Array]:
        """The step's updates, if it has any; the critics' loss."""
        config = self.config
        variant = VARIANTS[config.algorithm].at(config.precision)
        sample_key, target_key, actor_key = jax.random.split(key, 3)
        since = step - config.learning_starts
        due = (since >= 0) & (since % config.update_every == 0)
        updates = since // config.update_every + 1
        numbers = numbers.at(step.astype(jnp.float32) / config.total_steps)

        def learn(learner):
            batch = sample(
                replay, sample_key, step, config.batch_size, self.tokens, numbers.history_length
            )
            learner, loss = update_critics(learner, variant, batch, target_key, numbers)
            learner = lax.cond(
                updates % config.policy_delay == 0,
                lambda before: update_actor_and_targets(before, variant, batch, actor_key, numbers),
                lambda before: before,
                learner,
            )
            return learner, loss

        # The step is common to all lanes, so that this stays a branch under vmap.
        return lax.cond(due, learn, lambda same: (same, jnp.float32(0.0)), learner)

    def _keep_final_carry(
        self, replay, learner, window, action, final_observation, numbers, done, step
    ) -> Replay:
        """The carry of an episode's final observation, in the slot that the next start leaves free.

        Within an episode the next step's own carry takes the slot.
        """

        def final(_):
            after = next_window(
                window, action[None], final_observation[None], numbers.history_length
            )
            return carry_before(learner.actor, VARIANTS[self.config.algorithm].actor, after)

        width = self.config.hidden_size
        carry = lax.cond(done, final, lambda _: zero_carry(1, width), None)
        return put_carry(replay, step + 1, Carry(carry.hidden[0], carry.cell[0]))

    def _evaluate(self, lane: Lane, state: LaneState, done_steps: jax.Array) -> LaneState:
        """The periodic evaluation, on a stream of its own; also at the very end."""
        config = self.config

        def evaluate(curves):
            key = jax.random.fold_in(jax.random.key(lane.seed), _EVALUATION)
            policy = self.policy(lane, state.learner.actor)
            totals = episode_returns(
                policy,
                self.env,
                lane.env_params,
                jax.random.fold_in(key, done_steps),
                config.eval_episodes,
            )
            index = (done_steps - 1) // config.eval_every
            return tuple(
                curve.at[index].set(jnp.mean(total))
                for curve, total in zip(curves, totals, strict=True)
            )

        due = (done_steps % config.eval_every == 0) | (done_steps == config.total_steps)
        curves = (state.returns, state.true_returns)
        returns, true_returns = lax.cond(due, evaluate, lambda c: c, curves)
        return dataclasses.replace(state, returns=returns, true_returns=true_returns)


def make_program(
    env: Any,
    config: Config,
    observation_size: int,
    action_shape: tuple[int, ...],
    window: int | None = None,
) -> Program:
    """The program of lanes that differ in nothing but traced numbers.

    With ``window``, lanes may differ in their history length too, up to that: the window's arrays
    are as long, and what is beyond a lane's own length does not exist for it.
    """
    defaults = {name: getattr(Config, name) for name in traced_fields()}
    static = dataclasses.replace(config, **defaults)
    if window is not None and config.algorithm != "td3":
        static = dataclasses.replace(static, history_length=window)
    return Program(env, static, observation_size, action_shape)


def make_lane(config: Config, seed: int, env_params: Any) -> Lane:
    """A lane of `make_program`'s program, with concrete arrays for leaves."""
    numbers = {name: jnp.float32(getattr(config, name)) for name in traced_fields()}
    numbers["history_length"] = jnp.int32(config.history_length)
    env_params = jax.tree.map(_array, env_params)
    return Lane(jnp.uint32(seed), Hyperparameters(**numbers), env_params)


def _array(leaf: Any) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32 if isinstance(leaf, float) else None)


@jax.custom_batching.custom_vmap
def _after(number: jax.Array, never: jax.Array) -> jax.Array:
    """``number``, but known only when ``never`` (always false) is.

    A row that is written by it is written after what ``never`` was computed from has read the
    ring. Where XLA sees no such order, it copies the whole ring at every step to be safe; an
    optimization barrier does not tell it, since that is removed before copies are decided upon.
    """
    return number + never.astype(number.dtype)


@_after.def_vmap
def _after_of_lanes(axis_size, batched, number, never):
    # One number for all lanes, lest the write become a scatter.
    assert not batched[0]
    return _after(number, jnp.any(never)), False


def _keep_carry(replay: Replay, step: jax.Array, carry: Carry, age: jax.Array) -> Replay:
    """Keep the acting carry; not a first one, whose slot holds the last episode's final carry."""
    assert replay.carries is not None
    slot = step % replay.carries.hidden.shape[0]
    row = Carry(
        *(
            jnp.where(age == 0, kept[slot].astype(new.dtype), new[0])
            for kept, new in zip(replay.carries, carry, strict=True)
        )
    )
    return put_carry(replay, step, row)


def _note_failure(state: LaneState, step: jax.Array, seen: jax.Array, code: int) -> LaneState:
    first = seen & (state.failure == HEALTHY)
    return dataclasses.replace(
        state,
        failure=jnp.where(first, code, state.failure).astype(jnp.int32),
        failed_at=jnp.where(first, step, state.failed_at).astype(jnp.int32),
    )
