"""The files of a study's lanes: what each was trained to, where it can go on, why it could not.

``lanes/<cell>/seed-<n>.safetensors`` holds a lane's trained policy, its learning curve and its
final episodes. All else in a run directory follows from them, but its configuration and its log.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from rtd3jax.envs.interface import describe
from rtd3jax.errors import UserError
from rtd3jax.policies.serialization import below, read_interface, restore_policy
from rtd3jax.policies.trained import FORMAT, Policy
from rtd3jax.study.plan import Cell
from rtd3jax.system.files import read_arrays, read_metadata, write_arrays, write_bytes_atomically


class LaneFiles:
    """The files below a run directory that belong to one lane each.

    Args:
        path: the run directory.
    """

    def __init__(self, path: Path):
        self.path = path

    def lane_path(self, cell: Cell, seed: int) -> Path:
        """Where a lane's file is."""
        return self._within("lanes", cell_name(cell), f"seed-{seed}.safetensors")

    def checkpoint_directory(self, cell: Cell, seed: int) -> Path:
        """Where a lane that is under way keeps its checkpoints."""
        return self._within("checkpoints", cell_name(cell), f"seed-{seed}")

    def playback_path(self, cell: Cell, seed: int) -> Path:
        """Where the page keeps the episodes that a lane's policy played for it."""
        return self._within("playback", cell_name(cell), f"seed-{seed}.json")

    def _within(self, *parts: str) -> Path:
        """A path inside the directory, also where links lead elsewhere."""
        path = self.path.joinpath(*parts)
        if not path.resolve().is_relative_to(self.path.resolve()):
            raise UserError(f"{path} leads outside {self.path}; remove the link")
        return path

    def error_path(self, cell: Cell, seed: int) -> Path:
        """Where the reason stands for which a lane could not be trained."""
        return self.lane_path(cell, seed).with_suffix(".error.txt")

    def is_done(self, cell: Cell, seed: int) -> bool:
        """Whether the lane was trained to its end, be it lost; with more steps later, to that."""
        path = self.lane_path(cell, seed)
        if not path.exists():
            return False
        try:
            metadata = read_metadata(path)
            return metadata["cell"]["total_steps"] == cell.config.total_steps or self.is_lost(
                cell, seed
            )
        except (UserError, KeyError, TypeError):
            return True  # whoever reads it says what is wrong with it

    def is_lost(self, cell: Cell, seed: int) -> bool:
        """Whether the lane, which has a file, was lost in training."""
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
        """Keep a lane that ended.

        Args:
            cell: its cell.
            seed: its seed.
            parameters: of its policy, as `Policy.parameters` names them.
            curves: ``steps``, ``returns``, ``true_returns`` [K] and ``final_returns``,
                ``final_true_returns`` [episodes].
            metrics: of learning, [K] by name.
            failure: step and reason, if the lane was lost.
            interface: what `Policy.interface` says of its policy, which then can be loaded where
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
            raise UserError(
                f"{lane} is not trained yet in {self.path}; --status tells how far it is"
            )
        path = self.lane_path(cell, seed)
        arrays, metadata = read_arrays(path)
        if metadata["failure"] is not None:
            raise UserError(f"{lane} was lost in training: {metadata['failure']['reason']}")
        if isinstance(metadata.get("interface"), dict):
            interface = read_interface(path, metadata["interface"])
        else:  # of a version that did not write it
            env = cell.make_env()
            interface = describe(env, env.default_params)
        return restore_policy(
            path,
            below(arrays, "actor"),
            interface,
            normaliser=below(arrays, "normaliser"),
            algorithm=cell.config.algorithm,
            history_length=cell.config.window_tokens,
            width=cell.config.hidden_size,
            memory=cell.config.memory,
            acting="carry" if cell.config.runs_on else "window",
            format=metadata.get("format", 1),
        )

    def start_path(self, cell: Cell, seed: int) -> Path:
        """Where it stands what a lane began from, if it did not begin with new weights."""
        return self.lane_path(cell, seed).with_suffix(".start.txt")

    def write_start(self, cell: Cell, seed: int, what: str) -> None:
        """Keep what a lane begins from."""
        write_bytes_atomically(self.start_path(cell, seed), (what + "\n").encode())

    def write_error(self, cell: Cell, seed: int, reason: str) -> None:
        """Keep the reason for which a lane could not be trained."""
        write_bytes_atomically(self.error_path(cell, seed), (reason + "\n").encode())


def cell_name(cell: Cell) -> str:
    """A directory name that tells cells apart."""
    disturbance = cell.disturbance.replace("/", "~")  # alternatives, told from other characters
    text = f"{cell.env}_{disturbance}_{cell.config.algorithm}_l{cell.config.history_length}"
    return re.sub(r"[^A-Za-z0-9._=+~-]", "-", text)
