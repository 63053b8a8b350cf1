"""`load_policy`: loads a trained policy from a file, or from a run directory of the sweep."""

import os
from typing import TYPE_CHECKING, Any

from rtd3jax.errors import UserError
from rtd3jax.policies.serialization import read_policy
from rtd3jax.policies.trained import Policy
from rtd3jax.system.files import user_path

if TYPE_CHECKING:
    from rtd3jax.study.cells import Cell
    from rtd3jax.study.rundir import RunDirectory


def load_policy(
    path: str | os.PathLike,
    *,
    algorithm: str | None = None,
    seed: int | None = None,
    env: str | None = None,
    disturbance: str | None = None,
    history_length: int | None = None,
) -> Policy:
    """Load the policy of a file that ``policy.save`` wrote, or of one lane of a run directory.

    Args:
        path: the file, or the run directory that `rtd3jax.sweep` wrote. The other arguments choose
            a lane of the directory; an argument is not necessary if all cells have the same value.
        algorithm: the name of the agent.
        seed: the seed of the lane [0].
        env: the id of the environment.
        disturbance: the disturbance, as in the command of the sweep.
        history_length: l.

    Raises:
        UserError: when the file is missing, damaged or not a policy, or is given with arguments
            that choose a lane; when the lane is missing, lost or not trained yet; when several
            cells agree with the arguments.
    """
    given: dict[str, Any] = {
        "env": env,
        "disturbance": disturbance,
        "algorithm": algorithm,
        "history_length": history_length,
        "seed": seed,
    }
    given = {name: value for name, value in given.items() if value is not None}
    if not isinstance(path, str | os.PathLike):
        raise UserError(f"load_policy needs the path of a file or a run directory, not {path!r}")
    path = user_path(path)
    try:
        is_directory = path.is_dir()
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from error
    if not is_directory:
        if given:
            raise UserError(
                f"{path} is not a run directory: {', '.join(given)} cannot choose a lane of it"
            )
        return read_policy(path)
    # Imported here: it imports libraries for tables, which a policy in a file does not need.
    from rtd3jax.study.rundir import RunDirectory

    directory = RunDirectory.open(path)
    seed = given.pop("seed", 0)
    cell = _choose(directory, given)
    return directory.lanes.policy(cell, directory.own_seed(seed))


def _choose(directory: "RunDirectory", wanted: dict[str, Any]) -> "Cell":
    """The only cell that has the values ``wanted``."""
    cells = directory.cells
    for name, value in wanted.items():
        there = _values(cells, name)
        cells = [cell for cell in cells if cell.key[name] == value]
        if not cells:
            raise UserError(
                f"{directory.path} has no such cell with {name}={value}; its values of {name} are "
                f"{' and '.join(map(str, there))}"
            )
    for name in cells[0].key:
        there = _values(cells, name)
        if len(there) > 1:
            raise UserError(
                f"{len(cells)} cells of {directory.path} agree with the arguments; choose {name}: "
                f"{', '.join(map(str, there))}"
            )
    if len(cells) > 1:
        raise UserError(f"{len(cells)} cells of {directory.path} only differ in other settings")
    return cells[0]


def _values(cells: "list[Cell]", name: str) -> list[Any]:
    """The values of ``name`` in these cells."""
    return list(dict.fromkeys(cell.key[name] for cell in cells))
