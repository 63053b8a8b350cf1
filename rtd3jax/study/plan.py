"""The plan of a sweep: its cells, and an estimate of their memory and time."""

import dataclasses
import itertools
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from rtd3jax.agents.agent import make_part
from rtd3jax.agents.networks import Network
from rtd3jax.config import Config
from rtd3jax.envs.registry import make
from rtd3jax.errors import UserError
from rtd3jax.registries import AGENTS
from rtd3jax.study.memory_plan import job_bytes, lanes_at_once, lanes_in_total
from rtd3jax.study.time_estimate import study_seconds
from rtd3jax.training.lanes import Job, workers
from rtd3jax.training.run import make_jobs


@dataclasses.dataclass(frozen=True)
class Grid:
    """All combinations of one environment, disturbances, algorithms and history lengths."""

    env: str
    disturbances: tuple[str, ...]
    algorithms: tuple[str, ...]
    history_lengths: tuple[int, ...] = (10,)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    """Fields of the configuration that differ from the defaults."""
    own_settings: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    """Fields in which an algorithm differs from ``settings``, by the algorithm's name."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """One configuration under one disturbance; its seeds are its lanes."""

    env: str
    disturbance: str
    config: Config

    @property
    def key(self) -> dict[str, Any]:
        """The columns that identify the cell in tables."""
        return {
            "env": self.env,
            "disturbance": self.disturbance,
            "algorithm": self.config.algorithm,
            "history_length": self.config.history_length,
        }

    @property
    def words(self) -> str:
        """The cell in a few words, for messages: ``"rover ar1-slip h-td3 l=10"``."""
        return f"{self.env} {self.disturbance} {self.config.words}"

    def make_env(self) -> Any:
        """The cell's environment."""
        return make(self.env, self.disturbance)

    def to_dict(self) -> dict[str, Any]:
        """The fields as in config.json."""
        return {"env": self.env, "disturbance": self.disturbance, **self.config.to_dict()}

    @classmethod
    def from_dict(cls, fields: dict[str, Any]) -> "Cell":
        """The cell that `to_dict` wrote."""
        config = {name: value for name, value in fields.items() if name not in _OWN_FIELDS}
        return cls(fields["env"], fields["disturbance"], Config.from_dict(config))


def bar_labels(jobs: Iterable[Job]) -> Callable[[Job], str]:
    """A function that names a job on the bar, with its environment if ``jobs`` have several."""
    if len({job.cell.env for job in jobs}) > 1:
        return lambda job: job.cell.words
    return lambda job: f"{job.cell.config.words} {job.cell.disturbance}"


_OWN_FIELDS = ("env", "disturbance")


def make_cells(grids: Iterable[Grid], overrides: dict[str, Any]) -> list[Cell]:
    """The distinct cells of ``grids``, in order; ``overrides`` are fields of all configurations.

    Raises:
        UserError: when there are no cells, or a configuration is impossible.
    """
    cells: dict[Cell, None] = {}
    with warnings.catch_warnings():
        # Several lengths only apply to agents with windows; td3 occurs once.
        warnings.filterwarnings("ignore", message="history_length=")
        for grid in grids:
            combinations = itertools.product(
                grid.disturbances, grid.algorithms, grid.history_lengths
            )
            for disturbance, algorithm, length in combinations:
                own = grid.own_settings.get(algorithm, {})
                settings = {**grid.settings, **own, **overrides}
                config = Config(algorithm=algorithm, history_length=length, **settings)
                cells[Cell(grid.env, disturbance, config)] = None
    if not cells:
        raise UserError("the sweep has no cells: every list needs at least one entry")
    return list(cells)


def cell_jobs(
    cells: Sequence[Cell], seeds: Sequence[int], strategy: str, stages: Sequence[int] = ()
) -> list[Job]:
    """A job for each cell and seed, with key ``(cell, seed)``.

    Side by side (``vmap``), all history lengths in an environment share the program of the longest
    one: there, a wider matrix product costs almost nothing more. One by one (``map``), each history
    length has a program of its own.

    Args:
        cells: the cells of the study.
        seeds: the seeds of each cell.
        strategy: ``map`` or ``vmap``.
        stages: number of cells before each addition of cells to the study. A longer window that is
            added later does not change the program of earlier cells.
    """
    windows = _windows(cells, stages) if strategy == "vmap" else [None] * len(cells)
    return [
        job
        for cell, window in zip(cells, windows, strict=True)
        for job in make_jobs(cell.make_env(), cell.config, seeds, cell=cell, window=window)
    ]


def _windows(cells: Sequence[Cell], stages: Sequence[int]) -> list[int]:
    """For each cell, the longest window of its environment in the cells up to its stage."""
    longest: dict[str, int] = {}
    found: list[int] = []
    for end in (*stages, len(cells)):
        stage = cells[len(found) : end]
        for cell in stage:
            longest[cell.env] = max(longest.get(cell.env, 0), cell.config.window_tokens)
        found += [longest[cell.env] for cell in stage]
    return found


@dataclasses.dataclass(frozen=True)
class Cost:
    """The estimated memory and time of a sweep.

    Attributes:
        programs: number of programs to compile.
        state_bytes: bytes of the state of the largest lane.
        working_bytes: temporary bytes of the largest lane while it advances.
        seconds: time without compilation; see `rtd3jax.study.time_estimate`.
    """

    programs: int
    state_bytes: int
    working_bytes: int
    seconds: float


