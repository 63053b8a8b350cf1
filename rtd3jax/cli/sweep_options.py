"""The options of the sweep's command line, and their values as the study needs them."""

import argparse
import dataclasses
import math
import re
from pathlib import Path
from typing import Any, Literal, NoReturn, get_args, get_origin

import jax

from rtd3jax.agents.variants import ALGORITHMS
from rtd3jax.cli.common import add_import, out_path, replace_unprintable
from rtd3jax.config import Config
from rtd3jax.envs.builtin import LISTED
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS
from rtd3jax.study.cells import Grid
from rtd3jax.study.loggers import LOGGERS
from rtd3jax.study.presets import PRESETS

_GRID_FIELDS = ("algorithm", "history_length")


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise UserError(f"{message}; --help lists the options")


def parser(description: str | None) -> argparse.ArgumentParser:
    """The command line of ``rtd3jax.sweep``; bad input raises `UserError`."""
    replace_unprintable()
    environments = "\n".join(f"  {env}: {', '.join(names)}" for env, names in LISTED.items())
    found = _Parser(
        prog="python -m rtd3jax.sweep",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,  # else --seed 3 would be --seeds 3
        epilog=f"disturbances:\n{environments}\n  parameters may follow: noise:sigma=1.0\n"
        "  + combines several: ar1-slip+dropout:p=0.2\n"
        "  / separates alternatives, of which each episode draws one: noise/random-sine\n\n"
        "example:\n  python -m rtd3jax.sweep --env pendulum --algorithms td3 lstm-td3-1ha1hc \\\n"
        "      --disturbances random-sine noise --history-lengths 1 10 --seeds 5 --out runs/mine",
    )
    study = found.add_argument_group("the study")
    study.add_argument(
        "--preset", choices=sorted(PRESETS), help="a study with its settings, ready to run"
    )
    study.add_argument(
        "--env",
        help=f"{', '.join(LISTED)}, a registered id, any id that gymnax makes, or gymnasium:ID",
    )
    add_import(study)
    study.add_argument(
        "--disturbances",
        nargs="+",
        metavar="ID",
        help="disturbances that the agent cannot observe [none]",
    )
    study.add_argument("--algorithms", nargs="+", metavar="ID", help=f"{', '.join(AGENTS)}")
    study.add_argument(
        "--history-lengths", nargs="+", type=int, metavar="L", help="past steps in a window [10]"
    )
    study.add_argument(
        "--seeds", type=int, default=5, help="number of seeds of each cell: 0, 1, ... [5]"
    )
    study.add_argument(
        "--final-episodes", type=int, default=20, help="episodes of the final evaluation [20]"
    )
    work = found.add_argument_group("the work")
    work.add_argument("--out", metavar="DIR", help="run directory [runs/PRESET or runs/ENV]")
    work.add_argument("--status", action="store_true", help="print the state of each lane in --out")
    work.add_argument(
        "--fresh",
        action="store_true",
        help="start a new study; rename an existing DIR to DIR.old-N",
    )
    work.add_argument(
        "--distributed",
        action="store_true",
        help="this process is one of a job (SLURM, Open MPI, or JAX_COORDINATOR_ADDRESS, "
        "JAX_NUM_PROCESSES, JAX_PROCESS_ID) and trains the lanes of its own devices",
    )
    work.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="train cells as tasks of a Ray cluster: auto, or host:port",
    )
    work.add_argument(
        "--processes",
        type=int,
        default=1,
        metavar="N",
        help="train on the CPU in N processes, each pinned to its share of the cores; 1: with the "
        "threads of this process [1]",
    )
    work.add_argument("--shard", metavar="I/N", help="train the I-th of N shares of the lanes")
    work.add_argument(
        "--checkpoint-every",
        default="auto",
        metavar="T",
        help="time or steps between checkpoints: 300s, 5m, 1h or 2000steps [five minutes, or "
        "longer if checkpoints would take more than 2%% of the time]",
    )
    work.add_argument(
        "--keep-checkpoints",
        action="store_true",
        help="keep the last checkpoint of a lane that has ended, so that a later sweep with more "
        "--total-steps continues from it",
    )
    work.add_argument(
        "--dry-run",
        action="store_true",
        help="print the plan with its memory and time, and train nothing",
    )
    work.add_argument(
        "--log",
        nargs="+",
        default=[],
        choices=sorted(LOGGERS),
        metavar="TRACKER",
        help=f"also send learning curves to {', '.join(sorted(LOGGERS))}",
    )
    work.add_argument(
        "--no-report", dest="report", action="store_false", help="do not write report.html"
    )
    work.add_argument("--quiet", action="store_true", help="print no progress bar")
    work.add_argument(
        "--device", choices=("cpu", "gpu", "tpu"), help="the kind of device [JAX's default]"
    )
    work.add_argument(
        "--strategy",
        choices=("map", "vmap"),
        help="map: train lanes one after the other; vmap: in one batched program, except for "
        "lanes with simulators",
    )
    config = found.add_argument_group("the configuration of every cell")
    for field in dataclasses.fields(Config):
        if field.name not in _GRID_FIELDS:
            default = "" if field.default is None else f" [{field.default}]"
            flag, help = "--" + field.name.replace("_", "-"), field.metadata["help"] + default
            help = help.replace("%", "%%")
            if field.type is bool:
                switch = argparse.BooleanOptionalAction
                config.add_argument(flag, action=switch, default=None, help=help)
                continue
            kind = _kind(field.type)
            metavar = "NAME" if kind is str else "N"
            config.add_argument(flag, type=kind, metavar=metavar, help=help)
    return found


