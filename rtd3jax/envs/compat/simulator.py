"""Gymnasium simulators on the host: their allocation to lanes, and their positions in episodes.

A position is the seed of an episode's reset and the actions since then. If a lane asks a simulator
for another position (after a resume, or after the simulator was closed), the simulator replays the
episode from its seed, and a digest of all its answers shows whether it reached the same position,
bit for bit.
"""

import atexit
import contextlib
import hashlib
import itertools
import math
import queue
import reprlib
import struct
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from rtd3jax.envs.compat.surface import LARGEST
from rtd3jax.errors import UserError, short_reason, typed_reason

MOST = 1_024
"""Limit of the simulators in use. A further episode takes the one that was used longest ago; if the
episode of this simulator continues, another simulator replays it."""

SEED_DIGEST = (0, 0)

_CLOSING_SECONDS = 5.0
"""Longest wait for a simulator to close, in seconds."""


class Fault(Exception):
    """A fault of a simulator: its message in one line, and then its handle from `faults_of`."""


class _Thread:
    """A thread that runs one call after another; a thread whose call hangs can be abandoned."""

    def __init__(self) -> None:
        self._calls: queue.SimpleQueue = queue.SimpleQueue()
        self._answers: queue.SimpleQueue = queue.SimpleQueue()
        threading.Thread(target=self._work, daemon=True, name="simulator").start()

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            try:
                self._answers.put((call(), None))
            except BaseException as error:  # `do` raises it in the thread of the caller
                self._answers.put((None, error))

    def do(self, call: Callable[[], Any], seconds: float) -> Any:
        self._calls.put(call)
        try:
            answer, error = self._answers.get(timeout=seconds)
        except queue.Empty:
            raise TimeoutError from None
        if error is not None:
            raise error
        return answer

    def end(self) -> None:
        self._calls.put(None)


class Simulator:
    """One instance of an environment.

    Args:
        make: a function that makes the environment.
        read: a function that flattens an observation to all its elements, float64 [S].
        step_seconds: limit of the duration of one call, in seconds.
    """

    def __init__(
        self, make: Callable[[], Any], read: Callable[[Any], np.ndarray], step_seconds: float
    ) -> None:
        self.place: tuple[int, int, tuple[int, int]] | None = None
        self.fault: str | None = None
        self._read = read
        self._seconds = step_seconds
        self._thread = _Thread()
        self._make = make
        self._env: Any = None
        self._closed = False

    def reset(self, seed: int) -> np.ndarray:
        """Begin an episode; return its first observation, float64 [S].

        Raises:
            Fault: when the simulator fails.
        """
        self.place = None
        if self._env is None:
            self._env = self._call("the factory", self._make)
        answer = self._call("reset", lambda: self._env.reset(seed=seed))
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise self.failed("reset must return (observation, info)")
        observation = self._observation("reset", answer[0])
        self.place = seed, 0, _digest(SEED_DIGEST, observation, 0.0)
        return observation

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """One step; return observation [S], reward, terminated and truncated.

        Raises:
            Fault: when the simulator fails.
        """
        if self.fault is not None:
            raise Fault(self.fault)
        assert self.place is not None
        seed, time, digest = self.place
        self.place = None
        answer = self._call("step", lambda: self._env.step(action))
        count = len(answer) if isinstance(answer, tuple) else 1
        if count != 5:
            raise self.failed(
                f"step returned {count} values; it must return (observation, reward, terminated, "
                "truncated, info)"
            )
        observation = self._observation("step", answer[0])
        try:
            reward = float(answer[1]) if isinstance(answer[1], float) else _number(answer[1])
        except Exception:  # an object of others may raise anything
            raise self.failed(f"the reward {_shown(answer[1])} is not a number") from None
        if not math.isfinite(reward):
            raise self.failed(f"the reward is {reward}")
        if abs(reward) > LARGEST:
            raise self.failed(f"the reward is {reward:g}, too large for float32")
        terminated = self._flag("terminated", answer[2])
        truncated = self._flag("truncated", answer[3])
        self.place = seed, time + 1, _digest(digest, observation, reward)
        return observation, reward, terminated, truncated

    def close(self) -> None:
        """Close the environment, unless its thread hangs; further calls have no effect."""
        self.place = None
        if self._closed:
            return
        self._closed = True
        if self._env is not None:
            with contextlib.suppress(BaseException):  # the environment is not needed any more
                self._thread.do(self._env.close, min(_CLOSING_SECONDS, self._seconds))
        self._thread.end()

    def failed(self, message: str) -> Fault:
        """Record the fault; return the exception to raise now and at later calls."""
        self.fault = f"the simulator failed: {message}"
        return Fault(self.fault)

    def _call(self, what: str, call: Callable[[], Any]) -> Any:
        if self.fault is not None:
            raise Fault(self.fault)
        try:
            return self._thread.do(call, self._seconds)
        except TimeoutError:
            raise self.failed(
                f"{what} did not return within {self._seconds:g} s (step_seconds=...)"
            ) from None
        except UserError as error:
            raise self.failed(str(error)) from error
        except BaseException as error:
            raise self.failed(f"{what} raised {typed_reason(error)}") from error

    def _observation(self, what: str, observation: object) -> np.ndarray:
        try:
            flat = self._read(observation)
        except Exception as error:  # an object of others may raise anything
            raise self.failed(
                f"the observation of {what} is unfit: {short_reason(error)}"
            ) from None
        if not np.isfinite(flat).all():
            where = int(np.argmin(np.isfinite(flat)))
            raise self.failed(f"element {where} of the observation of {what} is {flat[where]}")
        return flat

    def _flag(self, name: str, value: object) -> bool:
        try:
            flag = np.asarray(value)
            return bool(value if flag.ndim == 0 else flag.reshape(()))
        except Exception:  # an object of others may raise anything
            raise self.failed(
                f"step returned {name}={_shown(value)}, which is not True or False"
            ) from None


