"""A differential-drive rover on loose soil: its slip is what the soil gives, not a process.

Actions, observations, rewards and bounds are the rover's (`rtd3jax.envs.rover`), so that policies
of the one act in the other. Between them lie two driven wheels with inertia and motors of limited
torque, the soil's forces on them (`rtd3jax.envs.rover_soil.wheel`), the inertia of the body, and
gravity on slopes. SI units, rad; left wheel first.

Every number of the vehicle is a choice, but for the wheel and its load, which are those of a
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
"""m/s: below it slip is measured against this speed, and a wheel's rolling resistance fades."""


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
    """a `Ground`; without one it is dry sand, even and the same everywhere"""
    max_speed: float = 1.0
    """m/s, bound of the speed command, as the rover's"""
    max_yaw_rate: float = 1.0
    """rad/s, bound of the yaw-rate command, as the rover's"""
    step_seconds: float = 0.2
    """s"""
    mass: float = 16.31
    """kg, on both wheels alike"""
    yaw_inertia: float = 0.7
    """kg m^2: a plate of 0.5 m by 0.5 m"""
    gravity: float = 9.81
    """m/s^2: the soils were measured on Earth"""
    wheel_radius: float = 0.15735
    """m"""
    wheel_width: float = 0.165
    """m"""
    wheel_inertia: float = 0.05
    """kg m^2, of a wheel and its motor"""
    motor_gain: float = 40.0
    """N m s/rad, of the loop that holds a wheel's speed"""
    motor_torque: float = 10.0
    """N m, the largest"""


class RoverSoilState(struct.PyTreeNode):
    """One episode."""

    time: jax.Array
    """int32 []: steps taken"""
    speed: jax.Array
    """float32 [], m/s"""
    yaw_rate: jax.Array
    """float32 [], rad/s"""
    rim: jax.Array
    """float32 [2], speed of the wheels' rims, m/s"""
    entry: jax.Array
    """float32 [2], entry angles, rad: the sinkage"""
    slip: jax.Array
    """float32 [2], slip at the end of the last step"""
    place: jax.Array
    """float32 [2], m, of the middle between the wheels"""
    heading: jax.Array
    """float32 [], rad"""
    ground: GroundState
    """the episode's ground"""


class Motion(NamedTuple):
    """What is integrated within a step.

    Attributes:
        hub: speed of the two hubs over ground, m/s, [2].
        rim: speed of the rims, m/s, [2].
        entry: entry angles, rad, [2].
    """

    hub: jax.Array
    rim: jax.Array
    entry: jax.Array


class RoverSoil(DrivingTask):
    """Hold a speed and a yaw rate: actions [2] command them, observations [2] are their errors."""

    def __init__(self, default_params: RoverSoilParams | None = None) -> None:
        super().__init__()
        if default_params is not None:
            check_ground(default_params)
        self._default_params = default_params

    @property
    def default_params(self) -> RoverSoilParams:
        """The parameters given at construction; without them, a rover on even dry sand."""
        return RoverSoilParams() if self._default_params is None else self._default_params

    def reset_env(
        self, key: jax.Array, params: RoverSoilParams
    ) -> tuple[jax.Array, RoverSoilState]:
        """Start at rest, sunk in as the load does it without shear on the ground's first soil."""
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
"""Dry sand, the same everywhere."""


def ground_of(params: RoverSoilParams) -> Ground:
    """The ground of ``params``; even dry sand where there is none."""
    return params.ground if isinstance(params.ground, Ground) else EVEN


def check_ground(params: RoverSoilParams) -> None:
    """Raise UserError for another object, or a ground in which a wheel sinks below its axle."""
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
    """Entry angle at full slip."""
    met = local_soil(soil, wheel.width)
    return entry_angle(met, wheel, float32(load), jnp.float32(1.0))


def wheel_of(params: RoverSoilParams) -> Wheel:
    """One of its wheels."""
    return Wheel(params.wheel_radius, params.wheel_width)


def wheel_load(params: RoverSoilParams, slope: jax.Array) -> jax.Array:
    """N [2], on each wheel, across the slope ``slope`` []."""
    return jnp.broadcast_to(0.5 * params.mass * params.gravity * jnp.cos(slope), (WHEELS,))


def wheel_places(params: RoverSoilParams, place: jax.Array, heading: jax.Array) -> jax.Array:
    """The positions of the wheels, [2, 2] m."""
    half = 0.5 * float32(params.wheelbase)
    across = half * jnp.stack([-jnp.sin(heading), jnp.cos(heading)])
    return jnp.stack([place + across, place - across])


def slip_of(motion: Motion) -> jax.Array:
    """[2]: (rim - hub) over the faster of the two: 0 rolling, 1 spinning on the spot, -1 locked.

    For a driven wheel it is the usual slip ratio. Below ``SLOWEST`` it fades to 0 at rest.
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
    """Drive for a step on ``soil`` [2] up ``slope`` [], with rim speeds ``command`` [2] m/s.

    ``SUBSTEPS`` linearly implicit Euler steps: the soil's forces change with the slip, and the
    slip within hundredths of a second, so that explicit ones would have to be far shorter. The
    sinkage, which has no inertia of its own, takes one step of its iteration in each.
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
        # That of the pull, were the contact flat: it settles the steps, and not where they lead.
        pull_rate = torque_rate / radius
        # The rims: (inertia + answer + torque_rate) change = motor - torque + torque_rate * hubs'
        # change; put into the hubs' equations, which couple the sides by the yaw inertia. The motor
        # is at its limit where it would be beyond it at the end: one that asks at the beginning
        # switches to and fro.
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

    # The forces are carried to the next round, and the first round only computes them: within one
    # the compiler would compute the stresses again for each of their uses, at many times the cost.
    nothing = Forces(*(jnp.ones_like(motion.entry),) * len(Forces._fields))
    rounds = jnp.arange(SUBSTEPS + 1) == 0
    (motion, _), _ = jax.lax.scan(onwards, (motion, nothing), rounds)
    return motion


def rolling_of(motion: Motion) -> jax.Array:
    """[2]: 1 for a wheel that rolls forwards, -1 backwards; it passes through 0 at rest."""
    return jnp.clip(motion.rim / SLOWEST, -1.0, 1.0)


def _width(params: RoverSoilParams) -> jax.Array:
    return float32(params.wheel_width)
