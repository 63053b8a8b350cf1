"""Disturbances that replay a recording."""

import hashlib
import warnings
from collections.abc import Sequence
from typing import Any, ClassVar, Self

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from rtd3jax.envs.log import read_episodes, rows_per_step
from rtd3jax.envs.processes.disturbances import check_elements
from rtd3jax.envs.processes.process import Process, float32, require, require_ordered
from rtd3jax.errors import UserError, nearest

_PARAMETERS = (
    *("log", "channel", "columns", "episode", "period", "step", "bounds", "elements"),
    *("independent", "mirror"),
)
_LEAVES = {"values", "begins", "lengths", "low", "high"}
PLAYED_ON = ("observation", "action", "reward", "slip")
MOST_ROWS = 2**31 - 1
"""Rows of all recordings, at most: rows are counted with int32."""
FAR = 0.1
"""A split that misses the wanted fraction of the rows by more than this is reported."""


class RecordedState(struct.PyTreeNode):
    """Position of each of the N elements in the recordings."""

    value: jax.Array
    """float32 [N], the values that act on the next signal"""
    time: jax.Array
    """int32 []: step of the episode"""
    begin: jax.Array
    """int32 [N]: first row of the chosen recording"""
    length: jax.Array
    """int32 [N]: number of its rows"""
    start: jax.Array
    """int32 [N]: row of the recording at which the episode starts"""
    elements: tuple[int, ...] = struct.field(pytree_node=False, default=())
    """indices of the disturbed elements of the signal; () means all"""
    size: int = struct.field(pytree_node=False, default=0)
    """elements of the signal"""

    @property
    def slip(self) -> jax.Array:
        """float32 [size], the current values, under the name that the rover's pictures read."""
        return _placed(self.value, self.elements, self.size)


