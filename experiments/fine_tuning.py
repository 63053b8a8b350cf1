"""Continues the training of a rover's agent from sine slip under AR(1) slip, for 5,000 steps.

Usage: python experiments/fine_tuning.py [--quick] [--run DIR] [--seeds N] [--out DIR]

The script trains `lstm-td3-1ha1hc` on sine slip with the settings of the preset `rover` and keeps
the checkpoints. Training then continues under AR(1) slip, from the actor alone, and from the actor
with critics and optimisers. For comparison, there are agents without further training, and agents
with new weights for the same number of steps. There are five seeds, and 1,000 episodes for each
test. The script writes fine_tuning.md, .parquet and .json. If you repeat the command, it only
trains what is missing; the trainings from the actor alone are always repeated.
"""

import argparse
import pathlib
import sys
from typing import Any

import numpy as np
import pandas as pd

import rtd3jax as rtd
from rtd3jax.study.presets import ROVER_HISTORY_LENGTH, ROVER_SETTINGS, ROVER_STEPS

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

AGENT, FIRST, THEN, EPISODES, SEEDS = "lstm-td3-1ha1hc", "sine-slip", "ar1-slip", 1_000, 5
STEPS, ACTOR_STARTS = 5_000, 2_000
LEARNING_RATE = 1e-3
"""Learning rate of critics and actor in the second training: a third of the first rate."""


def study(run: pathlib.Path, disturbance: str, seeds: int, fields: dict[str, Any]) -> rtd.Study:
    """A study with a cell of the agent."""
    config = rtd.Config(AGENT, ROVER_HISTORY_LENGTH, **{**ROVER_SETTINGS, **fields})
    return rtd.Study([rtd.Cell("rover", disturbance, config)], seeds=range(seeds), out=run)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tiny run to test the script")
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/fine_tuning"))
    parser.add_argument("--seeds", type=int, default=SEEDS)
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    first, then, episodes = {"total_steps": ROVER_STEPS}, {"total_steps": STEPS}, EPISODES
    then |= {"eval_every": 500, "learning_starts": 1_000}
    then |= {"actor_learning_rate": LEARNING_RATE, "critic_learning_rate": LEARNING_RATE}
    waits = {"actor_starts": ACTOR_STARTS}
    if options.quick:
        tiny = {"total_steps": 40, "hidden_size": 4, "batch_size": 4, "learning_starts": 8}
        tiny |= {"eval_every": 40, "eval_episodes": 1}
        first, then, waits = {**first, **tiny}, {**then, **tiny}, {"actor_starts": 16}
        options.seeds, episodes = 1, 2
    quiet: dict[str, Any] = {"quiet": options.quick, "page": not options.quick}
    source = study(options.run / "sine", FIRST, options.seeds, first)
    lost = source.run(keep_checkpoints=True, **quiet)
    whole = str(options.run / "sine")
    policies = options.run / "policies"
    policies.mkdir(exist_ok=True)
    ways: dict[str, dict[str, Any]] = {
        "new weights, 5,000 steps on AR(1)": {},
        "with critics and optimisers": {"start": whole},
    }
    trained = {"not trained further": source}
    for number, (name, fields) in enumerate(ways.items()):
        trained[name] = study(
            options.run / f"way-{number}", THEN, options.seeds, {**then, **fields}
        )
        lost += trained[name].run(**quiet)
    rows = []
    env = rtd.make("rover", THEN)
    for name, own in trained.items():
        for seed in range(options.seeds):
            policy = rtd.load_policy(own.path, seed=seed)
            returns = rtd.evaluate(policy, env, episodes, seed=seed)
            rows.append({"way": name, "seed": seed, "mean": float(np.mean(returns))})
    for seed in range(options.seeds):  # the actor alone, from its saved policy
        path = policies / f"seed-{seed}.safetensors"
        rtd.load_policy(source.path, seed=seed).save(path, overwrite=True)
        config = rtd.Config(AGENT, ROVER_HISTORY_LENGTH, **{**ROVER_SETTINGS, **then, **waits})
        run = rtd.train(env, config, [seed], start=path, progress=False)
        returns = rtd.evaluate(run.policy(seed), env, episodes, seed=seed)
        rows.append({"way": "the actor alone", "seed": seed, "mean": float(np.mean(returns))})
    table = pd.DataFrame(rows)
    body = [
        [
            str(way),
            f"{own['mean'].mean():.3f} ± {own['mean'].std():.3f}",
            f"{own['mean'].min():.3f}",
        ]
        for way, own in table.groupby("way", sort=False)
    ]
    text = markdown_table(["trained on sine slip, then", "return on AR(1) slip", "worst"], body)
    facts = provenance(
        agent=AGENT,
        episodes=episodes,
        seeds=options.seeds,
        first=first,
        then=then,
        the_actor_alone=waits,
    )
    write_results(options.out, "fine_tuning", table, text, facts)
    print(text)
    print(*lost, sep="\n", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
