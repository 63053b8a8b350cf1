"""What a step of the rover on soil costs on one core.

Usage: taskset -c 0 python experiments/rover_soil_cost.py [--quick]

The script runs 1,000 environments under vmap for 200 steps in a compiled loop, after a warm-up, and
prints the best of five rounds: the time of the clock, and the time of the core. The two differ if
other processes use the core. `step_env` is the dynamics alone; `step` also draws a new episode in
every step, as gymnax's automatic reset does.
"""

import argparse
import sys
import time

import jax
import jax.numpy as jnp

import rtd3jax as rtd

ENVIRONMENTS, STEPS, ROUNDS = 1_000, 200, 5


def microseconds(env_id: str, disturbance: str, count: int, automatic: bool) -> tuple[float, float]:
    """Microseconds of a step of one environment in the best round.

    Returns:
        The time of the clock, and the time of the core.
    """
    env = rtd.make(env_id, disturbance)
    params = env.default_params
    keys = jax.random.split(jax.random.key(0), count)
    _, states = jax.vmap(env.reset_env, (0, None))(keys, params)
    actions = jax.random.uniform(jax.random.key(1), (count, 2), jnp.float32, 0.3, 0.8)
    step = env.step if automatic else env.step_env

    @jax.jit
    def drive(states, key):
        def body(states, key):
            step_keys = jax.random.split(key, count)
            seen, states, reward, *_ = jax.vmap(step, (0, 0, 0, None))(
                step_keys, states, actions, params
            )
            return states, reward.sum() + seen.sum()

        return jax.lax.scan(body, states, jax.random.split(key, STEPS))

    jax.block_until_ready(drive(states, jax.random.key(2)))
    rounds = []
    for _ in range(ROUNDS):
        began = time.perf_counter(), time.process_time()
        jax.block_until_ready(drive(states, jax.random.key(3)))
        rounds.append((time.perf_counter() - began[0], time.process_time() - began[1]))
    clock, core = (1e6 * min(seconds) / (count * STEPS) for seconds in zip(*rounds, strict=True))
    return clock, core


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="tiny, to see that it runs")
    options = parser.parse_args(arguments)
    count = 10 if options.quick else ENVIRONMENTS
    worlds = [("rover-soil", "mixed-slope")]
    if not options.quick:
        worlds += [("rover-soil", "dry-sand"), ("rover", "ar1-slip")]
    for world in worlds:
        for name, automatic in (("step_env", False), ("step", True)):
            clock, core = microseconds(*world, count, automatic)
            print(
                f"{' '.join(world)}: {name} {clock:.2f} µs, {core:.2f} µs of the core "
                f"({count} environments)",
                flush=True,
            )
    return 0


if __name__ == "__main__":
    sys.exit(main())
