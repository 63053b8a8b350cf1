"""A differential-drive rover on loose soil: the forces of the soil determine its slip.

Actions, observations, rewards and bounds are those of `rtd3jax.envs.rover`, so a policy of one
rover can act in the other. The dynamics contain two driven wheels with inertia, motors of limited
torque, the soil's forces on the wheels (`rtd3jax.envs.rover_soil.wheel`), the inertia of the body,
and gravity on slopes. SI units, rad. The left wheel comes first.

All numbers of the vehicle are choices, except the wheel and its load, which are those of a
single-wheel test bed: radius 157.35 mm, width 165 mm, 80 N (Ding, Gao, Deng, Nagatani and Yoshida,
"Experimental study and analysis on driving wheels' performance for planetary exploration rovers
moving in deformable soil", J. Terramechanics 48(1), 2011).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.typing import ArrayLike

from rtd3jax.envs.identity import strong
from rtd3jax.envs.processes.process import NoDisturbance, Process, float32
from rtd3jax.envs.rover.slip import WHEELS
from rtd3jax.envs.rover.task import DrivingTask, errors, limits, sides
from rtd3jax.envs.rover_soil.field import Ground, GroundState
from rtd3jax.envs.rover_soil.soil import LocalSoil, Soil, local_soil
from rtd3jax.envs.rover_soil.wheel import (
    LARGEST_ENTRY,
    Forces,
    Wheel,
    contact_forces,
    deeper,
    entry_angle,
    static_entry_angle,
)
from rtd3jax.errors import UserError

SUBSTEPS = 4
"""Steps of the implicit integration within a step of the environment."""
SLOWEST = 0.05
"""m/s. At lower speeds, the slip is relative to this speed, and rolling resistance decreases."""


class RoverSoilParams(struct.PyTreeNode):
    """The rover, its task and its ground."""

    max_steps_in_episode: int = 200
    wheelbase: float = 0.5
    """m, between the wheels"""
    target_speed: float = 0.5
    """m/s"""
    target_yaw_rate: float = 0.0
    """rad/s"""
    ground: Process = NoDisturbance()
    """a `Ground`; `NoDisturbance` means level dry sand with the same properties everywhere"""
    max_speed: float = 1.0
    """m/s, bound of the speed command, as for `rtd3jax.envs.rover`"""
    max_yaw_rate: float = 1.0
    """rad/s, bound of the yaw-rate command, as for `rtd3jax.envs.rover`"""
    step_seconds: float = 0.2
    """s, length of a step"""
    mass: float = 16.31
    """kg; each wheel carries half of it"""
    yaw_inertia: float = 0.7
    """kg m^2, nearly that of a plate of 0.5 m by 0.5 m"""
    gravity: float = 9.81
    """m/s^2, on Earth, where the soils were measured"""
    wheel_radius: float = 0.15735
    """m"""
    wheel_width: float = 0.165
    """m"""
    wheel_inertia: float = 0.05
    """kg m^2, of one wheel and its motor"""
    motor_gain: float = 40.0
    """N m s/rad, gain of the controller of a wheel's speed"""
    motor_torque: float = 10.0
    """N m, largest torque of a motor"""


class RoverSoilState(struct.PyTreeNode):
    """The state of one episode."""

    time: jax.Array
    """int32 []: steps taken"""
    speed: jax.Array
    """float32 [], m/s"""
    yaw_rate: jax.Array
    """float32 [], rad/s"""
    rim: jax.Array
    """float32 [2], speed of the wheels' rims, m/s"""
    entry: jax.Array
    """float32 [2], entry angles of the wheels, rad; they determine the sinkage"""
    slip: jax.Array
    """float32 [2], slip at the end of the last step"""
    place: jax.Array
    """float32 [2], position of the middle between the wheels, m"""
    heading: jax.Array
    """float32 [], rad"""
    ground: GroundState
    """the ground of the episode"""


class Motion(NamedTuple):
    """The variables that `drive` integrates over a step.

    Attributes:
        hub: speed of the two hubs over ground, m/s, [2].
        rim: speed of the rims, m/s, [2].
        entry: entry angles, rad, [2].
    """

    hub: jax.Array
    rim: jax.Array
    entry: jax.Array


