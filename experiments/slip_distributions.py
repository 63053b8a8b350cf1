"""Computes the distribution of slip under each of the paper's processes (a figure of the paper).

Usage: python experiments/slip_distributions.py [--quick] [--out DIR]

The script plays 4,000 episodes of 200 steps with the constant command, and records the slip of both
wheels at every step. It writes slip_distributions.md, .parquet (the histogram) and .png.
"""

import argparse
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from writing import RESULTS, markdown_table, parse, provenance, write_results  # noqa: E402

PROCESSES = (
    "ar1-slip",
    "ar1-slip-high-variance",
    "ar1-slip-fast",
    "ar1-slip-slow",
    "sine-slip",
)
PAPER_MEANS = {
    "ar1-slip": 0.117,
    "ar1-slip-high-variance": 0.190,
    "ar1-slip-fast": 0.082,
    "ar1-slip-slow": 0.174,
}
STEPS = 200


def slips(process: str, episodes: int) -> np.ndarray:
    """Slip of both wheels, computed from the motion: [episodes, steps, 2]."""
    env = rtd.make("rover", process)
    params = env.default_params
    command = jnp.array([params.target_speed, params.target_yaw_rate])

    def episode(key):
        reset_key, steps_key = jax.random.split(key)
        _, state = env.reset(reset_key, params)

        def step(state, key):
            _, state, _, _, _, info = env.step(key, state, command, params)
            speed, yaw = info["final_observation"] + command
            half = 0.5 * params.wheelbase * yaw
            return state, 1.0 - jnp.stack((speed - half, speed + half)) / params.target_speed

        return jax.lax.scan(step, state, jax.random.split(steps_key, STEPS))[1]

    return np.asarray(jax.jit(jax.vmap(episode))(jax.random.split(jax.random.key(0), episodes)))


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="few episodes")
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    options = parse(parser, arguments)
    episodes = 20 if options.quick else 4_000
    edges = np.linspace(0.0, 0.5, 51)
    rows, lines = [], []
    figure = Figure(figsize=(8.4, 2.4), layout="constrained")
    panels = figure.subplots(1, len(PROCESSES), sharey=True)
    for process, axes in zip(PROCESSES, panels, strict=True):
        slip = slips(process, episodes)
        share, _ = np.histogram(np.clip(slip, 0.0, 0.5), edges)
        share = share / slip.size
        rows += [
            {"process": process, "from": low, "to": high, "share": part}
            for low, high, part in zip(edges[:-1], edges[1:], share, strict=True)
        ]
        paper = PAPER_MEANS.get(process)
        lines.append(
            [
                process,
                f"{slip.mean():.4f}",
                "–" if paper is None else f"{paper:.3f}",
                *(f"{np.quantile(slip, q):.3f}" for q in (0.5, 0.95)),
                f"{np.mean(slip < 1e-4):.1%}",
            ]
        )
        axes.stairs(share, edges, fill=True, color="#0072B2")
        axes.axvline(slip.mean(), color="#D55E00", linewidth=1.2)
        axes.set_title(process, fontsize=8)
        axes.set_xlabel("slip")
    panels[0].set_ylabel("share of steps")
    header = ["process", "mean", "paper's mean", "median", "95 % quantile", "share at zero"]
    text = markdown_table(header, lines)
    write_results(
        options.out,
        "slip_distributions",
        pd.DataFrame(rows),
        text,
        provenance(episodes=episodes, steps=STEPS),
    )
    figure.savefig(options.out / "slip_distributions.png", dpi=150)
    print(text)


if __name__ == "__main__":
    main()
