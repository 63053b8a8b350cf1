"""The configuration of one agent's training: every field, its default and the reason for it.

The flags of the command line, ``config.json`` and the documentation are made from these fields, so
each hyper-parameter is defined once. The paper states no hyper-parameters; the defaults are those
of the published TD3 (Fujimoto et al., 2018) and LSTM-TD3 (Meng et al., 2021).
"""

import dataclasses
import math
import warnings
from collections.abc import Mapping
from typing import Any, Literal, get_args

from rtd3jax.errors import UserError, check_choice
from rtd3jax.registries import AGENTS, MEMORIES

Precision = Literal["float32", "bfloat16"]
Replay = Literal["windows", "segments"]
Acting = Literal["window", "carry"]

PRECISIONS: tuple[Precision, ...] = get_args(Precision)
REPLAYS: tuple[Replay, ...] = get_args(Replay)
ACTINGS: tuple[Acting, ...] = get_args(Acting)

DEFAULT_HISTORY_LENGTH = 10
DEFAULT_SEGMENT_LENGTH = 10


def _field(default: object, help: str, *, traced: bool = False, low: float, high: float = math.inf):
    """A field of the configuration, with its help and its inclusive bounds ``low`` and ``high``.

    Lanes that share a compiled program may differ in the fields that are ``traced``.
    """
    return dataclasses.field(
        default=default, metadata={"help": help, "traced": traced, "low": low, "high": high}
    )


WINDOWS_WITH_CARRY = (
    "acting='carry' with replay='windows': a memory that was trained on windows has never seen a "
    "carry older than its window; on the pendulum under 'hidden', returns fell from 0.98 to 0.71 "
    "of the optimum at history_length=6 (docs/how_it_is_fast.md); train with replay='segments', or "
    "use acting='window'"
)


_FOLLOWS = {"actor_starts": "learning_starts", "replay_capacity": "total_steps"}
"""Fields that are None by default, and the fields whose values they then have."""

_DERIVED = {"acting": "acting_mode", "segment_length": "segment_steps"}
"""Fields whose defaults depend on others, and the properties with their values.

They stay None, so that `dataclasses.replace` does not take their defaults for the user's choice.
"""