class RoverSoil(DrivingTask):
    """Task: hold a speed and a yaw rate. Actions [2] command them; observations [2] are errors.

    Raises:
        UserError: as `check_ground`.
    """

    def __init__(self, default_params: RoverSoilParams | None = None) -> None:
        super().__init__()
        if default_params is not None:
            check_ground(default_params)
        self._default_params = default_params

    @property
    def default_params(self) -> RoverSoilParams:
        """The parameters given at construction; without them, a rover on even dry sand."""
        return RoverSoilParams() if self._default_params is None else self._default_params

    def check_params(self, params: RoverSoilParams) -> None:
        """Raise UserError as `check_ground` does, for parameters given later."""
        check_ground(params)

    def reset_env(
        self, key: jax.Array, params: RoverSoilParams
    ) -> tuple[jax.Array, RoverSoilState]:
        """Start at rest, with the sinkage under the load without shear, on the soil ``soil``."""
        ground, zero = ground_of(params), jnp.zeros((), jnp.float32)
        soil = local_soil(ground.soil, _width(params))
        state = RoverSoilState(
            time=jnp.zeros((), jnp.int32),
            speed=zero,
            yaw_rate=zero,
            rim=jnp.zeros((WHEELS,), jnp.float32),
            entry=static_entry_angle(soil, wheel_of(params), wheel_load(params, zero)),
            slip=jnp.zeros((WHEELS,), jnp.float32),
            place=jnp.zeros((2,), jnp.float32),
            heading=zero,
            ground=ground.init(key, params.max_steps_in_episode, WHEELS),
        )
        return errors(state, params), strong(state)

    def step_env(
        self, key: jax.Array, state: RoverSoilState, action: ArrayLike, params: RoverSoilParams
    ) -> tuple[jax.Array, RoverSoilState, jax.Array, jax.Array, dict[Any, Any]]:
        """Command ``action`` [2]; the reward [] is that of the motion at the end of the step."""
        limit = limits(params)
        command = jnp.clip(jnp.asarray(action, jnp.float32), -limit, limit)
        wheelbase = float32(params.wheelbase)
        places = wheel_places(params, state.place, state.heading)
        soil, slope = ground_of(params).at(state.ground, places, state.heading, _width(params))
        motion = Motion(sides(state.speed, state.yaw_rate, wheelbase), state.rim, state.entry)
        motion = drive(params, soil, slope, motion, sides(command[0], command[1], wheelbase))
        speed = 0.5 * (motion.hub[0] + motion.hub[1])
        yaw_rate = (motion.hub[1] - motion.hub[0]) / wheelbase
        seconds = float32(params.step_seconds)
        middle = state.heading + 0.25 * seconds * (state.yaw_rate + yaw_rate)
        path = 0.5 * seconds * (state.speed + speed)
        evolved = RoverSoilState(
            time=state.time + 1,
            speed=speed,
            yaw_rate=yaw_rate,
            rim=motion.rim,
            entry=motion.entry,
            slip=slip_of(motion),
            place=state.place + path * jnp.stack([jnp.cos(middle), jnp.sin(middle)]),
            heading=state.heading + 0.5 * seconds * (state.yaw_rate + yaw_rate),
            ground=state.ground,
        )
        return self.outcome(evolved, params)

    @property
    def name(self) -> str:
        """The name used in messages."""
        return "rover-soil"


EVEN = Ground(variation=0.0)
"""Level dry sand with the same properties everywhere."""


def ground_of(params: RoverSoilParams) -> Ground:
    """The ground of ``params``, or `EVEN` if there is none."""
    return params.ground if isinstance(params.ground, Ground) else EVEN


def check_ground(params: RoverSoilParams) -> None:
    """Raise UserError if a rover cannot drive on its ground.

    This is so if ``ground`` is not a `Ground`, if the wheels carry no load, or if a wheel sinks
    below its axle at full slip. Traced numbers are not checked.
    """
    if not isinstance(params.ground, Ground | NoDisturbance):
        kind = type(params.ground).__name__
        raise UserError(
            f"rover-soil: its ground is one Ground, not a {kind}; name one ground, and join it "
            "with disturbances of the observation, the action or the reward"
        )
    ground = ground_of(params)
    numbers = jax.tree.leaves((ground, wheel_of(params), params.mass, params.gravity))
    if any(isinstance(number, jax.core.Tracer) for number in numbers):
        return
    load = 0.5 * params.mass * params.gravity
    if not (np.isfinite(load) and load > 0):
        raise UserError(f"rover-soil: the load of a wheel must be greater than 0 N, not {load:g}")
    wheel = wheel_of(params)
    wheel.validate()
    for soil in (ground.soil, ground.other):
        if float(_deepest(soil, wheel, load)) >= LARGEST_ENTRY:
            raise UserError(
                f"rover-soil: under {load:g} N a wheel of {wheel.radius:g} m sinks deeper than its "
                "radius at full slip; give a stiffer soil, a larger wheel or a smaller mass"
            )


@jax.jit
def _deepest(soil: Soil, wheel: Wheel, load: ArrayLike) -> jax.Array:
    """The entry angle [] at full slip, rad."""
    met = local_soil(soil, wheel.width)
    return entry_angle(met, wheel, float32(load), jnp.float32(1.0))


def wheel_of(params: RoverSoilParams) -> Wheel:
    """A wheel of the rover; both wheels are equal."""
    return Wheel(params.wheel_radius, params.wheel_width)


def wheel_load(params: RoverSoilParams, slope: jax.Array) -> jax.Array:
    """The load of each wheel normal to the ground, N [2], at ``slope`` [] rad."""
    return jnp.broadcast_to(0.5 * params.mass * params.gravity * jnp.cos(slope), (WHEELS,))


def wheel_places(params: RoverSoilParams, place: jax.Array, heading: jax.Array) -> jax.Array:
    """The positions of the wheels, [2, 2] in m; a row for each wheel."""
    half = 0.5 * float32(params.wheelbase)
    across = half * jnp.stack([-jnp.sin(heading), jnp.cos(heading)])
    return jnp.stack([place + across, place - across])


