"""Animates `td3` and the best agent on the rover under the same slip.

Usage: python experiments/rover_pictures.py [--run DIR] [--seed N] [--out DIR] [--quick]

The script loads two policies that experiments/rover.py trained, and plays the same episode with
both. It writes rover_drive.gif (the paths, the errors of the motion, and the slip over time), and
rover_inferred_slip.png: the true slip, and the slip for which each command would be exact.
"""

import argparse
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import rtd3jax as rtd

sys.path.insert(0, str(pathlib.Path(__file__).parent))
from pictures import load_policies, save_gif  # noqa: E402
from writing import RESULTS, parse  # noqa: E402

COLOURS = {"td3": "#000000", "lstm-td3-1ha1hc": "#009E73"}
STEPS, SECONDS_PER_STEP = 200, 0.1


def drive(policy: rtd.Policy, env, seed: int) -> dict[str, np.ndarray]:
    """Play an episode; the slip only depends on ``seed``.

    Returns:
        Arrays [T, 2]: ``motion`` (speed in m/s, yaw rate in rad/s), ``slip`` of the wheels, and
        ``implied``, the slip for which each command would be exact.
    """
    params = env.default_params
    reset_key, steps_key = jax.random.split(jax.random.key(seed))
    observation, state = env.reset(reset_key, params)

    def step(carry, key):
        observation, state, memory = carry
        command, memory = policy.step(memory, observation)
        observation, state, _, _, _, info = env.step(key, state, command, params)
        target = jnp.array([params.target_speed, params.target_yaw_rate])
        return (observation, state, memory), (command, info["final_observation"] + target)

    start = (observation, state, policy.init())
    keys = jax.random.split(steps_key, STEPS)
    command, motion = jax.jit(lambda s: jax.lax.scan(step, s, keys)[1])(start)
    nominal, real = wheels(np.asarray(command), params), wheels(np.asarray(motion), params)
    wanted = wheels(np.array([[params.target_speed, params.target_yaw_rate]]), params)
    return {
        "motion": np.asarray(motion),
        "slip": 1.0 - real / nominal,
        "implied": 1.0 - wanted / nominal,
    }


def wheels(motion: np.ndarray, params) -> np.ndarray:
    """Left and right wheel speeds [T, 2] from (speed, yaw rate) [T, 2]."""
    half = 0.5 * params.wheelbase * motion[:, 1]
    return np.stack((motion[:, 0] - half, motion[:, 0] + half), axis=1)


def path_of(motion: np.ndarray) -> np.ndarray:
    """Positions [T, 2] in m from speeds and yaw rates."""
    heading = np.cumsum(motion[:, 1]) * SECONDS_PER_STEP
    velocity = motion[:, :1] * np.stack((np.cos(heading), np.sin(heading)), axis=1)
    return np.cumsum(velocity, axis=0) * SECONDS_PER_STEP


def draw_inferred(drives: dict[str, dict[str, np.ndarray]], path: pathlib.Path) -> None:
    figure = Figure(figsize=(8.4, 4.0), layout="constrained")
    panels = figure.subplots(2, len(drives), sharex=True, sharey=True, squeeze=False)
    for column, (name, record) in enumerate(drives.items()):
        for wheel, side in enumerate(("left", "right")):
            axes = panels[wheel, column]
            axes.plot(record["slip"][:, wheel], color="#999999", linewidth=2.0, label="true slip")
            axes.plot(
                record["implied"][:, wheel],
                color=COLOURS.get(name, "#0072B2"),
                linewidth=1.0,
                label="slip that the command allows for",
            )
            axes.set_ylim(-0.1, 0.6)
            axes.set_title(f"{name}, {side} wheel", fontsize=9)
            axes.legend(frameon=False, fontsize=8, loc="upper right")
        panels[1, column].set_xlabel("step")
    figure.supylabel("slip")
    figure.savefig(path, dpi=150)


def animate(drives: dict[str, dict[str, np.ndarray]], path: pathlib.Path, every: int) -> None:
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    top, middle, bottom = figure.subplots(3, 1, height_ratios=(2, 1, 1))
    paths = {name: path_of(record["motion"]) for name, record in drives.items()}
    reach = max(1.0, *(float(np.abs(p[:, 1]).max()) for p in paths.values()))
    top.axhline(0.0, color="#999999", linestyle="--", linewidth=1.0)
    top.set(xlim=(0, 10.5), ylim=(-1.1 * reach, 1.1 * reach), ylabel="m")
    middle.set(xlim=(0, STEPS), ylim=(-0.35, 0.35), ylabel="yaw error\nrad/s")
    bottom.set(xlim=(0, STEPS), ylim=(-0.05, 0.55), ylabel="true slip", xlabel="step")
    lines = []
    for name, record in drives.items():
        colour = COLOURS.get(name, "#0072B2")
        (trace,) = top.plot([], [], color=colour, label=name)
        (rover,) = top.plot([], [], color=colour, marker="o")
        (error,) = middle.plot([], [], color=colour, linewidth=1.0)
        lines.append((paths[name], record["motion"][:, 1], trace, rover, error))
    slip = next(iter(drives.values()))["slip"]
    wheels_of = [
        bottom.plot([], [], color=colour, label=side)[0]
        for colour, side in (("#E69F00", "left"), ("#56B4E9", "right"))
    ]
    top.legend(frameon=False, loc="upper left", ncols=2)
    bottom.legend(frameon=False, loc="upper right", ncols=2)
    top.set_title("same slip, two agents: the path should be the dashed line", fontsize=9)

    def frame(step: int):
        now = np.arange(step)
        for places, yaw, trace, rover, error in lines:
            trace.set_data(places[:step, 0], places[:step, 1])
            rover.set_data(places[step - 1 : step, 0], places[step - 1 : step, 1])
            error.set_data(now, yaw[:step])
        for wheel, line in enumerate(wheels_of):
            line.set_data(now, slip[:step, wheel])
        return []

    save_gif(figure, frame, path, STEPS, every)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--run", type=pathlib.Path, default=pathlib.Path("runs/rover"))
    parser.add_argument("--seed", type=int, default=0, help="seed of the policies")
    parser.add_argument("--agents", nargs=2, default=["td3", "lstm-td3-1ha1hc"])
    parser.add_argument("--out", type=pathlib.Path, default=RESULTS)
    parser.add_argument("--quick", action="store_true", help="few frames")
    options = parse(parser, arguments, written=("out",))
    env = rtd.make("rover", "ar1-slip")
    policies = load_policies(options.run, options.agents, disturbance="ar1-slip", seed=options.seed)
    drives = {name: drive(policy, env, seed=3) for name, policy in policies.items()}
    if not drives:
        return 1
    options.out.mkdir(parents=True, exist_ok=True)
    draw_inferred(drives, options.out / "rover_inferred_slip.png")
    animate(drives, options.out / "rover_drive.gif", 50 if options.quick else 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
