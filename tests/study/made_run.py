"""Runs of untrained agents, for tests of tables and pages."""

import numpy as np
from random_policies import random_policy

from rtd3jax.study.cells import make_cells
from rtd3jax.study.derive import Reference, derive
from rtd3jax.study.rundir import RunDirectory

STEPS = [20, 40, 60]


def make_run(out, grid):
    """A finished run of untrained agents with invented curves: nothing is compiled for it."""
    settings = {"total_steps": 60, "hidden_size": 8, "eval_every": 20, "batch_size": 8}
    settings |= {"learning_starts": 10}
    directory = RunDirectory.create(out, make_cells([grid], settings), [0, 1], 2)
    chance = np.random.default_rng(0)
    for cell in directory.cells:
        for seed in directory.seeds:
            length = cell.config.history_length
            policy = random_policy(cell.config.algorithm, cell.make_env(), length=length, seed=seed)
            curves = {"steps": np.array(STEPS), "returns": chance.normal(-3, 1, 3)}
            final = chance.normal(-2, 1, 2)
            curves |= {"true_returns": curves["returns"], "final_returns": final}
            curves |= {"final_true_returns": final}
            metrics = {"critic_loss": np.array([np.nan, 2.0 + seed, 1.0], np.float32)}
            interface = policy.interface()
            directory.lanes.write_lane(
                cell, seed, policy.parameters(), curves, metrics, None, interface
            )
    chance = np.random.default_rng(1)
    references = [
        Reference(env, disturbance, "random", *chance.normal(-4, 1, (2, 3)))
        for env, disturbance in {(cell.env, cell.disturbance): 0 for cell in directory.cells}
    ]
    derive(directory, references, pictures=False)
    return directory
