"""The PyTorch reference's environment and replay, in numpy: the rover under AR(1) slip, and a ring.

Shapes: ``C`` capacity, ``B`` batch, ``L`` past tokens, ``O`` and ``A`` sizes of an observation and
an action, ``H`` width. A token is a row (previous action | observation | action) of W = O + 2 A
numbers, in this order, so that the inputs of any network are one slice.
"""

from typing import NamedTuple

import numpy as np

OBSERVATION_SIZE = ACTION_SIZE = 2
EPISODE_STEPS = 200
ACTION_LOW, ACTION_HIGH = -1.0, 1.0
_WHEELBASE, _TARGET_SPEED, _MAX_SLIP, _RHO, _SIGMA = 0.5, 0.5, 0.5, 0.95, 0.05


class Rover:
    """The environment `rtd3jax.make("rover", "ar1-slip")` in Python floats."""

    def __init__(self, random: np.random.Generator):
        self._random = random

    def reset(self) -> np.ndarray:
        """Start at rest and draw the slip; return the observation [2]."""
        self._left, self._right = self._random.uniform(0.0, _MAX_SLIP, 2).tolist()
        self._time = 0
        return np.array([-_TARGET_SPEED, 0.0], np.float32)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool]:
        """Observation [2], reward, and whether the time limit is reached; it never terminates."""
        speed, yaw_rate = (min(max(a, ACTION_LOW), ACTION_HIGH) for a in action.tolist())
        turn = 0.5 * _WHEELBASE * yaw_rate
        left = (1.0 - self._left) * (speed - turn)
        right = (1.0 - self._right) * (speed + turn)
        first, second = self._random.standard_normal(2).tolist()
        self._left = min(max(_RHO * self._left + _SIGMA * first, 0.0), _MAX_SLIP)
        self._right = min(max(_RHO * self._right + _SIGMA * second, 0.0), _MAX_SLIP)
        self._time += 1
        errors = 0.5 * (left + right) - _TARGET_SPEED, (right - left) / _WHEELBASE
        reward = -(errors[0] ** 2 + errors[1] ** 2)
        return np.array(errors, np.float32), reward, self._time >= EPISODE_STEPS


class Window(NamedTuple):
    """The inputs of a network, except the current action, at one step of each of B episodes."""

    past: np.ndarray
    """[L, B, W], oldest first"""
    missing: np.ndarray
    """[L + 1, B, 1], one for a past token that does not exist; zero for the last, current token"""
    current: np.ndarray
    """[B, A + O]: previous action and observation"""


class Batch(NamedTuple):
    """Sampled transitions; carries are [B, 2, H] (hidden, cell), only for h-td3."""

    window: Window
    action: np.ndarray
    reward: np.ndarray
    terminated: np.ndarray
    next_window: Window
    carry: np.ndarray | None
    next_carry: np.ndarray | None


class Ring:
    """A replay of C rows; row number n, an environment step, is in slot n % C.

    Carries have C + 1 slots: the carry of row n is also the next carry of row n - 1. At the start
    of an episode, the slot holds the carry before the final observation of the previous episode.
    """

    def __init__(
        self, capacity: int, observation_size: int, action_size: int, width: int | None = None
    ):
        self._capacity = capacity
        self._split = action_size + observation_size
        self._observation_size = observation_size
        self.count = 0
        self._tokens = np.zeros((capacity, self._split + action_size), np.float32)
        # next observation | reward | terminated | age
        self._outcomes = np.zeros((capacity, observation_size + 3), np.float32)
        self._carries = None
        if width is not None:
            self._carries = np.zeros((capacity + 1, 2, width), np.float32)

    def put(
        self, previous_action, observation, action, reward, after, terminated, episode_step
    ) -> None:
        """Write the next row."""
        slot = self.count % self._capacity
        self._tokens[slot] = (*previous_action, *observation, *action)
        self._outcomes[slot] = (*after, reward, terminated, episode_step)
        self.count += 1

    def put_carry(self, number: int, carry: np.ndarray) -> None:
        """The behaviour actor's carry [2, H] before step ``number``."""
        self._carries[number % (self._capacity + 1)] = carry

    def past(self, number: np.ndarray, episode_step: np.ndarray, length: int) -> tuple:
        """Tokens [L, B, W] before the steps ``number`` [B], and how many exist, [B]."""
        offsets = np.arange(-length, 0)[:, None]
        oldest = max(self.count - self._capacity, 0)
        exist = np.minimum(np.minimum(episode_step, number - oldest), length)
        return self._tokens.take((number + offsets) % self._capacity, axis=0), exist

    def sample(self, random: np.random.Generator, batch: int, length: int) -> Batch:
        """A batch drawn uniformly, with replacement."""
        oldest = max(self.count - self._capacity, 0)
        return self.gather(random.integers(oldest, self.count, batch), length)

    def gather(self, number: np.ndarray, length: int) -> Batch:
        """The transitions with these numbers [B] and their windows of ``length`` past tokens."""
        slot = number % self._capacity
        outcomes = self._outcomes.take(slot, axis=0)
        split = self._observation_size
        episode_step = outcomes[:, split + 2].astype(np.int64)
        past, exist = self.past(number, episode_step, length)
        current = self._tokens.take(slot, axis=0)
        tokens = np.concatenate((past, current[None]))
        action = current[:, self._split :]
        carry = next_carry = None
        if self._carries is not None:
            carry = self._carries.take(number % (self._capacity + 1), axis=0)
            carry[episode_step == 0] = 0.0
            next_carry = self._carries.take((number + 1) % (self._capacity + 1), axis=0)
        return Batch(
            window=Window(past, missing(exist, length), current[:, : self._split]),
            action=action,
            reward=outcomes[:, split],
            terminated=outcomes[:, split + 1],
            next_window=Window(
                tokens[1:] if length else past,
                missing(np.minimum(exist + 1, length), length),
                np.concatenate((action, outcomes[:, :split]), axis=1),
            ),
            carry=carry,
            next_carry=next_carry,
        )


def missing(exist: np.ndarray, length: int) -> np.ndarray:
    """`Window.missing` if the last ``exist`` [B] of ``length`` past tokens exist."""
    places = np.arange(length, -1, -1)[:, None]
    return (places > exist).astype(np.float32)[..., None] * (places > 0)[..., None]