def slip_of(motion: Motion) -> jax.Array:
    """The slip [2]: (rim - hub) divided by the larger absolute value of the two speeds.

    In forward motion, 0 means rolling without slip, 1 spinning on the spot, and -1 a locked wheel.
    For a driven wheel, this is the usual slip ratio. Below ``SLOWEST``, it decreases to 0 at rest.
    """
    fastest = jnp.maximum(jnp.abs(motion.rim), jnp.abs(motion.hub))
    slip = (motion.rim - motion.hub) / jnp.maximum(fastest, SLOWEST)
    return jnp.clip(slip, -1.0, 1.0)


def drive(
    params: RoverSoilParams,
    soil: LocalSoil,
    slope: jax.Array,
    motion: Motion,
    command: jax.Array,
) -> Motion:
    """Integrate the motion over one step.

    There are ``SUBSTEPS`` linearly implicit Euler steps. The forces of the soil depend on the slip,
    which changes within hundredths of a second, so explicit steps would have to be much shorter.
    The sinkage has no inertia; each substep computes one iteration of `deeper`.

    Args:
        params: the rover.
        soil: the soil under the wheels, fields [2].
        slope: [], the slope ahead, rad.
        motion: the motion at the start of the step.
        command: [2], commanded rim speeds, m/s.
    """
    wheel, load = wheel_of(params), wheel_load(params, slope)
    seconds = params.step_seconds / SUBSTEPS
    radius, mass, dtype = params.wheel_radius, params.mass, motion.rim.dtype
    lever = params.wheelbase**2 / (4.0 * params.yaw_inertia)
    own, cross = jnp.asarray(1.0 / mass + lever, dtype), jnp.asarray(1.0 / mass - lever, dtype)
    downhill = params.gravity * jnp.sin(slope)
    inertia = jnp.asarray(params.wheel_inertia / (radius * seconds), dtype)
    gain = jnp.asarray(params.motor_gain / radius, dtype)
    most = jnp.asarray(params.motor_torque, dtype)

    def forces_at(motion: Motion) -> Forces:
        return contact_forces(soil, wheel, motion.entry, slip_of(motion), rolling_of(motion))

    def substep(motion: Motion, forces: Forces) -> Motion:
        entry = deeper(soil, motion.entry, forces.vertical, load)
        fastest = jnp.maximum(jnp.abs(motion.rim), jnp.abs(motion.hub))
        by_speed = 1.0 / jnp.maximum(fastest, SLOWEST)
        torque_rate = by_speed * forces.torque_slope
        # The derivative of the pull by the speed, for a flat contact. It affects the stability of
        # the steps, but not the motion to which they converge.
        pull_rate = torque_rate / radius
        # The equation of the rims is (inertia + gain + torque_rate) * rim_change =
        # motor - torque + torque_rate * hub_change, without gain for a motor at its limit. It is
        # substituted into the equations of the hubs, which the yaw inertia couples. A motor is at
        # its limit if its torque at the end of the substep would exceed it: a decision by the
        # torque at the beginning would switch back and forth.
        wanted = gain * (command - motion.rim)
        within = inertia + gain + torque_rate
        late = wanted - gain * (wanted - forces.torque) / within
        limited = jnp.abs(late) > most
        motor = jnp.where(limited, jnp.sign(late) * most, wanted)
        stiff = jnp.where(limited, inertia + torque_rate, within)
        free = (motor - forces.torque) / stiff
        driven = forces.pull + pull_rate * free
        damping = pull_rate * (1.0 - torque_rate / stiff)
        right = seconds * (own * driven + cross * driven[::-1] - downhill)
        diagonal, beside = 1.0 + seconds * own * damping, seconds * cross * damping
        determinant = diagonal[0] * diagonal[1] - beside[0] * beside[1]
        hub_change = (diagonal[::-1] * right - beside[::-1] * right[::-1]) / determinant
        rim_change = free + torque_rate / stiff * hub_change
        return Motion(motion.hub + hub_change, motion.rim + rim_change, entry)

    def onwards(
        carry: tuple[Motion, Forces], first: jax.Array
    ) -> tuple[tuple[Motion, Forces], None]:
        motion, forces = carry
        moved = substep(motion, forces)
        motion = jax.tree.map(lambda old, new: jnp.where(first, old, new), motion, moved)
        return (motion, forces_at(motion)), None

    # The forces are carried to the next round, and the first round only computes them. If a round
    # used the forces that it computes, XLA would compute the stresses again for each use of them,
    # which takes many times as long.
    nothing = Forces(*(jnp.ones_like(motion.entry),) * len(Forces._fields))
    rounds = jnp.arange(SUBSTEPS + 1) == 0
    (motion, _), _ = jax.lax.scan(onwards, (motion, nothing), rounds)
    return motion


def rolling_of(motion: Motion) -> jax.Array:
    """The direction of rolling [2]: 1 forwards, -1 backwards; it passes through 0 at rest."""
    return jnp.clip(motion.rim / SLOWEST, -1.0, 1.0)


def _width(params: RoverSoilParams) -> jax.Array:
    return float32(params.wheel_width)
