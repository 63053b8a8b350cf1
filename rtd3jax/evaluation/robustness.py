"""The test of robustness: returns of policies against the strength of stresses."""

import dataclasses
import functools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from rtd3jax.envs.disturbed import Disturbed
from rtd3jax.envs.entry import parameters_of, step_limit
from rtd3jax.envs.interface import Interface, describe, environment_name
from rtd3jax.envs.processes.impairment import Impairment
from rtd3jax.envs.processes.process import Process
from rtd3jax.envs.registry import description_of
from rtd3jax.envs.stress import SIGNAL_STRESSES, Stress
from rtd3jax.errors import UserError, nearest, short_reason
from rtd3jax.evaluation.play import check_fits
from rtd3jax.evaluation.returns import unchecked_returns
from rtd3jax.policies.compatibility import fitted
from rtd3jax.policies.impaired import ImpairedPolicy
from rtd3jax.protocols import EnvironmentLike, PolicyLike
from rtd3jax.system.numbers import check_counts, standard_error

if TYPE_CHECKING:  # importing pandas takes half a second
    import pandas as pd

MEASURED = (
    "stress",
    "quantity",
    "value",
    "return",
    "standard_error",
    "true_return",
    "true_standard_error",
    "episodes",
)
"""The columns of `rows_of`: a value of a stress, and the returns of a policy under it."""

COLUMNS = ("policy", *MEASURED)
"""Columns of a table of robustness; a row per policy, stress and value."""

_CHANNELS = ("observation", "action")


