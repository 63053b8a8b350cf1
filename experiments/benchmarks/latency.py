"""Measures the time of a control step for each export format, for one plant on one core.

Usage: taskset -c 0 python experiments/benchmarks/latency.py [--quick] [--out DIR]

The six agents have l = 10, H = 128, and untrained weights, which need the same time as trained
ones, and read the pendulum's observation. Recurrent agents are also measured with a running carry,
whose time does not depend on l. A repeat plays 200 steps and takes their median. The result is the
minimum of all medians, because other work on the machine can only increase the time. Observations
are numpy arrays, and each step waits for its action, as on a robot. For comparison, the report
states the time of the matrix products of one step of `lstm-td3-1ha1hc` with a running carry alone.
"""

import argparse
import csv
import importlib.util
import itertools
import os
import pathlib
import platform
import sys
import tempfile
import time

# Before the import of numpy and JAX: one thread each.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
import onnxruntime

import rtd3jax as rtd
from rtd3jax.agents.agent import make_part
from rtd3jax.agents.bounds import Bounds
from rtd3jax.agents.networks import init_network
from rtd3jax.registries import AGENTS

sys.path.insert(0, str(pathlib.Path(__file__).parents[1]))
from writing import BENCHMARKS, parse  # noqa: E402

OBSERVATIONS, ACTIONS = 3, 1
STEPS = 200


def policy_of(algorithm, length, width, acting):
    length = 0 if algorithm == "td3" else length
    network = make_part(AGENTS[algorithm], "actor", "lstm", OBSERVATIONS, ACTIONS, width)
    actor = init_network(jax.random.key(0), network)
    return rtd.Policy(
        actor=actor,
        bounds=Bounds(jnp.full(ACTIONS, -2.0), jnp.full(ACTIONS, 2.0)),
        history_length=jnp.int32(length),
        centre_token=jnp.zeros(ACTIONS),
        algorithm=algorithm,
        window_tokens=length,
        observation_size=OBSERVATIONS,
        action_shape=(ACTIONS,),
        acting=acting,
    )


def numpy_player(policy, directory):
    path = directory / "player.py"
    policy.export(path, format="numpy", overwrite=True)
    spec = importlib.util.spec_from_file_location("player", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Player().step


def onnx_session(policy, directory):
    path = directory / "policy.onnx"
    policy.export(path, format="onnx", overwrite=True)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])


def onnx_player(policy, directory):
    session = onnx_session(policy, directory)
    state = {s.name: np.zeros((1, *s.shape[1:]), np.float32) for s in session.get_inputs()[1:]}

    def step(observation):
        action, *after = session.run(None, {"observation": observation[None], **state})
        state.update(zip(state, after, strict=True))
        return action[0]

    return step


def bound_onnx_player(policy, directory):
    """As `onnx_player`, but with arrays that are bound once: docs/deploy_a_policy.md."""
    session = onnx_session(policy, directory)
    sources, results = session.get_inputs(), session.get_outputs()
    seen, applied = (np.zeros((1, *own.shape[1:]), np.float32) for own in (sources[0], results[0]))
    state = [[np.zeros((1, *part.shape[1:]), np.float32) for part in sources[1:]] for _ in range(2)]
    bindings = []
    for before, after in (state, state[::-1]):
        binding = session.io_binding()
        for source, array in zip(sources, (seen, *before), strict=True):
            binding.bind_cpu_input(source.name, array)
        for result, array in zip(results, (applied, *after), strict=True):
            place = array.shape, array.ctypes.data
            binding.bind_output(result.name, "cpu", 0, np.float32, *place)
        bindings.append((binding, before, after))  # a binding does not keep its arrays alive
    turns = itertools.cycle(bindings)

    def step(observation):
        seen[0] = observation
        session.run_with_iobinding(next(turns)[0])
        return applied[0]

    return step


def stablehlo_player(policy, directory):
    path = directory / "policy.stablehlo"
    policy.export(path, format="stablehlo", overwrite=True)
    program = rtd.load_stablehlo(path)
    state = program.init()

    def step(observation):
        nonlocal state
        action, state = program.step(state, observation[None])
        return np.asarray(action)[0]

    return step