@dataclasses.dataclass(frozen=True)
class Config:
    """All settings of one agent's training, except the environment and the seed.

    Raises:
        UserError: when a value is impossible; the message names the field and the remedy.
    """

    algorithm: str = dataclasses.field(
        default="lstm-td3-1ha1hc",
        metadata={"help": "the agent; rtd3jax.agents.variants lists the inputs of each"},
    )
    history_length: int | None = _field(
        None,
        "past steps in a window, l in the paper; 0 for agents without a window "
        f"[{DEFAULT_HISTORY_LENGTH}]",
        low=1,
    )
    total_steps: int = _field(30_000, "environment steps of a lane", low=1)
    hidden_size: int = _field(128, "width H of every layer (the paper's Table: 128)", low=1)
    batch_size: int = _field(100, "transitions in an update (LSTM-TD3: 100)", low=1)
    actor_learning_rate: float = _field(
        1e-3, "learning rate of Adam for the actor", traced=True, low=0
    )
    critic_learning_rate: float = _field(
        1e-3, "learning rate of Adam for the critics", traced=True, low=0
    )
    final_learning_rate_fraction: float = _field(
        1.0,
        "fraction of both learning rates after the last step; the rates fall linearly",
        traced=True,
        low=0,
        high=1,
    )
    gamma: float = _field(0.99, "discount factor", traced=True, low=0, high=1)
    reward_scale: float = _field(
        1.0,
        "factor of the rewards in updates; returns are reported without this factor",
        traced=True,
        low=0,
    )
    tau: float = _field(
        0.005, "fraction of the online weights in a target update", traced=True, low=0, high=1
    )
    exploration_noise: float = _field(
        0.1, "standard deviation of the acting noise, in half action ranges", traced=True, low=0
    )
    target_noise: float = _field(
        0.2, "standard deviation of target policy smoothing, in half ranges", traced=True, low=0
    )
    target_noise_clip: float = _field(
        0.5, "bound of target policy smoothing, in half ranges", traced=True, low=0
    )
    actor_noise: float = _field(
        0.0,
        "standard deviation of the noise that is added to the actor's actions in its loss, in half "
        "ranges (TD3: 0); noise as wide as exploration_noise smooths the critic",
        traced=True,
        low=0,
    )
    update_every: int = _field(
        1,
        "environment steps per critic update (TD3: 1); with more steps, the critics fit the noise "
        "of rewards less; with fewer steps than environments, several updates follow each step of "
        "all environments",
        low=1,
    )
    environments: int = _field(
        1,
        "environments that step together and feed one learner; every count of steps is a sum over "
        "all of them",
        low=1,
    )
    policy_delay: int = _field(2, "critic updates per actor and target update", low=1)
    learning_starts: int = _field(
        1_000,
        "steps with uniformly random actions before the first update; at least batch_size",
        low=1,
    )
    replay_capacity: int | None = _field(
        None, "transitions in the replay; the oldest are replaced first [total_steps]", low=1
    )
    memory: str = dataclasses.field(
        default="lstm",
        metadata={
            "help": "the recurrent cell: lstm (the paper's), gru, min-gru, or a registered one"
        },
    )
    replay: Replay = dataclasses.field(
        default="windows",
        metadata={
            "help": "how the histories of a batch are read: windows (the paper's), a separate "
            "history for each transition; or segments, consecutive transitions that share one "
            "history, which is faster for long histories"
        },
    )
    segment_length: int | None = _field(
        None,
        "consecutive transitions in a segment; divides batch_size "
        f"[the largest divisor up to {DEFAULT_SEGMENT_LENGTH}; 0 with windows]",
        low=0,
    )
    burn_in_gradient: bool = dataclasses.field(
        default=False,
        metadata={
            "help": "whether the gradient of a segment flows into its burn-in, the history_length "
            "steps before it; with segments of ten, this took more time and did not raise returns "
            "(experiments/results/segments_search.csv)"
        },
    )
    acting: Acting | None = dataclasses.field(
        default=None,
        metadata={
            "help": "how the agent acts: window computes the memory from the last steps at every "
            "step; carry updates the memory's carry from the start of the episode [carry with "
            "segments, else window]"
        },
    )
    normalise_observations: bool = dataclasses.field(
        default=False,
        metadata={
            "help": "whether networks read observations normalised by running means and standard "
            "deviations; for plants whose observation elements differ much in size"
        },
    )
    start: str = dataclasses.field(
        default="",
        metadata={
            "help": "networks from which training starts: a saved policy, or a run directory with "
            "a lane of the same agent and seed; RUN@DISTURBANCE names the lane's disturbance "
            "[new weights]"
        },
    )
    freeze: str = dataclasses.field(
        default="",
        metadata={
            "help": "parts of the networks whose weights are not trained, separated by commas: "
            "actor, critics, or a layer of these, such as actor.memory [none]"
        },
    )
    actor_starts: int | None = _field(
        None,
        "environment step at which the updates of the actor begin, if the critics must learn first "
        "[learning_starts]",
        low=0,
    )
    precision: Precision = dataclasses.field(
        default="float32",
        metadata={
            "help": "precision of large matrix products in updates: float32, bfloat16",
        },
    )
    eval_every: int = _field(1_000, "environment steps between evaluations", low=1)
    eval_episodes: int = _field(10, "episodes in an evaluation", low=1)

    def __post_init__(self) -> None:
        AGENTS.check(self.algorithm)
        MEMORIES.check(self.memory)
        check_choice("precision", self.precision, PRECISIONS)
        self._resolve_history_length()
        self._resolve_replay()
        for field in dataclasses.fields(self):
            if "low" in field.metadata:
                object.__setattr__(self, field.name, self._checked(field))
        if self.batch_size > self.learning_starts:
            raise UserError(
                f"batch_size ({self.batch_size}) is larger than learning_starts "
                f"({self.learning_starts}): the first update would have too few transitions; "
                "raise learning_starts or lower batch_size"
            )
        if self.replay == "segments":
            self._check_segments()
        self._check_environments()
        for name in ("start", "freeze"):
            if not isinstance(getattr(self, name), str):
                raise UserError(f"{name} must be a string, not {getattr(self, name)!r}")
        for part in self.frozen:
            whose, point, layer = part.partition(".")
            if whose not in ("actor", "critics") or bool(point) != bool(layer):
                raise UserError(
                    f"freeze: {part!r} is not actor, critics, or a layer of these, such as "
                    "actor.memory"
                )
        window = (1 + self.window_tokens) * self.environments
        if self.capacity < max(self.batch_size, window):
            each = f" of each of {self.environments} environments" if self.environments > 1 else ""
            remedy = "replay_capacity"
            if self.replay_capacity is None:  # the capacity is then total_steps
                remedy = f"total_steps ({self.total_steps}), which it follows"
            raise UserError(
                f"replay_capacity ({self.capacity}) holds less than a batch "
                f"({self.batch_size}) or a window{each} ({window}); raise {remedy}"
            )

    def _resolve_history_length(self) -> None:
        if not self.has_window:
            if self.history_length not in (None, 0):
                warnings.warn(
                    f"history_length={self.history_length} has no effect: {self.algorithm} has "
                    "no window",
                    stacklevel=4,
                )
            object.__setattr__(self, "history_length", 0)
        elif self.history_length is None:
            object.__setattr__(self, "history_length", DEFAULT_HISTORY_LENGTH)

    def _resolve_replay(self) -> None:
        """Check ``replay``, ``acting`` and segments, which have no effect without a history."""
        check_choice("replay", self.replay, REPLAYS)
        if self.acting is not None:
            check_choice("acting", self.acting, ACTINGS)
        for name in ("burn_in_gradient", "normalise_observations"):
            value = getattr(self, name)
            if not isinstance(value, bool):
                raise UserError(f"{name} must be True or False, not {value!r}")
        segments = self.replay == "segments" and self.has_window
        object.__setattr__(self, "replay", "segments" if segments else "windows")
        if not self.has_window:
            object.__setattr__(self, "acting", None)
        elif self.acting == "carry" and not segments:
            warnings.warn(WINDOWS_WITH_CARRY, stacklevel=4)
        if not segments:
            if self.segment_length and self.has_window:
                raise UserError(
                    f"segment_length={self.segment_length} needs replay='segments': with windows, "
                    "every transition has its own history; leave it out, or pass None"
                )
            if self.burn_in_gradient and self.has_window:
                warnings.warn(
                    "burn_in_gradient=True has no effect: windows have no burn-in; it needs "
                    "replay='segments'",
                    stacklevel=4,
                )
            object.__setattr__(self, "segment_length", None)

    def _check_environments(self) -> None:
        count, capacity = self.environments, self.capacity
        if count == 1:
            return
        for name, value in (
            ("total_steps", self.total_steps),
            ("eval_every", self.eval_every),
            ("replay_capacity", capacity),
        ):
            if value % count:
                lower = max(count, value - value % count)
                raise UserError(
                    f"{name} ({value:,}) is not a multiple of environments ({count}), which step "
                    f"together; {lower:,} is one"
                )
        rows = self.segment_steps * count if self.replay == "segments" else 0
        for name, value in (
            ("learning_starts", self.learning_starts),
            ("replay_capacity", capacity),
        ):
            if value < rows:
                raise UserError(
                    f"{name} ({value:,}) holds less than a segment of each environment "
                    f"(segment_length {self.segment_steps} x environments {count} = {rows:,}): "
                    f"raise {name}, or lower segment_length or environments"
                )
        if self.update_every % count and count % self.update_every:
            raise UserError(
                f"update_every ({self.update_every}) and environments ({count}): one must be a "
                "multiple of the other, so that updates follow whole steps of all environments"
            )

    def _check_segments(self) -> None:
        length = self.segment_steps
        if length < 1:
            raise UserError(f"segment_length must be at least 1, not {length}")
        if self.batch_size % length:
            raise UserError(
                f"segment_length ({length}) does not divide batch_size ({self.batch_size}): a "
                "batch consists of whole segments; change one of them"
            )
        if length > self.capacity:
            raise UserError(
                f"segment_length ({length}) is longer than the replay ({self.capacity}); lower "
                "segment_length, or raise replay_capacity"
            )

    def _checked(self, field: dataclasses.Field) -> Any:
        value = getattr(self, field.name)
        if value is None and field.default is None:
            return None
        integral = "int" in str(field.type)
        kind = "an integer" if integral else "a number"
        number = _as_number(value, integral)
        if number is None:
            raise UserError(f"{field.name} must be {kind}, not {value!r}")
        low, high = field.metadata["low"], field.metadata["high"]
        if field.name == "history_length" and not self.has_window:
            low = 0
        if not low <= number <= high:
            bounds = f"at least {low}" if high == math.inf else f"between {low} and {high}"
            raise UserError(f"{field.name} must be {bounds}, not {value!r}")
        if integral and number >= 2**31:
            raise UserError(f"{field.name} must be below 2**31, not {value!r}")
        return number

    @property
    def has_window(self) -> bool:
        """Whether the agent reads past steps."""
        return AGENTS[self.algorithm].has_window

    @property
    def window_tokens(self) -> int:
        """Past tokens in a window: l, or 0 for an agent without a window."""
        assert self.history_length is not None  # `__post_init__` has set it
        return self.history_length

    @property
    def acting_mode(self) -> Acting:
        """How the agent acts: with a ``window``, or with a running ``carry``."""
        return self.acting or self._default_acting

    @property
    def _default_acting(self) -> Acting:
        return "carry" if self.replay == "segments" else "window"

    @property
    def has_running_carry(self) -> bool:
        """Whether the agent acts with a carry that it updates from the start of the episode."""
        return self.acting_mode == "carry"

    @property
    def segment_steps(self) -> int:
        """Consecutive transitions in a segment, m; 0 with windows."""
        if self.replay == "windows":
            return 0
        return self._default_segment_steps if self.segment_length is None else self.segment_length

    @property
    def _default_segment_steps(self) -> int:
        divisors = range(1, DEFAULT_SEGMENT_LENGTH + 1)
        return max(m for m in divisors if self.batch_size % m == 0)

    @property
    def frozen(self) -> tuple[str, ...]:
        """Parts of the networks whose weights are not trained."""
        return tuple(part.strip() for part in self.freeze.split(",") if part.strip())

    @property
    def updates_per_round(self) -> int:
        """Critic updates after each `steps_per_round` steps of all environments."""
        return max(1, self.environments // self.update_every)

    @property
    def steps_per_round(self) -> int:
        """Steps of all environments between two rounds of updates."""
        return max(1, self.update_every // self.environments)

    @property
    def first_learning_step(self) -> int:
        """Number of steps of all environments before the first update."""
        return -(-self.learning_starts // self.environments)

    @property
    def updates(self) -> int:
        """Critic updates in the whole training."""
        steps = max(0, self.total_steps // self.environments - self.first_learning_step)
        return -(-steps // self.steps_per_round) * self.updates_per_round

    @property
    def first_actor_step(self) -> int:
        """The environment step from which on the actor is updated."""
        return self._followed("actor_starts")

    @property
    def updates_before_the_actor(self) -> int:
        """Critic updates before the actor is first updated."""
        first = self.first_learning_step * self.environments
        rounds = -(-(self.first_actor_step - first) // max(self.update_every, self.environments))
        return max(0, rounds) * self.updates_per_round

    @property
    def capacity(self) -> int:
        """Transitions that the replay keeps."""
        return self._followed("replay_capacity")

    def _followed(self, name: str) -> int:
        value: int | None = getattr(self, name)
        return getattr(self, _FOLLOWS[name]) if value is None else value

    @property
    def words(self) -> str:
        """The agent and its history length, for messages: ``"h-td3 l=10"``, or ``"td3"``."""
        length = f" l={self.history_length}" if self.history_length else ""
        return f"{self.algorithm}{length}"

    def to_dict(self) -> dict[str, Any]:
        """The fields as JSON-ready values, with the defaults that depend on other fields."""
        derived = {name: getattr(self, value) for name, value in _DERIVED.items()}
        followed = {name: self._followed(name) for name in _FOLLOWS}
        return {**dataclasses.asdict(self), **derived, **followed}

    @classmethod
    def from_dict(cls, fields: Mapping[str, Any]) -> "Config":
        """The configuration that `to_dict` wrote, in this version or an earlier one.

        ``actor_starts``, ``replay_capacity``, ``acting`` and ``segment_length`` become None again
        if they have the values that follow from other fields.

        Raises:
            UserError: when a value is impossible.
            TypeError: when there is no such field.
        """
        given = dict(fields)
        for name, other in _FOLLOWS.items():
            if given.get(name) == given.get(other, getattr(cls, other)):
                del given[name]
        if not given.get("segment_length"):
            given.pop("segment_length", None)  # 0 with windows
        config = cls(**given)
        defaults = {
            "acting": config._default_acting,
            "segment_length": config._default_segment_steps,
        }
        for name, default in defaults.items():
            if getattr(config, name) == default:
                object.__setattr__(config, name, None)
        return config


def traced_fields() -> tuple[str, ...]:
    """Names of the fields in which lanes of one program may differ."""
    return tuple(f.name for f in dataclasses.fields(Config) if f.metadata.get("traced"))


def _as_number(value: Any, integral: bool) -> int | float | None:
    """``value`` as a plain Python number; None if it is not one, is not finite, or is a boolean.

    If ``integral`` is true, a number that is not whole also gives None.
    """
    if isinstance(value, bool):
        return None
    try:
        number = float(value) if not isinstance(value, str) else None
    except (TypeError, ValueError, OverflowError):
        return None
    if number is None or not math.isfinite(number):
        return None
    if not integral:
        return number
    return int(value) if number == int(number) else None
