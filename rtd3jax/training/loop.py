"""One lane: act, learn, step, store, and evaluate at intervals. All of it is one jitted loop.

What is learned, and what must be kept for it, are the agent's and the replay's to know. A
transition can be sampled from the step after it, when the agent has acted upon its successor.
"""

import dataclasses
import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct
from jax import lax
from jax.typing import ArrayLike

from rtd3jax.agents.agent import Agent, make_agent
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.history import Steps
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.memory.base import Carry
from rtd3jax.agents.noise import add_noise
from rtd3jax.agents.normalise import Normaliser, Statistics, as_read, normalised
from rtd3jax.agents.replay import (
    Replay,
    Transition,
    keep_acting_carry,
    present_window,
    store,
)
from rtd3jax.config import Config, traced_fields
from rtd3jax.envs.interface import action_bounds, foreign_code
from rtd3jax.evaluation.rollout import episode_returns
from rtd3jax.policies.trained import Policy
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.training.metrics import (
    Averages,
    averaged,
    empty_averages,
    metric_names,
    note_reward,
    note_update,
)

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
        learner: networks and optimisers, as the agent's learner keeps them.
        replay: what was seen.
        statistics: of the observations seen, where networks read them normalised; else None.
        env_state: the environment's own.
        observation: [O], the one to act upon.
        previous_action: [A], in half ranges as all actions of an agent; zero at an episode's start.
        episode_step: int32 [], steps done in the episode.
        carry: the actor's, leaves [1, ...], where it runs on from the episode's start; else None.
        returns: [K], mean return of each evaluation so far.
        true_returns: [K], the same of the undisturbed state's reward.
        metrics: of learning, averaged over each interval between evaluations.
        failure: int32 [], HEALTHY, or what was first seen not to be finite.
        failed_at: int32 [], the step of that.
    """

    learner: Any
    replay: Replay
    statistics: Statistics | None
    env_state: Any
    observation: jax.Array
    previous_action: jax.Array
    episode_step: jax.Array
    carry: Carry | None
    returns: jax.Array
    true_returns: jax.Array
    metrics: Averages
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

    env: EnvironmentLike
    config: Config
    observation_size: int
    action_shape: tuple[int, ...]

    @functools.cached_property
    def agent(self) -> Agent:
        """The agent of the configuration."""
        return make_agent(self.config, self)

    @property
    def action_size(self) -> int:
        """A."""
        return math.prod(self.action_shape)

    @property
    def window_tokens(self) -> int:
        """Past tokens in the window's arrays."""
        return self.config.window_tokens

    @property
    def metric_names(self) -> tuple[str, ...]:
        """Names of the metrics of learning, in the order of their curves."""
        return metric_names(self.agent.metrics)

    @property
    def evaluations(self) -> int:
        """K."""
        return -(-self.config.total_steps // self.config.eval_every)

    def init(self, lane: Lane) -> LaneState:
        """The lane before its first step."""
        key = jax.random.key(lane.seed)
        with foreign_code():
            observation, env_state = self.env.reset(
                jax.random.fold_in(key, _RESET), lane.env_params
            )
        return LaneState(
            learner=self.agent.init(jax.random.fold_in(key, _INIT)),
            replay=self.agent.empty_replay(),
            statistics=self.agent.no_statistics(),
            env_state=env_state,
            observation=observation.astype(jnp.float32),
            previous_action=jnp.zeros((self.action_size,), jnp.float32),
            episode_step=jnp.int32(0),
            carry=self.agent.zero_carry(),
            returns=jnp.full((self.evaluations,), jnp.nan, jnp.float32),
            true_returns=jnp.full((self.evaluations,), jnp.nan, jnp.float32),
            metrics=empty_averages(self.agent.metrics, self.evaluations),
            failure=jnp.int32(HEALTHY),
            failed_at=jnp.int32(-1),
        )

    def advance(self, lane: Lane, state: LaneState, start: jax.Array, stop: jax.Array) -> LaneState:
        """The lane after steps ``start`` to ``stop - 1`` (int32 []), however they are cut."""
        return lax.fori_loop(start, stop, lambda step, s: self._step(lane, s, step), state)

    def policy(self, lane: Lane, state: LaneState) -> Policy:
        """The deterministic policy that the lane has learned."""
        return Policy(
            actor=state.learner.actor,
            normaliser=_normaliser(state.statistics),
            bounds=self.bounds(lane),
            history_length=lane.hyperparameters.history_length,
            centre_token=jnp.zeros((self.action_size,), jnp.float32),
            algorithm=self.config.algorithm,
            memory=self.config.memory,
            acting="carry" if self.config.runs_on else "window",
            window_tokens=self.window_tokens,
            observation_size=self.observation_size,
            action_shape=self.action_shape,
        )

    def bounds(self, lane: Lane) -> Bounds:
        """The range of the environment's action under the lane's environment parameters."""
        return Bounds(*action_bounds(self.env, lane.env_params))

    def _step(self, lane: Lane, state: LaneState, step: jax.Array) -> LaneState:
        hyperparameters = lane.hyperparameters
        root = jax.random.key(lane.seed)
        act_key, learn_key, env_key = jax.random.split(
            jax.random.fold_in(jax.random.fold_in(root, _STEPS), step), 3
        )

        statistics = state.statistics
        if statistics is not None:
            statistics = statistics.note(state.observation)
        normaliser = _normaliser(statistics)
        present = present_window(
            state.replay,
            step,
            state.episode_step,
            state.observation,
            state.previous_action,
            self.agent.acting_tokens,
            hyperparameters.history_length,
        )
        window = normalised(present, normaliser)
        greedy, kept = self.agent.act(state.learner.actor, window, state.carry)
        action = self._explore(greedy, act_key, hyperparameters, step)
        carry = self.agent.carry_after(state.learner.actor, window, action[None], state.carry)
        replay = keep_acting_carry(state.replay, step, state.episode_step, kept)

        learner, metrics, loss = self._learn(
            state.learner, replay, normaliser, state.metrics, learn_key, hyperparameters, step
        )

        command = self.bounds(lane).to_environment(action).reshape(self.action_shape)
        with foreign_code():
            observation, env_state, reward, terminated, truncated, info = self.env.step(
                env_key, state.env_state, command, lane.env_params
            )
        final_observation = info["final_observation"].astype(jnp.float32)
        reward = reward.astype(jnp.float32)
        done = terminated.astype(bool) | truncated.astype(bool)

        replay = store(
            replay,
            step,
            Transition(
                step=Steps(state.observation, state.previous_action, action),
                reward=reward,
                next_observation=final_observation,
                terminated=terminated.astype(bool),
                episode_step=state.episode_step,
            ),
            done,
            final_carry=lambda: self.agent.final_carry(
                learner.actor,
                window,
                action[None],
                as_read(final_observation[None], normaliser),
                hyperparameters.history_length,
                carry,
            ),
            # Losses are not negative, and actions not above one.
            never=(loss < 0.0) & jnp.all(action > 1.0),
        )
        finite = jnp.all(jnp.isfinite(final_observation)) & jnp.isfinite(reward)
        state = dataclasses.replace(
            state,
            learner=learner,
            replay=replay,
            statistics=statistics,
            env_state=env_state,
            observation=observation.astype(jnp.float32),
            previous_action=jnp.where(done, 0.0, action),
            episode_step=jnp.where(done, 0, state.episode_step + 1).astype(jnp.int32),
            carry=jax.tree.map(lambda part: jnp.where(done, 0.0, part), carry),
            metrics=note_reward(metrics, reward, done),
        )
        state = _note_failure(state, step, ~finite, ENVIRONMENT_NOT_FINITE)
        state = _note_failure(state, step, ~jnp.isfinite(loss), LOSS_NOT_FINITE)
        return self._evaluate(lane, state, step + 1)

    def _explore(
        self, greedy: jax.Array, key: jax.Array, hyperparameters: Hyperparameters, step: jax.Array
    ) -> jax.Array:
        """Uniform before learning starts, then the agent's action [1, A] with noise: [A].

        A lane that goes on from a trained policy acts by it from its first step.
        """
        uniform_key, noise_key = jax.random.split(key)
        noisy = add_noise(noise_key, greedy, hyperparameters.exploration_noise)[0]
        if self.config.start:  # it can act already
            return noisy
        uniform = jax.random.uniform(uniform_key, noisy.shape, jnp.float32, -1.0, 1.0)
        return jnp.where(step < self.config.learning_starts, uniform, noisy)

    def _learn(
        self,
        learner: Any,
        replay: Replay,
        normaliser: Normaliser | None,
        metrics: Averages,
        key: jax.Array,
        hyperparameters: Hyperparameters,
        step: jax.Array,
    ) -> tuple[Any, Averages, jax.Array]:
        """The step's update, if it has one; its critics' loss [], 0 without one."""
        config = self.config
        keys = jax.random.split(key, 3)
        since = step - config.learning_starts
        due = (since >= 0) & (since % config.update_every == 0)
        count = since // config.update_every + 1
        hyperparameters = hyperparameters.decayed(step.astype(jnp.float32) / config.total_steps)

        def learn(learner: Any, metrics: Averages) -> tuple[Any, Averages, jax.Array]:
            batch = self.agent.sample(
                replay, keys[0], step, hyperparameters.history_length, normaliser
            )
            learner, found = self.agent.update(learner, batch, keys[1:], hyperparameters, count)
            return learner, note_update(metrics, found), found["critic_loss"].total

        def wait(learner: Any, metrics: Averages) -> tuple[Any, Averages, jax.Array]:
            return learner, metrics, jnp.float32(0.0)

        # The step is common to all lanes, so that this stays a branch under vmap.
        return lax.cond(due, learn, wait, learner, metrics)

    def _evaluate(self, lane: Lane, state: LaneState, done_steps: jax.Array) -> LaneState:
        """The periodic evaluation, on a stream of its own; also at the very end."""
        config = self.config

        def evaluate(curves):
            returns, true_returns, metrics = curves
            key = jax.random.fold_in(jax.random.key(lane.seed), _EVALUATION)
            policy = self.policy(lane, state)
            totals = episode_returns(
                policy,
                self.env,
                lane.env_params,
                jax.random.fold_in(key, done_steps),
                config.eval_episodes,
            )
            index = (done_steps - 1) // config.eval_every
            curves = (
                curve.at[index].set(jnp.mean(total))
                for curve, total in zip((returns, true_returns), totals, strict=True)
            )
            return *curves, averaged(metrics, index)

        due = (done_steps % config.eval_every == 0) | (done_steps == config.total_steps)
        curves = (state.returns, state.true_returns, state.metrics)
        returns, true_returns, metrics = lax.cond(due, evaluate, lambda c: c, curves)
        return dataclasses.replace(
            state, returns=returns, true_returns=true_returns, metrics=metrics
        )


def make_program(
    env: EnvironmentLike,
    config: Config,
    observation_size: int,
    action_shape: tuple[int, ...],
    window: int | None = None,
) -> Program:
    """The program of lanes that differ in nothing but traced numbers.

    With ``window``, lanes may differ in their history length too, up to that: the window's arrays
    are as long, and what is beyond a lane's own length does not exist for it. Segments, which begin
    with a stored carry, have the burn-in of their own configuration.
    """
    defaults = {name: getattr(Config, name) for name in traced_fields()}
    static = dataclasses.replace(config, **defaults, start=config.start and "trained")
    if window is not None and config.has_window and config.replay == "windows":
        static = dataclasses.replace(static, history_length=window)
    return Program(env, static, observation_size, action_shape)


def make_lane(config: Config, seed: int, env_params: object) -> Lane:
    """A lane of `make_program`'s program, with concrete arrays for leaves."""
    numbers = {name: jnp.float32(getattr(config, name)) for name in traced_fields()}
    numbers["history_length"] = jnp.int32(config.window_tokens)
    env_params = jax.tree.map(_array, env_params)
    return Lane(jnp.uint32(seed), Hyperparameters(**numbers), env_params)


def _array(leaf: ArrayLike) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32 if isinstance(leaf, float) else None)


def _normaliser(statistics: Statistics | None) -> Normaliser | None:
    return None if statistics is None else statistics.normaliser()


def _note_failure(state: LaneState, step: jax.Array, seen: jax.Array, code: int) -> LaneState:
    first = seen & (state.failure == HEALTHY)
    return dataclasses.replace(
        state,
        failure=jnp.where(first, code, state.failure).astype(jnp.int32),
        failed_at=jnp.where(first, step, state.failed_at).astype(jnp.int32),
    )