def _shown(value: object) -> str:
    """A value of others in a message: short, and in one line."""
    try:
        return " ".join(reprlib.repr(value).split())
    except Exception:  # Python refuses to write an integer of many digits
        return f"of type {type(value).__name__}"


def _number(reward: ArrayLike) -> float:
    """A reward of any numeric type, also as an array of one element."""
    return float(np.asarray(reward, np.float64).reshape(()))


def _digest(before: tuple[int, int], observation: np.ndarray, reward: float) -> tuple[int, int]:
    text = struct.pack("=2I", *before) + observation.tobytes() + struct.pack("=d", reward)
    first, second = struct.unpack("=2I", hashlib.blake2b(text, digest_size=8).digest())
    return first, second


@contextlib.contextmanager
def faults_of(handle: int) -> Iterator[None]:
    """A context that adds the simulator's handle to a `Fault`, as its second argument."""
    try:
        yield
    except Fault as fault:
        raise Fault(str(fault), handle) from fault


class Fleet:
    """All simulators of one environment in this process; every method may be called by any thread.

    Args:
        make: a function that makes one environment.
        read: see `Simulator`.
        step_seconds: see `Simulator`.
    """

    def __init__(
        self, make: Callable[[], Any], read: Callable[[Any], np.ndarray], step_seconds: float
    ) -> None:
        self._arguments = (make, read, step_seconds)
        self._lock = threading.Lock()
        self._busy: dict[int, Simulator] = {}
        self._free: list[Simulator] = []
        self._users = 0
        _fleets.append(self)

    def reset(self, handle: int, seed: int) -> tuple[int, np.ndarray, tuple[int, int]]:
        """Begin an episode in the simulator of ``handle``, or in another if there is none.

        Returns:
            The simulator's handle, the first observation [S], and the digest.

        Raises:
            Fault: with the simulator's handle as its second argument.
        """
        handle, simulator = self._take(handle)
        with faults_of(handle):
            observation = simulator.reset(seed)
        assert simulator.place is not None
        return handle, observation, simulator.place[2]

    def at(
        self,
        handle: int,
        place: tuple[int, int, tuple[int, int]],
        past: Callable[[int], Sequence[np.ndarray]],
    ) -> tuple[int, Simulator | None]:
        """The simulator at ``place``, and its handle.

        If the simulator of ``handle`` is at another position, another simulator replays the
        episode.

        Args:
            handle: the handle in the state of the lane.
            place: seed, time and digest.
            past: a function that returns the first actions of the episode, for their number.

        Returns:
            The handle, and the simulator; None instead of the simulator if the replay reached
            another position, because the simulator is not deterministic.

        Raises:
            Fault: with the simulator's handle as its second argument.
        """
        with self._lock:
            simulator = self._busy.get(handle)
            if simulator is not None:
                if simulator.fault is not None:
                    raise Fault(simulator.fault, handle)
                if simulator.place == place:
                    self._busy[handle] = self._busy.pop(handle)
                    return handle, simulator
        handle, simulator = self._take(-1)
        with faults_of(handle):
            simulator.reset(place[0])
            for action in past(place[1]):
                simulator.step(action)
        return handle, simulator if simulator.place == place else None

    def record_fault(self, handle: int, message: str) -> str:
        """Record a fault of the simulator of ``handle``, and return its text."""
        with self._lock:
            simulator = self._busy.get(handle)
            # Another thread may have closed it.
            return message if simulator is None else str(simulator.failed(message))

    def release(self, handle: int) -> None:
        """Make the simulator free for another episode, unless it has failed."""
        with self._lock:
            simulator = self._busy.get(handle)
            if simulator is not None and simulator.fault is None:
                del self._busy[handle]
                self._free.append(simulator)

    @contextlib.contextmanager
    def in_use(self) -> Iterator[None]:
        """A context in which free simulators stay open for further episodes.

        At the end of the last such context, free and failed simulators are closed. Busy simulators
        stay open, because other code may use them.
        """
        with self._lock:
            self._users += 1
        try:
            yield
        finally:
            with self._lock:
                self._users -= 1
                idle: list[Simulator] = []
                if not self._users:
                    idle = [s for s in self._busy.values() if s.fault is not None]
                    idle, self._free = [*idle, *self._free], []
            for simulator in idle:
                simulator.close()

    @contextlib.contextmanager
    def for_a_while(self) -> Iterator[None]:
        """A context; at its end, all simulators that were taken in it are closed, even busy ones.

        If another thread took one of them, its episode is replayed when this thread needs it.
        """
        before = set(self._busy)
        with self.in_use():
            try:
                yield
            finally:
                self.drop(set(self._busy) - before)

    def drop(self, handles: Iterable[int]) -> None:
        """Close the simulators of these handles; `fault` still knows the faults of failed ones."""
        with self._lock:
            own = {handle: self._busy[handle] for handle in handles if handle in self._busy}
            for handle, simulator in own.items():
                if simulator.fault is None:
                    del self._busy[handle]
        for simulator in own.values():
            simulator.close()

    def close(self) -> None:
        """Close all simulators; a position that is needed later is replayed."""
        with self._lock:
            simulators = [*self._busy.values(), *self._free]
            faults = {h: s for h, s in self._busy.items() if s.fault is not None}
            self._busy, self._free = faults, []
        for simulator in simulators:
            simulator.close()

    @property
    def most(self) -> int:
        """Limit of the simulators in use, and so of the episodes that are played together."""
        return MOST

    @property
    def count(self) -> int:
        """Number of open simulators."""
        with self._lock:
            return len(self._free) + sum(s.fault is None for s in self._busy.values())

    def fault(self, handle: int) -> str | None:
        """The fault of the simulator of this handle; None without a fault or a simulator."""
        with self._lock:
            simulator = self._busy.get(handle)
            return None if simulator is None else simulator.fault

    def _take(self, handle: int) -> tuple[int, Simulator]:
        with self._lock:
            simulator = self._busy.get(handle)
            if simulator is not None:
                return handle, simulator
            handle = next(_handles)
            if self._free:
                simulator = self._busy[handle] = self._free.pop()
                return handle, simulator
            sound = [h for h, s in self._busy.items() if s.fault is None]
            if len(sound) >= MOST:
                simulator = self._busy[handle] = self._busy.pop(sound[0])
                return handle, simulator
            simulator = self._busy[handle] = Simulator(*self._arguments)
            return handle, simulator


_handles = itertools.count(1)
_fleets: list[Fleet] = []


def fault_of(handle: int) -> str | None:
    """The fault of the simulator of this handle in this process."""
    return next((found for fleet in list(_fleets) if (found := fleet.fault(handle))), None)


@atexit.register
def close_simulators() -> None:
    """Close all simulators of this process; a simulator that is needed later is made again."""
    for fleet in list(_fleets):
        fleet.close()


def say(message: str) -> None:
    """Issue a warning; print it if warnings are errors, because a host callback must not raise."""
    try:
        warnings.warn(message, stacklevel=3)
    except Warning:
        print(message)
