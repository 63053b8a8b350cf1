"""Finds the simulators on the host behind an environment."""

import jax
import numpy as np
from jax.experimental import io_callback

from rtd3jax.envs.compat.simulated_environment import FromGymnasium
from rtd3jax.envs.compat.simulator import Fleet
from rtd3jax.envs.compat.simulator_state import SimulatorState


def innermost(env: object) -> object:
    """The environment below all disturbances."""
    while hasattr(env, "base"):
        env = env.base
    return env


def fleet_of(env: object) -> Fleet | None:
    """The simulators of the environment, disturbed or not; None if it has none."""
    base = innermost(env)
    return base.fleet if isinstance(base, FromGymnasium) else None


def is_simulated(env: object) -> bool:
    """Whether a simulator on the host plays the environment, disturbed or not."""
    return isinstance(innermost(env), FromGymnasium)


def simulated_identity(env: object) -> str:
    """A text that states how a simulated environment was made, as checkpoints store it."""
    base = innermost(env)
    assert isinstance(base, FromGymnasium)
    _, _, keep, limit, _ = base.identity()
    made, kwargs = base.words
    return f"{made} keep={keep} limit={limit} {kwargs}".strip()


def release(env: object, env_state: object) -> None:
    """Make the simulators of one state, or of several, free for other episodes.

    A compiled program may call this function.
    """
    states = jax.tree.leaves(env_state, is_leaf=lambda part: isinstance(part, SimulatorState))
    base = innermost(env)
    for state in states:
        if isinstance(state, SimulatorState) and isinstance(base, FromGymnasium):
            fleet = base.fleet

            def free(handles: jax.Array, fleet: Fleet = fleet) -> None:
                for handle in np.asarray(handles).reshape(-1):
                    fleet.release(int(handle))

            io_callback(free, None, state.handle)