class Recorded(Process):
    """Replays recordings: in each episode, a random part of a random recording.

    Every row after which a whole episode fits into the recording is equally likely to be the first
    row. All elements are replayed from the same row, unless they are ``independent``. The values
    are added to the signal; with ``channel="slip"``, the output is ``(1 - value)`` times the
    signal, as for the slip of the rover's wheels.

    The numbers are leaves: recordings of equal shapes share one compiled program, and lanes of one
    program may replay different recordings. Instances with equal values and options are equal, and
    have equal hashes.
    """

    values: Any
    """float32 [R, N]: all rows of all recordings, one after the other"""
    begins: Any
    """int32 [E]: the first row of each of E recordings"""
    lengths: Any
    """int32 [E]: the number of rows of each recording"""
    low: Any
    """float32 [] or [N]: lower bound, to which values are clipped"""
    high: Any
    """float32 [] or [N]: upper bound, to which values are clipped"""
    channel: str = struct.field(pytree_node=False)
    elements: tuple[int, ...] = struct.field(pytree_node=False)
    """Indices of the disturbed elements of the signal, one for each column; () means all."""
    independent: bool = struct.field(pytree_node=False)
    mirror: bool = struct.field(pytree_node=False)

    # What only `split` and `rtd3jax.fit_process` need is no field, so it is no part of a program
    # or of a plant's identity. Transformations of JAX lose it; `replace` keeps it.
    episode_of: ClassVar[np.ndarray | None] = None
    """int64 [E]: number of the episode that each recording is a part of; None if it is not known"""
    log_rows_per_step: ClassVar[float] = 1.0
    """Rows of the log in one step; unless it is whole, the rows are interpolated."""

    def __init__(
        self,
        log: object = None,
        *,
        channel: str = "observation",
        columns: Sequence[str] | str | None = None,
        episode: str | None = None,
        period: float | None = None,
        step: float | None = None,
        bounds: tuple[Any, Any] | None = None,
        elements: tuple[int, ...] = (),
        independent: bool = False,
        mirror: bool = False,
        **fields: Any,
    ) -> None:
        """Read a log of N elements.

        Args:
            log: a CSV or Parquet file, a pandas table, an array [T], [T, N] or [E, T, N], or a list
                of arrays [T, N]. A row with NaN is a gap, which separates two recordings.
            channel: the recorded quantity: an offset of the "observation", the "action" or the
                "reward", in its unit, or the "slip" of wheels, as a fraction of their speed.
            columns: columns of a file or table; all except the episode's by default. See
                `rtd3jax.envs.log.read_log` for this and the next three arguments.
            episode: the column that numbers the episodes; "episode" by default, if there is one.
            period: time in s between two samples of the log.
            step: time in s between two steps of the environment; the log is interpolated linearly,
                unless ``step`` is a multiple of ``period``.
            bounds: (low, high), to which the values are clipped, numbers or arrays [N]; none by
                default.
            elements: indices of the disturbed elements of the signal, one for each column; () means
                all.
            independent: draw a recording and a start separately for each element. A short log then
                gives more different episodes, but the elements are no longer correlated.
            mirror: replay a recording that is shorter than an episode to its end, then backwards,
                and so on. Without this option, short recordings are never replayed, and a log with
                only short recordings is refused.
            **fields: the fields of an existing instance; `replace` passes them, and takes all other
                arguments except those of the reading: the log, columns, episode, period and step.

        Raises:
            UserError: for a log that cannot be read or replayed.
        """
        if fields:
            unknown = sorted(fields.keys() - _LEAVES)
            if unknown or fields.keys() != _LEAVES:
                name = (unknown or sorted(fields))[0]
                raise UserError(f"Recorded has no parameter {name!r}{nearest(name, _PARAMETERS)}")
            _refuse_reading(log=log, columns=columns, episode=episode, period=period, step=step)
            if bounds is not None:
                fields["low"], fields["high"] = _bounds(bounds)
        else:
            if log is None:
                raise UserError("Recorded needs a log: a CSV or Parquet file, or an array [T, N]")
            episodes = read_episodes(log, columns, episode, period, step)
            low, high = _bounds(bounds)
            stretches = [part for parts in episodes for part in parts]
            fields = {**_leaves(stretches), "low": low, "high": high}
            numbers = np.repeat(np.arange(len(episodes)), [len(parts) for parts in episodes])
            object.__setattr__(self, "episode_of", numbers)
            object.__setattr__(self, "log_rows_per_step", rows_per_step(period, step))
        fields |= {
            "channel": channel,
            "elements": elements,
            "independent": independent,
            "mirror": mirror,
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        if log is not None or bounds is not None:
            self.validate()

    def init(self, key: jax.Array, horizon: int | jax.Array, size: int) -> RecordedState:
        """Draw the recording and the row at which the episode starts."""
        self.output_size(size)
        count = self.values.shape[-1]
        draws = count if self.independent else 1
        lengths = jnp.asarray(self.lengths, jnp.int32)
        starts = self._starts(lengths, jnp.asarray(horizon, jnp.int32))
        ends = jnp.cumsum(starts, dtype=jnp.int32)
        place = jax.random.randint(key, (draws,), 0, jnp.maximum(ends[-1], 1), jnp.int32)
        which = jnp.searchsorted(ends, place, side="right").astype(jnp.int32)
        which = jnp.minimum(which, lengths.shape[0] - 1)
        state = RecordedState(
            value=jnp.zeros((count,), jnp.float32),
            time=jnp.zeros((), jnp.int32),
            begin=jnp.broadcast_to(jnp.asarray(self.begins, jnp.int32)[which], (count,)),
            length=jnp.broadcast_to(lengths[which], (count,)),
            start=jnp.broadcast_to(place - (ends[which] - starts[which]), (count,)),
            elements=self.elements,
            size=size,
        )
        return state.replace(value=self._value(state))

    def _starts(self, lengths: jax.Array, horizon: jax.Array) -> jax.Array:
        """Number of rows [E] of each recording at which an episode may start."""
        fitting = jnp.maximum(lengths - (self._needed(horizon) - 1), 0)
        # `check_use` cannot check a traced horizon. If no recording is long enough, it is mirrored.
        anywhere = self.mirror | ~jnp.any(fitting > 0)
        return jnp.where(anywhere & (fitting == 0), lengths, fitting)

    def _needed(self, horizon: Any) -> Any:
        """Signals in an episode; there is also an observation before the first step."""
        return horizon + (1 if self.channel == "observation" else 0)

    def _value(self, state: RecordedState) -> jax.Array:
        """The values [N] at the state's time; after the end, the recording runs backwards."""
        turn = jnp.maximum(2 * (state.length - 1), 1)
        row = (state.start + state.time) % turn
        row = state.begin + jnp.where(row < state.length, row, turn - row)
        columns = jnp.arange(self.values.shape[-1], dtype=jnp.int32)
        value = jnp.asarray(self.values, jnp.float32)[row, columns]
        return jnp.clip(
            value,
            jnp.broadcast_to(float32(self.low), value.shape),
            jnp.broadcast_to(float32(self.high), value.shape),
        )

    def step(
        self, key: jax.Array, state: RecordedState, signal: jax.Array
    ) -> tuple[jax.Array, RecordedState]:
        """Apply the values of a row, then go to the next row."""
        value = _placed(state.value, self.elements, signal.shape[-1])
        signal = (1.0 - value) * signal if self.channel == "slip" else signal + value
        state = state.replace(time=state.time + 1)
        return signal, state.replace(value=self._value(state))

    def output_size(self, size: int) -> int:
        """Unchanged; UserError unless there is a column for each disturbed element."""
        count = self.values.shape[-1]
        if self.elements:
            check_elements(self, self.elements, size)
        elif count != size:
            raise UserError(
                f"Recorded: the recording has {count} element{'s' * (count != 1)} and the "
                f"{self.channel} {size}; choose columns, or pass elements=(...)"
            )
        return size

    def check_use(self, horizon: int, field: str) -> None:
        """Raise UserError unless the channel agrees and some recording is long enough."""
        if field in PLAYED_ON and self.channel not in (field, "slip"):
            raise UserError(
                f"Recorded: a recording of the {self.channel} cannot act on the {field}; "
                f"pass channel={field!r} when you read the log"
            )
        if self.mirror or isinstance(self.lengths, jax.core.Tracer):
            return
        longest, needed = int(np.max(self.lengths)), self._needed(horizon)
        if longest < needed:
            raise UserError(
                f"Recorded: the longest recording without a gap has {longest:,} rows, and an "
                f"episode needs {needed:,}; lower max_steps_in_episode, or pass mirror=True to "
                "replay recordings forwards and backwards"
            )

    def validate(self) -> None:
        """Check the bounds, the channel and the elements."""
        if self.channel not in PLAYED_ON:
            raise UserError(
                f"Recorded: channel {self.channel!r} must be one of {', '.join(PLAYED_ON)}"
                f"{nearest(str(self.channel), PLAYED_ON)}"
            )
        for name in ("independent", "mirror"):
            if not isinstance(getattr(self, name), bool):
                raise UserError(f"Recorded: {name} must be True or False")
        count = self.values.shape[-1]
        for name in ("low", "high"):
            require(self, name)
            if np.ndim(getattr(self, name)) and np.shape(getattr(self, name)) != (count,):
                raise UserError(f"Recorded: each bound must be one number or {count} numbers")
        require_ordered(self, "low", "high")
        if self.elements:
            whole = isinstance(self.elements, tuple) and all(
                isinstance(element, int) for element in self.elements
            )
            if not whole:
                raise UserError(f"Recorded: elements={self.elements!r} must be a tuple of indices")
            check_elements(self, self.elements)
            if len(self.elements) != count:
                raise UserError(
                    f"Recorded: {len(self.elements)} elements for a recording of {count} columns; "
                    "pass one for each"
                )
        if self.channel == "slip" and not isinstance(self.values, jax.core.Tracer):
            played = np.clip(self.values, self.low, self.high)
            if np.min(played) < -1.0 or np.max(played) > 1.0:
                raise UserError(
                    f"Recorded: slip is a fraction of the speed, but the recording goes from "
                    f"{np.min(played):.3g} to {np.max(played):.3g}; divide it by the commanded "
                    "speed, or pass bounds=(0, 1)"
                )

    def sequences(self) -> list[np.ndarray]:
        """The recordings before they are clipped to the bounds: float32 [T, N] each."""
        values = np.asarray(self.values)
        return [values[b : b + n] for b, n in zip(self.begins, self.lengths, strict=True)]

    def split(self, fraction: float = 0.8) -> tuple["Recorded", "Recorded"]:
        """Split into the first ``fraction`` of the rows, for training, and the rest, for tests.

        With several episodes, the split lies between two of them, as near to ``fraction`` as
        possible, so no episode is on both sides, even if gaps divide it into several recordings.
        It warns if a side then has far more rows than wanted. A single episode is split in time.

        Raises:
            UserError: if one of the sides would be empty.
        """
        number = isinstance(fraction, float | int | np.number) and not isinstance(fraction, bool)
        if not number or not 0.0 < fraction < 1.0:
            raise UserError(f"split: fraction={fraction!r} must lie between 0 and 1")
        parts = self.sequences()
        own = np.arange(len(parts)) if self.episode_of is None else self.episode_of
        ends = np.cumsum([len(part) for part in parts])
        rows = int(ends[-1])
        between = ends[:-1][own[1:] != own[:-1]]
        if between.size:
            cut = int(between[np.argmin(np.abs(between / rows - fraction))])
        else:
            cut = round(fraction * rows)
            if not 0 < cut < rows:
                raise UserError(f"split: {rows} rows cannot be split at {fraction:g} of them")
        if abs(cut / rows - fraction) > FAR:
            warnings.warn(
                f"split: the first side has {100 * cut / rows:.0f}% of the rows, not "
                f"{100 * fraction:.0f}%, because no episode is divided; record more episodes, or "
                "number shorter ones",
                stacklevel=2,
            )
        # Rows of each recording that lie before the cut: all, none, or a part of one.
        before = [
            min(max(cut - (end - len(part)), 0), len(part))
            for part, end in zip(parts, ends, strict=True)
        ]
        first = [part[:count] for part, count in zip(parts, before, strict=True)]
        second = [part[count:] for part, count in zip(parts, before, strict=True)]
        return self._of(first, own), self._of(second, own)

    def _of(self, stretches: Sequence[np.ndarray], episode_of: np.ndarray) -> "Recorded":
        """The same options with these sequences, without the empty ones."""
        some = np.array([len(part) > 0 for part in stretches])
        recorded = self.replace(**_leaves([part for part in stretches if len(part)]))
        object.__setattr__(recorded, "episode_of", episode_of[some])
        return recorded

    def replace(self, **changes: Any) -> Self:
        """A copy with other values of these fields; it knows the episodes of the same rows."""
        other = super().replace(**changes)
        if not changes.keys() & {"values", "begins", "lengths"}:
            object.__setattr__(other, "episode_of", self.episode_of)
        object.__setattr__(other, "log_rows_per_step", self.log_rows_per_step)
        return other

    def _digest(self) -> tuple:
        leaves = (self.values, self.begins, self.lengths, self.low, self.high)
        if any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return (id(self),)
        if not all(
            isinstance(leaf, np.ndarray | np.generic | jax.Array | float) for leaf in leaves
        ):
            return (*map(id, leaves), self.channel)
        arrays = [np.ascontiguousarray(leaf) for leaf in leaves]
        digest = hashlib.sha256(b"".join(array.tobytes() for array in arrays)).hexdigest()
        shapes = tuple(array.shape for array in arrays)
        return (digest, shapes, self.channel, self.elements, self.independent, self.mirror)

    def __eq__(self, other: object) -> bool:
        """Whether both have the same numbers and the same options."""
        if type(other) is not type(self):
            return NotImplemented
        return self._digest() == other._digest()

    def __hash__(self) -> int:
        """Hash of the numbers and the options."""
        return hash(self._digest())

    def __repr__(self) -> str:
        """A summary without the numbers."""
        if not all(hasattr(leaf, "shape") for leaf in (self.values, self.lengths)):
            return f"Recorded({self.values!r})"
        return (
            f"Recorded({self.lengths.shape[-1]} recordings, {self.values.shape[-2]:,} rows of "
            f"{self.values.shape[-1]}, channel={self.channel!r})"
        )


def _placed(value: jax.Array, elements: tuple[int, ...], size: int) -> jax.Array:
    """The values [..., N] at these elements of a signal [..., size], and zeros elsewhere."""
    if not elements:
        return value
    everything = jnp.zeros((*value.shape[:-1], size), jnp.float32)
    return everything.at[..., jnp.asarray(elements, jnp.int32)].set(value)


def _refuse_reading(**arguments: object) -> None:
    """Raise UserError for an argument that acts when a log is read, but is given to `replace`."""
    for name, value in arguments.items():
        if value is not None:
            raise UserError(
                f"Recorded: {name} only acts when a log is read, so it cannot be replaced: read "
                "the log again with rtd.Recorded(log, ...)"
            )


def _leaves(stretches: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays of `Recorded` for these sequences [T, N]."""
    lengths = np.array([len(part) for part in stretches], np.int32)
    total = sum(map(len, stretches))
    if total > MOST_ROWS:
        raise UserError(f"Recorded: {total:,} rows are more than int32 can count; shorten the log")
    begins = np.concatenate([[0], np.cumsum(lengths)[:-1]]).astype(np.int32)
    return {
        "values": np.concatenate(stretches).astype(np.float32),
        "begins": begins,
        "lengths": lengths,
    }


def _bounds(bounds: tuple[Any, Any] | None) -> tuple[np.ndarray, np.ndarray]:
    """Low and high as float32; the limits of float32 if there are no bounds."""
    if bounds is None:
        most = np.finfo(np.float32).max
        bounds = (-most, most)
    try:
        low, high = (np.asarray(bound, np.float32) for bound in bounds)
    except (TypeError, ValueError):
        raise UserError(
            f"Recorded: bounds={bounds!r} must be (low, high), each a number or one for each column"
        ) from None
    return low, high
