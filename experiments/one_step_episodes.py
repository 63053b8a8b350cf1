"""Trains agents on episodes that a time limit ends at their first step.

Usage: python experiments/one_step_episodes.py [--quick] [--out DIR]

The reward is always one and the time limit is no termination, so the correct action value is
1 / (1 - gamma). A value is bootstrapped from the next observation, at which no agent ever acts. The
script trains six agents on episodes of one step and of eight steps, with l = 1, width 32 and three
seeds, and writes the mean action value of the last 2,000 of 20,000 steps to one_step_episodes.md
and .parquet.
"""

import argparse
import itertools
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from flax import struct
from gymnax.environments import environment, spaces

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, mean_text, parse, provenance, write_results  # noqa: E402

GAMMA, STEPS, SEEDS, EPISODE_LENGTHS = 0.9, 20_000, 3, (1, 8)


@struct.dataclass
class State:
    """Number of steps in this episode, int32."""

    time: jax.Array


class Paid(environment.Environment):
    """Observations are uniform noise; each step has a reward of one."""

    @property
    def default_params(self):
        return environment.EnvParams(max_steps_in_episode=1)

    def reset_env(self, key, params):
        return self._seen(key), State(jnp.int32(0))

    def step_env(self, key, state, action, params):
        after = State(state.time + jnp.int32(1))
        return self._seen(key), after, jnp.float32(1), jnp.array(False), {}

    def action_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))

    def observation_space(self, params):
        return spaces.Box(-1.0, 1.0, (1,))

    def _seen(self, key):
        return jax.random.uniform(key, (1,), jnp.float32, -1.0, 1.0)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    agents, seeds, steps = tuple(rtd.ALGORITHMS), SEEDS, STEPS
    fields: dict[str, object] = {"gamma": GAMMA, "hidden_size": 32, "learning_starts": 1_000}
    if options.quick:
        agents, seeds, steps = ("td3",), 1, 60
        fields |= {"hidden_size": 4, "batch_size": 4, "learning_starts": 16}
    rows = []
    for length, algorithm in itertools.product(EPISODE_LENGTHS, agents):
        params = environment.EnvParams(max_steps_in_episode=length)
        config = rtd.Config(
            algorithm, 1, total_steps=steps, eval_every=steps // 10, eval_episodes=1, **fields
        )
        run = rtd.train(Paid(), config, range(seeds), params=params, progress=False)
        for seed, value in enumerate(np.asarray(run.metrics["action_value"])[:, -1]):
            rows.append(
                {"episode_length": length, "algorithm": algorithm, "seed": seed, "value": value}
            )
        print(length, algorithm, [round(float(row["value"]), 1) for row in rows[-seeds:]])
    table = pd.DataFrame(rows)
    text = markdown_table(
        ["agent", *(f"episodes of {length}" for length in EPISODE_LENGTHS)],
        [
            [agent, *(mean_text(values["value"], 1) for _, values in own.groupby("episode_length"))]
            for agent, own in table.groupby("algorithm", sort=False)
        ],
    )
    text += f"\n\nThe correct value is {1 / (1 - GAMMA):.1f}; means ± standard deviations of seeds."
    facts = provenance(gamma=GAMMA, steps=steps, seeds=seeds)
    write_results(options.out, "one_step_episodes", table, text, facts)
    print(text)


if __name__ == "__main__":
    main()