@dataclasses.dataclass(frozen=True)
class Case:
    """One value of one stress, checked: an environment, and processes between it and the policy."""

    stress: Stress
    value: float
    env: EnvironmentLike
    params: Any
    interface: Interface
    observation: Process = Impairment()
    action: Process = Impairment()

    def returns(
        self, policy: PolicyLike, episodes: int, seed: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Returns, and returns of the undisturbed state: float64 [episodes] each."""
        played = ImpairedPolicy(
            fitted(policy, self.interface.action_shape),
            self.observation,
            self.action,
            step_limit(self.params),
            *self.interface.sizes,
        )
        both = unchecked_returns(played, self.env, episodes, seed, self.params)
        first, second = (np.asarray(returns, np.float64) for returns in both)
        return first, second


def robustness(
    policies: PolicyLike | Mapping[str, PolicyLike],
    env: EnvironmentLike,
    stresses: Iterable[str | Stress] | None = None,
    episodes: int = 100,
    seed: int = 0,
    *,
    params: object = None,
) -> "pd.DataFrame":
    """Mean returns of policies against the strength of disturbances and changes of the plant.

    All policies meet the same episodes under all values of all stresses: the same starts, and the
    same random numbers of the environment's own disturbance, which acts too unless a stress
    replaces it. So differences between rows have less noise than the rows themselves. Noise, lost
    readings and delays act between the environment and the policy; at strength zero, and at
    factor one, the returns are those of `rtd3jax.evaluate`.

    Args:
        policies: a policy, or policies by name.
        env: a gymnax >= 1.0 environment; it may be disturbed.
        stresses: names of stresses, as "delay", or with values, as "delay=0,2,4"; or `Stress`
            objects. By default all stresses of ``env``: "noise", "delay", "dropout",
            "action-delay", those of its registration, such as "slip" of the rover, and
            "<parameter>-factor" for each of its positive parameters.
        episodes: number of episodes of each row.
        seed: seed of these episodes.
        params: the environment's parameters; its default parameters by default.

    Returns:
        a row per policy, stress and value. ``quantity`` states what ``value`` is. ``return`` is the
        mean return and ``standard_error`` its standard error (NaN for a single episode);
        ``true_return`` and ``true_standard_error`` are those of the rewards of the undisturbed
        state, where the environment provides them, and otherwise the same numbers.

    Raises:
        UserError: for an unknown stress, an impossible value, or a policy of other shapes.
    """
    import pandas as pd

    check_counts(episodes, seed)
    cases = make_cases(env, stresses, params=params)
    named = policies if isinstance(policies, Mapping) else {"policy": policies}
    if not named:
        raise UserError("a test of robustness needs at least one policy")
    for name, policy in named.items():
        check_policy(policy, cases, f"policy {name!r}: " if isinstance(policies, Mapping) else "")
    rows = [
        {"policy": name, **row}
        for name, policy in named.items()
        for row in rows_of(policy, cases, int(episodes), int(seed))
    ]
    return pd.DataFrame(rows, columns=list(COLUMNS))


def stresses_of(env: EnvironmentLike, env_id: str | None = None) -> tuple[Stress, ...]:
    """The stresses of any environment, then those registered for ``env``."""
    return (*SIGNAL_STRESSES, *description_of(env, env_id).stresses)


def make_cases(
    env: EnvironmentLike,
    stresses: Iterable[str | Stress] | None = None,
    *,
    params: object = None,
    env_id: str | None = None,
) -> list[Case]:
    """All values of all stresses in order, checked; nothing is compiled.

    Arguments and errors are those of `robustness`; ``env_id`` is the registered id, by default that
    of an equal environment.
    """
    params = parameters_of(env, params)
    interface = describe(env, params)
    known = stresses_of(env, env_id)
    if stresses is None:
        chosen = list(known)
    else:
        given = [stresses] if isinstance(stresses, str | Stress) else list(stresses)
        chosen = [_stress(item, known, environment_name(env)) for item in given]
    if not chosen:
        raise UserError("a test of robustness needs at least one stress")
    for name in (stress.name for stress in chosen):
        if sum(stress.name == name for stress in chosen) > 1:
            raise UserError(f"stress {name} is given twice; give all its values at once")
    nominal = functools.partial(Case, env=env, params=params, interface=interface)
    return [_case(nominal(stress, value)) for stress in chosen for value in stress.values]


def check_policy(policy: PolicyLike, cases: Sequence[Case], what: str = "") -> None:
    """Raise UserError, which begins with ``what``, unless the policy fits the environment."""
    interface = cases[0].interface
    try:
        check_fits(policy, interface)
    except UserError as error:
        raise UserError(f"{what}{error}") from error


def rows_of(
    policy: PolicyLike, cases: Sequence[Case], episodes: int, seed: int
) -> Iterator[dict[str, Any]]:
    """A row for each case, with the columns `MEASURED`."""
    for case in cases:
        returns, true = case.returns(policy, episodes, seed)
        yield {
            "stress": case.stress.name,
            "quantity": case.stress.quantity,
            "value": float(case.value),
            "return": returns.mean(),
            "standard_error": standard_error(returns),
            "true_return": true.mean(),
            "true_standard_error": standard_error(true),
            "episodes": episodes,
        }


def _stress(item: str | Stress, known: Sequence[Stress], where: str) -> Stress:
    """The stress itself, or the known stress of that name, with values if these are given."""
    if isinstance(item, Stress):
        return item
    name, equals, text = str(item).partition("=")
    found = next((stress for stress in known if stress.name == name.strip()), None)
    if found is None:
        names = [stress.name for stress in known]
        raise UserError(
            f"unknown stress {name.strip()!r} of {where}{nearest(name.strip(), names)} "
            f"(known: {', '.join(names)})"
        )
    if not equals:
        return found
    try:
        values = tuple(float(value) for value in text.split(","))
    except ValueError:
        raise UserError(f"stress {item!r}: write values as {name.strip()}=0,0.5,1") from None
    return dataclasses.replace(found, values=values)


def _case(nominal: Case) -> Case:
    """``nominal`` with the change of its stress: other parameters, a process, or an environment.

    Raises:
        UserError: when the stress cannot be applied with this value.
    """
    stress, value, env = nominal.stress, nominal.value, nominal.env
    is_wrapped = isinstance(env, Disturbed)
    plant = nominal.params.env if is_wrapped else nominal.params
    try:
        changed = stress.change(plant, value)
        channel, process = changed if _is_pair(changed) else ("observation", changed)
        if isinstance(process, Process):
            return _with_process(nominal, channel, process)
        if callable(getattr(changed, "reset", None)):
            if isinstance(env, Disturbed) and not isinstance(changed, Disturbed):
                own = nominal.params.replace(env=parameters_of(changed))
                changed = Disturbed(changed, env.reward_from, own)
            params = parameters_of(changed)
            interface = describe(changed, params)
            _check_sizes(interface, nominal.interface)
            return dataclasses.replace(nominal, env=changed, params=params, interface=interface)
        if type(changed) is not type(plant):
            raise UserError(
                f"change returned {type(changed).__name__}; it must return the plant's parameters "
                f"({type(plant).__name__}), a process, or an environment"
            )
        params = nominal.params.replace(env=changed) if is_wrapped else changed
        for part in jax.tree.leaves(changed, is_leaf=lambda part: isinstance(part, Process)):
            if isinstance(part, Process):
                part.validate()
        # The checks of the environment's own parameters; the interface only differs in bounds.
        interface = describe(env, parameters_of(env, params))
        return dataclasses.replace(nominal, params=params, interface=interface)
    except UserError as error:
        raise UserError(f"stress {stress.name}={value:g}: {error}") from error
    except Exception as error:  # a user's function may raise any error
        raise UserError(f"stress {stress.name}={value:g} failed: {short_reason(error)}") from error


def _is_pair(changed: object) -> bool:
    return type(changed) is tuple and len(changed) == 2 and isinstance(changed[1], Process)


def _with_process(nominal: Case, channel: str, process: Process) -> Case:
    """The case with a process between the environment and the policy."""
    if channel not in _CHANNELS:
        raise UserError(
            f"channel {channel!r} must be one of {', '.join(_CHANNELS)}"
            f"{nearest(channel, _CHANNELS)}"
        )
    process.validate()
    size = nominal.interface.sizes[_CHANNELS.index(channel)]
    if process.output_size(size) != size:
        raise UserError(
            f"{type(process).__name__} changes the number of elements, so no policy could be "
            "tested with and without it"
        )
    horizon = step_limit(nominal.params)
    if not isinstance(horizon, jax.core.Tracer):
        process.check_use(int(horizon), channel)
    if channel == "observation":
        return dataclasses.replace(nominal, observation=process)
    return dataclasses.replace(nominal, action=process)


def _check_sizes(interface: Interface, own: Interface) -> None:
    if (*interface.sizes, interface.action_shape) != (*own.sizes, own.action_shape):
        raise UserError(
            "the changed environment has other sizes of observation and action "
            f"{interface.sizes} than the environment itself {own.sizes}"
        )