def _kind(hint: object) -> type:
    """The type of a flag's value for a field with the type ``hint``: text, or a number."""
    if get_origin(hint) is Literal:
        return str
    parts = [part for part in get_args(hint) if part is not type(None)]
    if parts:
        return _kind(parts[0])
    assert isinstance(hint, type)
    return hint


def grids(options: argparse.Namespace) -> list[Grid]:
    """The grids of the preset, in which lists from the command line replace the preset's lists.

    Raises:
        UserError: when neither a preset nor an environment is named, or both disagree.
    """
    if options.preset is None and options.env is None:
        raise UserError("choose what to run: --preset quick, or --env with --algorithms")
    if options.preset is None:
        found = [Grid(options.env, ("none",), ALGORITHMS)]
    else:
        found = list(PRESETS[options.preset])
        environments = list(dict.fromkeys(grid.env for grid in found))
        if options.env is not None and environments != [options.env]:
            raise UserError(
                f"--preset {options.preset} has settings for {' and '.join(environments)}; "
                f"leave out --env {options.env}, or --preset"
            )
    given = {
        "disturbances": options.disturbances and tuple(options.disturbances),
        "algorithms": options.algorithms and tuple(options.algorithms),
        "history_lengths": options.history_lengths and tuple(options.history_lengths),
    }
    changes: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    return [dataclasses.replace(grid, **changes) for grid in found]


def overrides(options: argparse.Namespace) -> dict[str, Any]:
    """The fields of the configuration that the command line sets."""
    names = (f.name for f in dataclasses.fields(Config) if f.name not in _GRID_FIELDS)
    return {n: getattr(options, n) for n in names if getattr(options, n) is not None}


def out(options: argparse.Namespace) -> Path:
    """The run directory; UserError if no option determines it."""
    given = out_path(options.out)
    if not (given or options.preset or options.env):
        raise UserError("name the run directory: --out DIR")
    return given or Path("runs") / (options.preset or options.env)


def count(name: str, value: int) -> int:
    """``value``; raises UserError unless it is from 1 to 100,000."""
    if not 1 <= value <= 100_000:
        raise UserError(f"{name} must be from 1 to 100,000, not {value}")
    return value


def device(platform: str) -> Any:
    """The first device of a platform; UserError if there is none."""
    try:
        return jax.local_devices(backend=platform)[0]
    except RuntimeError as error:
        raise UserError(
            f"--device {platform}: this machine has none, or JAX was installed without its support "
            "(pip install 'rtd3jax[cuda13]' for NVIDIA GPUs)"
        ) from error


def parse_interval(text: str) -> tuple[float | None, int | None]:
    """``"300s"``, ``"5m"`` or ``"2000steps"`` as (seconds, None) or (infinity, steps).

    The result for ``"auto"`` is (None, None).

    Raises:
        UserError: for any other form.
    """
    if text == "auto":
        return None, None
    match = re.fullmatch(r"(\d{1,9})\s*(s|m|h|steps)?", text.strip())
    if match is None or int(match[1]) < 1:
        raise UserError(f"--checkpoint-every {text!r} is not like 300s, 5m, 1h or 2000steps")
    if match[2] == "steps":
        return math.inf, int(match[1])
    return float(match[1]) * {"m": 60, "h": 3600}.get(match[2], 1), None