def estimate(
    jobs: Sequence[Job],
    strategy: str,
    at_once: int,
    say: Callable[[str], None] = lambda line: None,
) -> Cost:
    """Count programs and bytes, and time some programs; ``say`` receives lines of progress.

    ``at_once`` is the number of lanes that fit in memory, as in `study_seconds`.
    """
    sizes = job_bytes(jobs)
    state, work = (max(column) for column in zip(*sizes.values(), strict=True))
    return Cost(len(sizes), state, work, study_seconds(jobs, strategy, update_flops, say, at_once))


def update_flops(config: Config) -> float:
    """Floating-point operations of the updates' matrix products, per environment step.

    The backward pass of a layer takes two forward passes, one for the gradient of its weights and
    one for the gradient of its input. The first token of a window has no carry, and so no recurrent
    product. No gradient flows into a carry from the replay. Only products that grow with H squared
    are counted; the small products of encoders and outputs are left out. tests/study/test_plan.py
    compares the result with XLA's count.
    """
    variant, batch, width = AGENTS[config.algorithm], config.batch_size, config.hidden_size
    layer = 2.0 * batch * width * width
    # Neither count depends on the sizes of observations and actions, which are small.
    actor, critic = (make_part(variant, role, config.memory, 1, 1, width) for role in _ROLES)

    def token(network: Network) -> tuple[float, float]:
        of_input, of_carry = network.memory.operations() if network.memory else (0.0, 0.0)
        return batch * of_input, batch * of_carry

    def head(network: Network) -> float:
        return layer * (1 + bool(network.reads.memory and network.reads.current))

    segments = config.replay == "segments"

    def present(network: Network) -> float:
        """The current token, and the layers after the memory."""
        return network.reads.memory_has_current * sum(token(network)) + head(network)

    def forward(network: Network) -> float:
        """A history, and a current token that is not part of the history."""
        if not network.reads.memory or network.reads.carry_from_replay:
            return present(network)
        if segments:
            return passed(network, config.window_tokens) + present(network)
        # The first token has no carry.
        return config.window_tokens * sum(token(network)) - token(network)[1] + present(network)

    def passed(network: Network, burn_in: int) -> float:
        """A pass over the tokens of all segments."""
        length = config.segment_steps
        return (burn_in + length) / length * sum(token(network))

    def recorded(network: Network) -> float:
        """The recorded actions, which are part of the segment's tokens."""
        if segments and network.reads.memory and not network.reads.carry_from_replay:
            return passed(network, config.window_tokens) + head(network)
        return forward(network)

    def backward(network: Network) -> float:
        if segments and network.reads.memory and not network.reads.carry_from_replay:
            burn_in = config.window_tokens if config.burn_in_gradient else 0
            return 2 * (passed(network, burn_in) + head(network))
        return 2 * forward(network) - token(network)[1] * network.reads.carry_from_replay

    to_action = head(critic)
    if critic.reads.memory_has_current and "action" in critic.reads.memory:
        to_action += token(critic)[0]
    critics = forward(actor) + 2 * forward(critic) + 2 * (recorded(critic) + backward(critic))
    delayed = recorded(actor) + backward(actor) + forward(critic) + to_action
    return (critics + delayed / config.policy_delay) / config.update_every


_ROLES = ("actor", "critic")


def plan_text(
    cells: Sequence[Cell],
    seeds: Sequence[int],
    jobs: Sequence[Job],
    strategy: str,
    memory: int,
    say: Callable[[str], None] = lambda line: None,
) -> str:
    """The plan of a sweep as text, with memory and time; ``memory`` is in bytes."""
    count = len(workers())
    fit = lanes_at_once(jobs, strategy, count, memory)  # before a lane is allocated and timed
    cost = estimate(jobs, strategy, fit, say)
    in_total = lanes_in_total(fit, strategy, count)
    waits = f"; the other {len(jobs) - in_total:,} wait" if in_total < len(jobs) else ""
    whole = len(cells) * len(seeds)
    left = f", of which {len(jobs)} are left" if len(jobs) < whole else ""
    lines = [f"{len(cells)} cells × {len(seeds)} seeds = {whole} lanes{left}"]
    for cell in cells:
        config = cell.config
        lines.append(
            f"  {cell.env:10} {cell.disturbance:24} {config.algorithm:20} "
            f"l={config.history_length:<3} {config.total_steps:,} steps"
        )
    lines += [
        f"programs to compile: {cost.programs}",
        f"memory of the largest lane: {cost.state_bytes / 2**20:,.1f} MiB of state "
        "(parameters, optimisers, replay, carries, recordings), and "
        f"{cost.working_bytes / 2**20:,.1f} MiB while it advances (activations, gradients)",
        f"lanes that fit in {memory / 2**30:,.1f} GiB"
        f"{' of a device' if strategy == 'vmap' else ''}: {min(fit, len(jobs)):,}{waits}",
        f"time: about {_duration(cost.seconds)} on {count} "
        f"{'cores' if workers()[0].platform == 'cpu' else 'devices'}, "
        "measured just now, without compilation",
    ]
    return "\n".join(lines)


def _duration(seconds: float) -> str:
    return f"{seconds / 3600:.1f} h" if seconds > 5400 else f"{seconds / 60:.1f} min"
