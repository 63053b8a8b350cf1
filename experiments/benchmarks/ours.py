"""Measures rtd3jax: lanes of the compiled program of the sweep, on the workers of the sweep."""

import contextlib
import threading
import time
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rtd3jax as rtd
from rtd3jax.training import executables, lanes
from rtd3jax.training.devices import workers
from rtd3jax.training.grouping import make_groups
from rtd3jax.training.groups import Group
from rtd3jax.training.jobs import make_jobs

# A measurement ends after the running chunks, and begins with chunks of unknown speed: both must be
# short compared with the measurement. The overhead of short chunks is included in the result.
_CHUNK_SECONDS, _FIRST_CHUNK = 0.2, 1


def make_config(algorithm: str, history_length: int, **settings: Any) -> rtd.Config:
    """A configuration whose first evaluation is after the measurement."""
    numbers = {"total_steps": 100_000_000, "eval_every": 100_000_000, "replay_capacity": 30_000}
    length = None if algorithm == "td3" else history_length
    settings = {**numbers, **settings}
    settings.setdefault("learning_starts", settings.get("batch_size", 100))
    return rtd.Config(algorithm=algorithm, history_length=length, **settings)


class Lanes:
    """Seeds of one configuration on the rover under AR(1) slip, which run for given durations."""

    def __init__(
        self,
        config: rtd.Config | Sequence[rtd.Config],
        seeds: int,
        *,
        strategy: str = "map",
        devices: int | None = None,
        window: int | None = None,
    ):
        """``seeds`` lanes, with the configurations in turn; ``window`` is as in `make_jobs`."""
        configs = [config] if isinstance(config, rtd.Config) else config
        env = rtd.make("rover", "ar1-slip")
        jobs = [
            make_jobs(env, configs[seed % len(configs)], [seed], window=window)[0]
            for seed in range(seeds)
        ]
        groups = make_groups(jobs, strategy, devices or len(workers()))
        self.groups = [_Clocked(group.jobs) for group in groups]

    def compile(self) -> float:
        """Seconds until the end of the first chunk: compilation, and few random steps."""
        began = time.perf_counter()
        self._until(lambda: True)
        return time.perf_counter() - began

    def warm_up(self, seconds: float) -> float:
        """Compile, and run for ``seconds`` with updates; return the seconds of `compile`."""
        compiling = self.compile()
        while min(group.step for group in self.groups) <= self._learning_starts:
            self.run(seconds)
        self.run(seconds)
        return compiling

    def run(self, seconds: float) -> tuple[int, float]:
        """Run for at least ``seconds``; return the number of seed-steps and the time.

        The time is the mean over the workers, each of which waits after its last chunk.
        """
        before = self._steps()
        for group in self.groups:
            group.ends = {}
        began = time.perf_counter()
        self._until(lambda: time.perf_counter() - began >= seconds)
        last: dict[int, float] = {}
        for group in self.groups:
            for worker, end in group.ends.items():
                last[worker] = max(end, last.get(worker, end))
        return self._steps() - before, float(np.mean(list(last.values()))) - began

    def program_text(self) -> str:
        """XLA's text of the compiled program of the first group; call `compile` first."""
        program = self.groups[0].jobs[0].program
        return next(
            entry.executables[1].as_text()
            for (known, *_), entry in executables._programs.items()
            if known == program and entry.executables is not None
        )

    def fill_replay(self, steps: int) -> None:
        """Fill the replay with random rows of 200-step episodes, as after ``steps`` steps."""
        random = np.random.default_rng(0)
        for group in self.groups:
            job = group.jobs[0]
            state = job.program.init(job.lane)
            # A key is not an array of numbers, and the age limits the windows.
            rows = jax.tree.map(
                lambda leaf: (
                    jnp.asarray(random.standard_normal(leaf.shape, np.float32))
                    if leaf.dtype == jnp.float32
                    else leaf
                ),
                state.replay,
            )
            episode_step = jnp.arange(rows.transitions.episode_step.shape[0], dtype=jnp.int32) % 200
            rows = rows.replace(transitions=rows.transitions.replace(episode_step=episode_step))
            group.state, group.step = state.replace(replay=rows), steps

    @property
    def _learning_starts(self) -> int:
        return self.groups[0].jobs[0].program.config.learning_starts

    def _steps(self) -> int:
        return sum(group.step * len(group.jobs) for group in self.groups)

    def _until(self, enough: Any) -> None:
        """Advance all groups until ``enough()`` is true after a chunk; wait for running chunks."""

        def on_chunk(group: Group) -> None:
            if group.error is not None:
                raise group.error
            if group.lost:
                raise RuntimeError("a lane was lost: its losses are not finite")
            if enough():
                raise _Pause

        with _short_chunks(), contextlib.suppress(_Pause):
            lanes.advance_groups(self.groups, on_chunk)


class _Clocked(Group):
    """A group that records when each worker last advanced it."""

    ends: dict[int, float] = {}

    def __setattr__(self, name: str, value: Any) -> None:
        super().__setattr__(name, value)
        if name == "step":
            self.ends = {**self.ends, threading.get_ident(): time.perf_counter()}


class _Pause(Exception):
    """Raised to stop a measurement."""


@contextlib.contextmanager
def _short_chunks() -> Iterator[None]:
    before = lanes.CHUNK_SECONDS, lanes._FIRST_CHUNK
    lanes.CHUNK_SECONDS, lanes._FIRST_CHUNK = _CHUNK_SECONDS, _FIRST_CHUNK
    try:
        yield
    finally:
        lanes.CHUNK_SECONDS, lanes._FIRST_CHUNK = before


def sgemm(size: int, seconds: float) -> tuple[float, float]:
    """Operations and seconds of large products, one for each worker on its own core."""
    a = jnp.asarray(np.random.default_rng(0).standard_normal((size, size), np.float32))
    options = {"xla_cpu_multi_thread_eigen": False}
    product = jax.jit(jnp.matmul, compiler_options=options).lower(a, a).compile()
    jax.block_until_ready(product(a, a))
    done = [0] * len(workers())
    began = time.perf_counter()

    def work(worker: int) -> None:
        while time.perf_counter() - began < seconds:
            jax.block_until_ready(product(a, a))
            done[worker] += 1

    threads = [threading.Thread(target=work, args=(worker,)) for worker in range(len(done))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return sum(done) * 2.0 * size**3, time.perf_counter() - began
