"""A process that trains seeds of the PyTorch reference, and reads commands as lines of JSON.

Usage: python -m experiments.benchmarks.torch_worker THREADS, then on the standard input

    {"do": "prepare", "agent": ..., "history_length": ..., "seeds": [...], ...}
    {"do": "run", "seconds": ...}    steps of all seeds in turn, for so long
    {"do": "sgemm", "size": ..., "seconds": ...}

The answer to each is a line of JSON: the number of steps or operations, and the seconds.
"""

import json
import sys
import time

import numpy as np
import torch

from experiments.benchmarks.numpy_environment import (
    ACTION_HIGH,
    ACTION_LOW,
    ACTION_SIZE,
    OBSERVATION_SIZE,
    Ring,
    Rover,
    Window,
    missing,
)
from experiments.benchmarks.torch_reference import (
    Learner,
    carry_tensors,
    tensors,
    window_tensors,
)
from rtd3jax.registries import AGENTS

_TURN = 8
"""Steps of a seed before the next seed, during which its weights stay in the cache."""


class Seed:
    """One seed's training: act, learn, step, store, in the order of `rtd3jax.training.loop`."""

    def __init__(
        self,
        agent: str,
        history_length: int,
        seed: int,
        width: int,
        batch: int,
        capacity: int,
        learning_starts: int,
        policy_delay: int = 2,
        exploration_noise: float = 0.1,
    ):
        torch.manual_seed(seed)
        self._random = np.random.default_rng(seed)
        variant = AGENTS[agent]
        self._length, self._batch, self._starts = history_length, batch, learning_starts
        self._delay, self._exploration = policy_delay, exploration_noise
        self._keeps_carry = variant.critic_reads_carries
        self._learner = Learner(variant, OBSERVATION_SIZE, ACTION_SIZE, width)
        self._ring = Ring(
            capacity, OBSERVATION_SIZE, ACTION_SIZE, width if self._keeps_carry else None
        )
        self._environment = Rover(self._random)
        self._begin()

    def _begin(self) -> None:
        self._observation = self._environment.reset()
        self._previous = np.zeros(ACTION_SIZE, np.float32)
        self._episode_step = 0

    def step(self) -> None:
        """One environment step and its updates."""
        number = self._ring.count
        window = self._window()
        carry = None
        if self._keeps_carry:
            carry = self._carry_before(window)
            if self._episode_step:
                self._ring.put_carry(number, carry)
        action = self._act(window, carry, number)
        if number >= self._starts:
            self._learn(number - self._starts + 1)
        observation, reward, done = self._environment.step(action)
        self._ring.put(
            self._previous,
            self._observation,
            action,
            reward,
            observation,
            False,
            self._episode_step,
        )
        if done and self._keeps_carry:
            after = self._next_window(window, action, observation)
            self._ring.put_carry(number + 1, self._carry_before(after))
        self._observation, self._previous, self._episode_step = (
            observation,
            action,
            self._episode_step + 1,
        )
        if done:
            self._begin()

    def _window(self) -> Window:
        number, episode_step = np.array([self._ring.count]), np.array([self._episode_step])
        past, exist = self._ring.past(number, episode_step, self._length)
        current = np.concatenate((self._previous, self._observation))[None]
        return Window(past, missing(exist, self._length), current)

    def _next_window(self, window: Window, action, observation) -> Window:
        token = np.concatenate((window.current[0], action))[None, None]
        past = np.concatenate((window.past, token))[1:]
        exist = np.array([min(self._episode_step + 1, self._length)])
        current = np.concatenate((action, observation))[None]
        return Window(past, missing(exist, self._length), current)

    @torch.inference_mode()
    def _carry_before(self, window: Window) -> np.ndarray:
        hidden, cell = self._learner.actor.carry_before(window_tensors(window))
        return torch.cat((hidden[0], cell[0])).numpy()

    @torch.inference_mode()
    def _act(self, window: Window, carry: np.ndarray | None, number: int) -> np.ndarray:
        if number < self._starts:
            return self._random.uniform(ACTION_LOW, ACTION_HIGH, ACTION_SIZE).astype(np.float32)
        given = None if carry is None else carry_tensors(carry[None])
        greedy = self._learner.act(self._learner.actor, window_tensors(window), given)[0].numpy()
        noise = self._exploration * self._random.standard_normal(ACTION_SIZE, np.float32)
        return np.clip(greedy + noise, ACTION_LOW, ACTION_HIGH)

    def _learn(self, update: int) -> None:
        batch = tensors(self._ring.sample(self._random, self._batch, self._length))
        self._learner.update_critics(batch, torch.randn(self._batch, ACTION_SIZE))
        if update % self._delay == 0:
            self._learner.update_actor_and_targets(batch)


class Worker:
    """The seeds of the process."""

    def prepare(self, seeds: list[int], warm_up: int, learning_starts: int, **settings) -> dict:
        """Create the seeds, and run each until after its first updates."""
        self._seeds = [
            Seed(seed=seed, learning_starts=learning_starts, **settings) for seed in seeds
        ]
        for seed in self._seeds:
            for _ in range(learning_starts + warm_up):
                seed.step()
        return {"seeds": len(self._seeds)}

    def run(self, seconds: float) -> dict:
        """Run steps of the seeds in turn for ``seconds``."""
        steps, began = 0, time.perf_counter()
        while True:
            for seed in self._seeds:
                for _ in range(_TURN):
                    seed.step()
                    steps += 1
                    passed = time.perf_counter() - began
                    if passed >= seconds:
                        return {"steps": steps, "seconds": passed}

    def sgemm(self, size: int, seconds: float) -> dict:
        """Operations and seconds of large float32 products."""
        a, b = torch.randn(size, size), torch.randn(size, size)
        out = a @ b
        products, began = 0, time.perf_counter()
        while (passed := time.perf_counter() - began) < seconds or not products:
            torch.mm(a, b, out=out)
            products += 1
        passed = time.perf_counter() - began
        return {"steps": products * 2.0 * size**3, "seconds": passed}


def main(arguments: list[str]) -> None:
    torch.set_num_threads(int(arguments[0]))
    torch.set_flush_denormal(True)  # as XLA does
    worker = Worker()
    for line in sys.stdin:
        order = json.loads(line)
        answer = getattr(worker, order.pop("do"))(**order)
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
