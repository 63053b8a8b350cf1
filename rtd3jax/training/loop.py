"""The loop of one lane, as one jitted program: act, update, step, store, and evaluate.

The agent and the replay define the updates and the stored data. A transition can be sampled from
the next step on, because then the agent has acted on the next observation.
"""

import dataclasses
import functools
import math
import warnings
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from rtd3jax.agents.agent import Agent, make_agent
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.history import Steps, Window
from rtd3jax.agents.hyperparameters import Hyperparameters
from rtd3jax.agents.noise import add_noise
from rtd3jax.agents.normalise import Normaliser, Statistics, as_read, normalised
from rtd3jax.agents.replay import (
    Replay,
    Transition,
    Truth,
    keep_acting_carry,
    present_window,
    store,
)
from rtd3jax.agents.rows import where_rows
from rtd3jax.config import Config, traced_fields
from rtd3jax.envs.interface import action_bounds, foreign_code
from rtd3jax.evaluation.returns import episode_returns
from rtd3jax.policies.trained import Policy
from rtd3jax.protocols import EnvironmentLike
from rtd3jax.system.jax_settings import random_key
from rtd3jax.training.lane import (
    ACTION_NOT_FINITE,
    ENVIRONMENT_NOT_FINITE,
    HEALTHY,
    LOSS_NOT_FINITE,
    Lane,
    LaneState,
)
from rtd3jax.training.metrics import (
    Averages,
    averaged,
    empty_averages,
    metric_names,
    note_reward,
    note_update,
)

# Streams of a lane's random numbers; each number is folded into the lane's key once.
_INIT, _RESET, _STEPS, _EVALUATION, REVIVED = range(5)


