"""The files of a study's lanes: results, checkpoints and errors.

``lanes/<cell>/seed-<n>.safetensors`` holds a lane's trained policy, its learning curve and its
final episodes. All other files of a run directory, except its configuration and its log, are
derived from these files.
"""

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.serialization import read_interface, restore_policy, under_prefix
from rtd3jax.policies.trained import FORMAT, Policy
from rtd3jax.study.cells import Cell
from rtd3jax.system.files import (
    make_writable,
    read_arrays,
    read_metadata,
    write_arrays,
    write_text_atomically,
)

MOST_LETTERS = 220
"""Maximum length of a cell's name. File systems allow names of 255 bytes, and other files have
longer names with the same parts: ``.robustness_<name>.png.<random>.tmp``."""


class LaneFiles:
    """The files of lanes in a run directory.

    Args:
        path: the run directory.
    """

    def __init__(self, path: Path):
        self.path = path

    def lane_path(self, cell: Cell, seed: int) -> Path:
        """The path of a lane's file."""
        return self._within("lanes", cell_name(cell), f"seed-{seed}.safetensors")

    def digest(self, cell: Cell, seed: int) -> str:
        """The SHA-256 digest of a lane's file; more training, or a new one, changes it."""
        return hashlib.sha256(self.lane_path(cell, seed).read_bytes()).hexdigest()

    def checkpoint_directory(self, cell: Cell, seed: int) -> Path:
        """The directory of a lane's checkpoints."""
        return self._within("checkpoints", cell_name(cell), f"seed-{seed}")

    def playback_path(self, cell: Cell, seed: int) -> Path:
        """The file with the episodes of a lane's policy for the page."""
        return self._within("playback", cell_name(cell), f"seed-{seed}.json")

    def _within(self, *parts: str) -> Path:
        """A path inside the directory; UserError if a link leads outside."""
        path = self.path.joinpath(*parts)
        if not path.resolve().is_relative_to(self.path.resolve()):
            raise UserError(f"{path} leads outside {self.path}; remove the link")
        return path

    def prepare(self, cell: Cell) -> None:
        """Make the directory of a cell's lanes, and raise UserError if it cannot be written."""
        directory = self._within("lanes", cell_name(cell))
        try:
            make_writable(directory)
        except OSError as error:
            raise UserError(
                f"{directory} cannot be written: {error.strerror}; lanes are trained only where "
                "their files can be written"
            ) from error

    def error_path(self, cell: Cell, seed: int) -> Path:
        """The file with the reason why a lane could not be trained."""
        return self.lane_path(cell, seed).with_suffix(".error.txt")

    def error(self, cell: Cell, seed: int) -> str | None:
        """Why the lane could not be trained; None without an error."""
        path = self.error_path(cell, seed)
        return path.read_text("utf-8", "replace").strip() if path.exists() else None

    def is_done(self, cell: Cell, seed: int) -> bool:
        """Whether the lane was trained to its current number of steps, or was lost.

        A lane whose file is damaged counts as done.
        """
        path = self.lane_path(cell, seed)
        if not path.exists():
            return False
        try:
            metadata = read_metadata(path)
            return metadata["cell"]["total_steps"] == cell.config.total_steps or self.is_lost(
                cell, seed
            )
        except (UserError, KeyError, TypeError):
            return True  # reading the file will report the error

    def is_lost(self, cell: Cell, seed: int) -> bool:
        """Whether a lane with a file was lost in training."""
        return read_metadata(self.lane_path(cell, seed))["failure"] is not None

    def write_lane(
        self,
        cell: Cell,
        seed: int,
        parameters: dict[str, np.ndarray],
        curves: dict[str, np.ndarray],
        metrics: dict[str, np.ndarray],
        failure: dict[str, Any] | None,
        interface: dict[str, Any] | None = None,
    ) -> None:
        """Write the file of a lane that has ended.

        Args:
            cell: the cell of the lane.
            seed: the seed of the lane.
            parameters: the arrays of `Policy.parameters`.
            curves: ``steps``, ``returns``, ``true_returns`` [K] and ``final_returns``,
                ``final_true_returns`` [episodes].
            metrics: metrics of learning, [K] by name.
            failure: ``step`` and ``reason`` if the lane was lost, else None.
            interface: the result of `Policy.interface`, with which the policy can be loaded even if
                the cell's environment is not registered.
        """
        arrays = dict(parameters)
        arrays |= {f"results.{name}": np.asarray(value) for name, value in curves.items()}
        arrays |= {f"metrics.{name}": np.asarray(value) for name, value in metrics.items()}
        metadata = {"format": FORMAT, "cell": cell.to_dict(), "seed": seed, "failure": failure}
        if interface is not None:
            metadata["interface"] = interface
        write_arrays(self.lane_path(cell, seed), arrays, metadata)

    def policy(self, cell: Cell, seed: int) -> Policy:
        """The trained policy of a lane.

        Raises:
            UserError: when the lane was not trained to its end or was lost, or when its file is
                damaged or does not fit the environment.
        """
        lane = f"{cell_name(cell)} seed {seed}"
        if not self.is_done(cell, seed):
            raise UserError(f"{lane} is not trained yet in {self.path}; --status prints its state")
        path = self.lane_path(cell, seed)
        arrays, metadata = read_arrays(path)
        if metadata["failure"] is not None:
            raise UserError(f"{lane} was lost in training: {metadata['failure']['reason']}")
        if isinstance(metadata.get("interface"), dict):
            interface = read_interface(path, metadata["interface"])
        else:  # an earlier version wrote the file without it
            env = cell.make_env()
            interface = describe(env, env.default_params)
        return restore_policy(
            path,
            under_prefix(arrays, "actor"),
            interface,
            normaliser=under_prefix(arrays, "normaliser"),
            algorithm=cell.config.algorithm,
            history_length=cell.config.window_tokens,
            width=cell.config.hidden_size,
            memory=cell.config.memory,
            acting=cell.config.acting_mode,
            format=metadata.get("format", 1),
        )

    def start_path(self, cell: Cell, seed: int) -> Path:
        """The file that names the networks from which a lane started."""
        return self.lane_path(cell, seed).with_suffix(".start.txt")

    def write_start(self, cell: Cell, seed: int, what: str) -> None:
        """Write the name of the networks from which a lane starts."""
        write_text_atomically(self.start_path(cell, seed), what + "\n")

    def write_error(self, cell: Cell, seed: int, reason: str) -> None:
        """Write the reason why a lane could not be trained."""
        write_text_atomically(self.error_path(cell, seed), reason + "\n")


