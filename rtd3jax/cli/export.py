"""``python -m rtd3jax.export``: write a trained policy as a file for another runtime."""

import argparse
from collections.abc import Sequence
from pathlib import Path

from rtd3jax.cli.common import exit_status, out_path, run_parser
from rtd3jax.policies.export.formats import FORMATS
from rtd3jax.policies.load import load_policy
from rtd3jax.policies.trained import Policy
from rtd3jax.registries import AGENTS
from rtd3jax.system.files import user_path
from rtd3jax.system.imports import import_modules

POLICY = "policy"
"""The format that `rtd3jax.load_policy` reads."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status. 0: done. 2: bad input."""
    options = _parser().parse_args(arguments)
    return exit_status(lambda: _run(options), lambda: options.run)


def _run(options: argparse.Namespace) -> int:
    import_modules(options.imports)
    policy = load_policy(
        options.run,
        algorithm=options.agent,
        seed=options.seed,
        env=options.env,
        disturbance=options.disturbance,
        history_length=options.history_length,
    )
    path = out_path(options.out) or _default_path(policy, options)
    if options.format == POLICY:
        policy.save(path, overwrite=options.force)
    else:
        policy.export(path, options.format, overwrite=options.force)
    print(
        f"{path}: {policy.algorithm} l={int(policy.history_length)}, "
        f"{policy.observation_size} observation elements, actions of shape {policy.action_shape}, "
        f"{path.stat().st_size:,} bytes"
    )
    return 0


def _default_path(policy: Policy, options: argparse.Namespace) -> Path:
    suffix = ".safetensors" if options.format == POLICY else FORMATS[options.format][0]
    if user_path(options.run).is_dir():
        path = Path(f"{policy.algorithm}_l{int(policy.history_length)}_seed-{options.seed or 0}")
    else:
        path = user_path(options.run).with_suffix("")
    # Python imports a module by name only if the name is an identifier.
    stem = path.name.replace("-", "_") if suffix == ".py" else path.name
    return path.with_name(stem + suffix)


def _parser() -> argparse.ArgumentParser:
    example = "runs/quick --agent h-td3 --seed 0 --format onnx"
    what = "a run directory, or a file that policy.save wrote"
    parser = run_parser("export", __doc__, example, what)
    parser.add_argument(
        "--format", required=True, choices=(*FORMATS, POLICY), help="the format of the file"
    )
    which = parser.add_argument_group("which lane of the run directory")
    which.add_argument("--agent", help=f"the agent: {', '.join(AGENTS)}, or a registered one")
    which.add_argument("--seed", type=int, help="the seed [0]")
    which.add_argument("--env", help="the environment, if the lanes have several")
    which.add_argument("--disturbance", help="the disturbance, as in the command of the sweep")
    which.add_argument("--history-length", type=int, metavar="L", help="past steps in a window")
    parser.add_argument(
        "--out",
        metavar="FILE",
        help="the file to write [AGENT_lL_seed-N.SUFFIX in the working directory; for a policy's "
        "file, its own name with another suffix]",
    )
    parser.add_argument("--force", action="store_true", help="replace the file if it exists")
    return parser