@dataclasses.dataclass(frozen=True)
class Program:
    """The static part of a lane: lanes with equal programs share one compiled program.

    Attributes:
        env: the environment, compared by its `__eq__`.
        config: the configuration with traced fields at their defaults; see `static_part`.
        observation_size: O.
        action_shape: shape of the environment's action.
        true_observation_size: S; 0 if the environment does not give the undisturbed observation.
    """

    env: EnvironmentLike
    config: Config
    observation_size: int
    action_shape: tuple[int, ...]
    true_observation_size: int = 0

    @functools.cached_property
    def agent(self) -> Agent:
        """The agent of the configuration."""
        return make_agent(self.config, self)

    @property
    def action_size(self) -> int:
        """A, the number of elements of an action."""
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
        """K, the number of evaluations."""
        return -(-self.config.total_steps // self.config.eval_every)

    def init(self, lane: Lane) -> LaneState:
        """The lane before its first step."""
        key = random_key(lane.seed)
        observation, env_state = self.reset(jax.random.fold_in(key, _RESET), lane)
        count = self.config.environments
        return LaneState(
            learner=self.agent.init(jax.random.fold_in(key, _INIT)),
            replay=self.agent.empty_replay(),
            statistics=self.agent.no_statistics(),
            env_state=env_state,
            observation=observation.astype(jnp.float32),
            previous_action=jnp.zeros((count, self.action_size), jnp.float32),
            episode_step=jnp.zeros((count,), jnp.int32),
            carry=self.agent.zero_carry(),
            returns=jnp.full((self.evaluations,), jnp.nan, jnp.float32),
            true_returns=jnp.full((self.evaluations,), jnp.nan, jnp.float32),
            metrics=empty_averages(self.agent.metrics, self.evaluations, count),
            failure=jnp.int32(HEALTHY),
            failed_at=jnp.int32(-1),
            true_statistics=self.agent.no_true_statistics(),
        )

    def advance(self, lane: Lane, state: LaneState, start: jax.Array, stop: jax.Array) -> LaneState:
        """The lane after steps ``start`` to ``stop - 1`` (int32 []).

        The division of steps into calls has no effect on the result. Steps are counted over all
        environments, so ``start`` and ``stop`` are multiples of the number of environments.
        """
        count = self.config.environments
        return lax.fori_loop(
            start // count, stop // count, lambda step, s: self._step(lane, s, step), state
        )

    def policy(self, lane: Lane, state: LaneState) -> Policy:
        """The deterministic policy of the lane's actor."""
        return Policy(
            actor=state.learner.actor,
            normaliser=_normaliser(state.statistics),
            bounds=self.bounds(lane),
            history_length=lane.hyperparameters.history_length,
            centre_token=jnp.zeros((self.action_size,), jnp.float32),
            algorithm=self.config.algorithm,
            memory=self.config.memory,
            acting=self.config.acting_mode,
            window_tokens=self.window_tokens,
            observation_size=self.observation_size,
            action_shape=self.action_shape,
        )

    def bounds(self, lane: Lane) -> Bounds:
        """The range of the environment's action under the lane's environment parameters."""
        return Bounds(*action_bounds(self.env, lane.env_params))

    def _step(self, lane: Lane, state: LaneState, step: jax.Array) -> LaneState:
        hyperparameters = lane.hyperparameters
        root = random_key(lane.seed)
        act_key, learn_key, env_key = jax.random.split(
            jax.random.fold_in(jax.random.fold_in(root, _STEPS), step), 3
        )

        statistics = state.statistics
        if statistics is not None:
            statistics = self._noted(statistics, state.observation, step)
        true_statistics = state.true_statistics
        if true_statistics is not None:
            true_statistics = true_statistics.note(self._truth(state.env_state, lane))
        normaliser = _normaliser(statistics)
        window = self._window(lane, state, step, normaliser)
        greedy, kept = self.agent.act(state.learner.actor, window, state.carry)
        action = self._explore(greedy, act_key, hyperparameters, step)
        carry = self.agent.carry_after(state.learner.actor, window, action, state.carry)
        replay = keep_acting_carry(state.replay, step, state.episode_step, kept)

        normalisers = normaliser, _normaliser(true_statistics)
        learner, metrics, loss = self._learn(
            state.learner, replay, normalisers, state.metrics, learn_key, hyperparameters, step
        )

        observation, env_state, reward, terminated, truncated, info = self._transit(
            env_key, state.env_state, action, lane
        )
        final_observation = info["final_observation"].astype(jnp.float32)
        truth = None
        if self.agent.reads_truth:
            truth = Truth(self._truth(state.env_state, lane), info["true_observation"])
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
                truth=truth,
            ),
            done,
            final_carry=lambda: self.agent.final_carry(
                learner.actor,
                window,
                action,
                as_read(final_observation, normaliser),
                hyperparameters.history_length,
                carry,
            ),
            # Always false: a loss is never negative, and an action never exceeds one.
            never=(loss < 0.0) & jnp.all(action > 1.0),
        )
        # An action that is not finite is the actor's fault, unless its observation is not finite.
        strayed = _finite(state.observation) & ~_finite(action)
        finite = _finite((state.observation, final_observation, reward, truth))
        state = dataclasses.replace(
            state,
            learner=learner,
            replay=replay,
            statistics=statistics,
            true_statistics=true_statistics,
            env_state=env_state,
            observation=observation.astype(jnp.float32),
            previous_action=where_rows(done, 0.0, action),
            episode_step=jnp.where(done, 0, state.episode_step + 1).astype(jnp.int32),
            carry=jax.tree.map(functools.partial(where_rows, done, 0.0), carry),
            metrics=note_reward(metrics, reward, done),
        )
        at = step * self.config.environments
        state = _note_failure(state, at, strayed, ACTION_NOT_FINITE)
        state = _note_failure(state, at, ~finite, ENVIRONMENT_NOT_FINITE)
        state = _note_failure(state, at, ~jnp.isfinite(loss), LOSS_NOT_FINITE)
        return self._evaluate(lane, state, (step + 1) * self.config.environments)

    def _noted(self, before: Statistics, observations: jax.Array, step: jax.Array) -> Statistics:
        """The statistics after ``observations`` [E, O].

        A trained actor that is frozen, or is not updated yet, reads observations as it was trained
        to: the statistics with which it came stay.
        """
        after = before.note(observations)
        if not self.config.start:
            return after
        if "actor" in self.config.frozen:
            return before
        learns = step * self.config.environments >= self.config.first_actor_step
        return jax.tree.map(functools.partial(jnp.where, learns), after, before)

    def _window(
        self, lane: Lane, state: LaneState, step: jax.Array, normaliser: Normaliser | None
    ) -> Window:
        """The windows that the actor reads at the ``step`` of all environments."""
        present = present_window(
            state.replay,
            step,
            state.episode_step,
            state.observation,
            state.previous_action,
            self.agent.acting_tokens,
            lane.hyperparameters.history_length,
        )
        return normalised(present, normaliser)

    def cut(self, lane: Lane, state: LaneState, step: jax.Array) -> LaneState:
        """The state after its episodes are cut off before ``step`` of all environments.

        The replay then holds the carries at the cut. During an episode, `store` leaves this to the
        next step, but after a cut, the next step begins another episode.
        """
        window = self._window(lane, state, step, _normaliser(state.statistics))
        _, kept = self.agent.act(state.learner.actor, window, state.carry)
        replay = keep_acting_carry(state.replay, step, state.episode_step, kept)
        return dataclasses.replace(state, replay=replay)

    def reset(self, key: jax.Array, lane: Lane) -> tuple[jax.Array, Any]:
        """The first observations [E, O] of the environments, and their state."""
        with foreign_code():
            if self.config.environments == 1:
                observation, env_state = self.env.reset(key, lane.env_params)
                return observation[None], env_state
            keys = jax.random.split(key, self.config.environments)
            return jax.vmap(self.env.reset, (0, None))(keys, lane.env_params)

    def _transit(
        self, key: jax.Array, env_state: Any, action: jax.Array, lane: Lane
    ) -> tuple[jax.Array, Any, jax.Array, jax.Array, jax.Array, dict[str, jax.Array]]:
        """A step of each environment with its ``action`` [E, A].

        Returns:
            The next observations [E, O], the state, rewards, terminations and truncations [E], and
            the required entries of info: ``final_observation`` [E, O], the observations before
            automatic resets, and ``true_observation`` [E, S], if the critics read it.
        """
        wanted = ("final_observation", *["true_observation"] * self.agent.reads_truth)
        bounds = self.bounds(lane)

        def step(key: jax.Array, env_state: Any, action: jax.Array) -> tuple[Any, ...]:
            command = bounds.to_environment(action).reshape(self.action_shape)
            *found, info = self.env.step(key, env_state, command, lane.env_params)
            return *found, {name: info[name] for name in wanted}

        with foreign_code():
            if self.config.environments == 1:
                observation, env_state, *rest = step(key, env_state, action[0])
                alone = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], rest)
                return observation[None], env_state, *alone
            keys = jax.random.split(key, self.config.environments)
            return jax.vmap(step)(keys, env_state, action)

    def _truth(self, env_state: Any, lane: Lane) -> jax.Array:
        """The undisturbed observations [E, S] of the environments' states."""
        env: Any = self.env
        with foreign_code():
            if self.config.environments == 1:
                return env.true_observation(env_state, lane.env_params)[None]
            return jax.vmap(env.true_observation, (0, None))(env_state, lane.env_params)

    def _explore(
        self, greedy: jax.Array, key: jax.Array, hyperparameters: Hyperparameters, step: jax.Array
    ) -> jax.Array:
        """The actions [E, A]: uniform before learning starts, then the agent's with noise.

        A lane that starts from trained networks uses its policy from the first step on.
        """
        uniform_key, noise_key = jax.random.split(key)
        noisy = add_noise(noise_key, greedy, hyperparameters.exploration_noise)
        if self.config.start:  # the actor is already trained
            return noisy
        uniform = jax.random.uniform(uniform_key, noisy.shape, jnp.float32, -1.0, 1.0)
        starts = self.config.learning_starts
        return jnp.where(step * self.config.environments < starts, uniform, noisy)

    def _learn(
        self,
        learner: Any,
        replay: Replay,
        normalisers: tuple[Normaliser | None, Normaliser | None],
        metrics: Averages,
        key: jax.Array,
        hyperparameters: Hyperparameters,
        step: jax.Array,
    ) -> tuple[Any, Averages, jax.Array]:
        """The updates of the step, if any, and the critics' loss [], 0 without updates.

        ``normalisers`` are those of observations and of undisturbed observations.
        """
        config = self.config
        count = step * config.environments
        hyperparameters = hyperparameters.decayed(count.astype(jnp.float32) / config.total_steps)
        since = step - config.first_learning_step
        due = (since >= 0) & (since % config.steps_per_round == 0)
        done = (since // config.steps_per_round) * config.updates_per_round

        def update(
            learner: Any, metrics: Averages, keys: jax.Array, number: jax.Array
        ) -> tuple[Any, Averages, jax.Array]:
            history_length = hyperparameters.history_length
            batch = self.agent.sample(replay, keys[0], count, history_length, *normalisers)
            learner, found = self.agent.update(learner, batch, keys[1:], hyperparameters, number)
            return learner, note_update(metrics, found), found["critic_loss"].total

        def learn(learner: Any, metrics: Averages) -> tuple[Any, Averages, jax.Array]:
            if config.updates_per_round == 1:
                return update(learner, metrics, jax.random.split(key, 3), done + 1)

            def another(index: jax.Array, so_far: tuple[Any, Averages, jax.Array]):
                learner, metrics, total = so_far
                keys = jax.random.split(jax.random.fold_in(key, index), 3)
                learner, metrics, loss = update(learner, metrics, keys, done + index + 1)
                return learner, metrics, total + loss

            first = learner, metrics, jnp.float32(0.0)
            return lax.fori_loop(0, config.updates_per_round, another, first)

        def wait(learner: Any, metrics: Averages) -> tuple[Any, Averages, jax.Array]:
            return learner, metrics, jnp.float32(0.0)

        # The step is the same in all lanes, so that this stays a branch under vmap.
        return lax.cond(due, learn, wait, learner, metrics)

    def _evaluate(self, lane: Lane, state: LaneState, done_steps: jax.Array) -> LaneState:
        """The evaluation at intervals and at the end, with its own random stream."""
        config = self.config

        def evaluate(curves):
            returns, true_returns, metrics = curves
            key = jax.random.fold_in(random_key(lane.seed), _EVALUATION)
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
    true_observation_size: int = 0,
) -> Program:
    """The program of lanes that only differ in traced numbers; see `static_part`."""
    static = static_part(config, window)
    return Program(env, static, observation_size, action_shape, true_observation_size)


def static_part(config: Config, window: int | None = None) -> Config:
    """The configuration of the program of lanes that only differ in traced numbers.

    With ``window``, lanes may also differ in their history length, up to ``window``: the arrays of
    the window have this length, and tokens beyond the history length of a lane do not exist for it.
    Segments, which begin with a stored carry, use the burn-in of their own configuration.
    """
    defaults = {name: getattr(Config, name) for name in traced_fields()}
    if window is not None and config.has_window and config.replay == "windows":
        defaults["history_length"] = window
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the configuration has given its warnings already
        return dataclasses.replace(config, **defaults, start=config.start and "trained")


def _normaliser(statistics: Statistics | None) -> Normaliser | None:
    return None if statistics is None else statistics.normaliser()


def _finite(values: Any) -> jax.Array:
    """Whether all elements of all arrays are finite, bool []."""
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in jax.tree.leaves(values)]))


def _note_failure(state: LaneState, step: jax.Array, seen: jax.Array, code: int) -> LaneState:
    first = seen & (state.failure == HEALTHY)
    return dataclasses.replace(
        state,
        failure=jnp.where(first, code, state.failure).astype(jnp.int32),
        failed_at=jnp.where(first, step, state.failed_at).astype(jnp.int32),
    )
