"""The starts of the seeds of a training: from a policy, a run, a file or a directory."""

import contextlib
import hashlib
from collections.abc import Mapping
from pathlib import Path

from rtd3jax.errors import UserError
from rtd3jax.policies.serialization import read_policy
from rtd3jax.policies.trained import Policy
from rtd3jax.system.files import user_path
from rtd3jax.training.checkpoint_files import checkpoint_files, identity_there, lane_directory
from rtd3jax.training.result import Run
from rtd3jax.training.start import Start

StartLike = Policy | Run | str | Path | None
"""Networks from which `train` can start; None for new weights."""

IN_MEMORY = "a policy of "
"""How the name of a start begins that is a policy in memory, and not a path."""


def starts_from(
    start: StartLike, seeds: tuple[int, ...], directory: Path | None = None
) -> dict[int, Start]:
    """The networks from which each seed starts; empty for new weights.

    ``directory`` has the checkpoints of the seeds, None without checkpoints.
    """
    if start is None:
        return {}
    if isinstance(start, Policy):
        digest = hashlib.sha256(b"".join(a.tobytes() for a in start.parameters().values()))
        name = f"{IN_MEMORY}{start.algorithm} ({digest.hexdigest()[:12]})"
        return dict.fromkeys(seeds, Start(name, start))
    if isinstance(start, Run):
        return {seed: starts_from(start.policy(seed), (seed,))[seed] for seed in seeds}
    if isinstance(start, str | Path):
        if directory is None:
            return starts_of_path(start, seeds)
        return starts_if_needed(start, {seed: lane_directory(directory, seed) for seed in seeds})
    raise UserError(
        "start must be a policy, a run of rtd.train, the path of a saved policy, or a directory "
        f"of checkpoints, not {start!r}"
    )


def start_field(source: StartLike, start: Start) -> str:
    """The field ``start`` of a configuration: a path that a later training can read, or a name."""
    return str(user_path(source)) if isinstance(source, str | Path) else start.where


def starts_of_path(path: str | Path, seeds: tuple[int, ...]) -> dict[int, Start]:
    """The start of each seed, from a saved policy or the ``checkpoint_dir`` of a `rtd.train`.

    Raises:
        UserError: when ``path`` is neither of these, or has no checkpoint of a seed.
    """
    if str(path).startswith(IN_MEMORY):
        raise UserError(
            f"the configuration is that of a training that started from {path}, which is in no "
            "file: pass this policy again as start=..., or train with "
            'dataclasses.replace(config, start="")'
        )
    path = user_path(path)
    if not path.is_dir():
        policy = read_policy(path)
        return dict.fromkeys(seeds, Start(str(path), policy))
    if (path / "config.json").exists():
        raise UserError(
            f"{path} is a run directory: give a policy of it, rtd.load_policy({str(path)!r}, ...), "
            "or use rtd.Study"
        )
    found = {}
    for seed in seeds:
        files = checkpoint_files(lane_directory(path, seed))
        if not files:
            raise UserError(
                f"{path} is no saved policy, and has no checkpoint of seed {seed} to start from"
            )
        found[seed] = Start(_lane_name(path, seed), checkpoint=files[0])
    return found


def starts_if_needed(path: str | Path, directories: Mapping[int, Path]) -> dict[int, Start]:
    """`starts_of_path` for each seed of ``directories``, which may hold checkpoints of its lane.

    A lane with checkpoints that began from ``path`` does not need it any more: if it cannot be
    read, the start of this lane only has a name.

    Raises:
        UserError: as `starts_of_path` does, for any other lane.
    """
    with contextlib.suppress(UserError):
        return starts_of_path(path, tuple(directories))
    found: dict[int, Start] = {}
    for seed, directory in directories.items():
        try:
            found |= starts_of_path(path, (seed,))
        except UserError as error:
            where = identity_there(directory).get("start")
            # The lane may have begun from something else, which its checkpoints would refuse.
            if where not in (str(user_path(path)), _lane_name(user_path(path), seed)):
                raise
            found[seed] = Start(where, missing=str(error))
    return found


def _lane_name(path: Path, seed: int) -> str:
    """The name of a start from the lane of ``seed`` in the ``checkpoint_dir`` ``path``."""
    return f"{path} seed {seed}"