def jax_player(policy, directory):
    jitted = jax.jit(policy.step)
    state = policy.init()

    def step(observation):
        nonlocal state
        action, state = jitted(state, observation)
        return np.asarray(action)

    return step


FORMS = {
    "numpy": numpy_player,
    "onnx": onnx_player,
    "onnx, bound": bound_onnx_player,
    "stablehlo": stablehlo_player,
    "jax (policy.step)": jax_player,
}


def median_microseconds(step, observations):
    times = []
    for observation in observations:
        began = time.perf_counter()
        step(observation)
        times.append(time.perf_counter() - began)
    return 1e6 * float(np.median(times))


def product_microseconds(width, repeats):
    """The time of the products of a step with a running carry in numpy: memory, head, output."""
    chance = np.random.default_rng(0)
    shapes = (OBSERVATIONS + ACTIONS, width), (width, 4 * width), (width, 4 * width)
    shapes = *shapes, (width, width), (width, ACTIONS)
    kernels = [chance.normal(size=shape).astype(np.float32) for shape in shapes]
    inputs = [np.ones((1, len(kernel)), np.float32) for kernel in kernels]

    def products(_):
        return [x @ kernel for x, kernel in zip(inputs, kernels, strict=True)]

    return min(median_microseconds(products, range(STEPS)) for _ in range(repeats))


def measure(agents, length, width, repeats):
    """Rows of agent, format and microseconds; each repeat measures all of them in turn."""
    chance = np.random.default_rng(0)
    observations = chance.normal(size=(STEPS, OBSERVATIONS)).astype(np.float32)
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        players = {
            (algorithm, acting, form): make(policy_of(algorithm, length, width, acting), directory)
            for algorithm in agents
            for acting in ("window", "carry")[: 1 + AGENTS[algorithm].has_window]
            for form, make in FORMS.items()
        }
        for step in players.values():
            step(observations[0])
        best = dict.fromkeys(players, np.inf)
        for _ in range(repeats):
            for key, step in players.items():
                best[key] = min(best[key], median_microseconds(step, observations))
    return [
        {
            "agent": agent,
            "acting": acting,
            "form": form,
            "history_length": length,
            "width": width,
            "us": round(us, 1),
        }
        for (agent, acting, form), us in best.items()
    ]


def report(rows, repeats, products):
    table = {(_name(row), row["form"]): row["us"] for row in rows}
    first = rows[0]
    lines = [
        "| agent | " + " | ".join(FORMS) + " |",
        "|---" * (1 + len(FORMS)) + "|",
        *(
            f"| {agent} | " + " | ".join(f"{table[agent, form]:.0f}" for form in FORMS) + " |"
            for agent in dict.fromkeys(map(_name, rows))
        ),
    ]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else "all"
    return (
        "# Latency of a control step\n\n"
        f"Microseconds, one plant, l = {first['history_length']}, H = {first['width']}: the least "
        f"of {repeats} medians of {STEPS} steps, since other work on the machine only adds. "
        f"Cores allowed: {cores}.\n\n"
        + "\n".join(lines)
        + f"\n\nThe matrix products of a step of `lstm-td3-1ha1hc` with a running carry alone, in "
        f"numpy: {products:.0f}."
        f"\n\n{_processor()}; jax {jax.__version__}, onnxruntime {onnxruntime.__version__}, "
        f"numpy {np.__version__}, Python {platform.python_version()}.\n\n"
        "Command: `taskset -c 0 python experiments/benchmarks/latency.py`\n"
    )


def _name(row):
    return f"`{row['agent']}`" + (", carry runs on" if row["acting"] == "carry" else "")


def _processor():
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        return next(s.split(":")[1].strip() for s in lines if s.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def main(arguments=None):
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="two agents, l = 2, H = 8")
    parser.add_argument(
        "--out", type=pathlib.Path, default=BENCHMARKS, help="directory of latency.*"
    )
    options = parse(parser, arguments)
    length, width, repeats = (2, 8, 1) if options.quick else (10, 128, 100)
    agents = ("td3", "lstm-td3") if options.quick else rtd.ALGORITHMS
    rows = measure(agents, length, width, repeats)
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "latency.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    text = report(rows, repeats, product_microseconds(width, repeats))
    (options.out / "latency.md").write_text(text)
    print(text)
    return 0


if __name__ == "__main__":
    sys.exit(main())