def check_names(cells: Iterable[Cell], there: int = 0) -> None:
    """Raise UserError if the directory name of a cell is too long, or two cells have the same one.

    Names that differ only in case are the same on macOS and Windows. The first ``there`` cells have
    files already: their names are only compared with those of the other cells.
    """
    names: dict[str, Cell] = {}
    for index, cell in enumerate(cells):
        name = cell_name(cell)
        if index < there:
            names[name.casefold()] = cell
            continue
        if len(name) > MOST_LETTERS:
            raise UserError(
                f"the directory name of {cell.words} would have {len(name)} letters, of which "
                f"{MOST_LETTERS} are allowed: register the disturbance under a short name "
                "(rtd.register), and use this name"
            )
        other = names.setdefault(name.casefold(), cell)
        if other.key != cell.key:
            before, after = (" ".join(map(str, one.key.values())) for one in (other, cell))
            case = "" if cell_name(other) == name else " but for upper and lower case"
            raise UserError(
                f"the files of {before} and of {after} would have the same name{case}, {name}: "
                "rename an environment or a disturbance, or put them in separate studies"
            )


def cell_name(cell: Cell) -> str:
    """The directory name of a cell; it is unique in a study, see `check_names`."""
    length = f"l{cell.config.history_length}"
    return file_name(cell.env, cell.disturbance, cell.config.algorithm, length)


def file_name(env: str, disturbance: str, *rest: str) -> str:
    """A file name made of an environment, its disturbance and other parts."""
    # "~" replaces "/", which separates alternatives; "-" replaces any other special character.
    text = "_".join((env, disturbance.replace("/", "~"), *rest))
    return re.sub(r"[^A-Za-z0-9._=+~-]", "-", text)
