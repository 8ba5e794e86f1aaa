"""What is drawn anew for every maneuver besides its scenario: spacecraft, rate limit, urgency, delay."""

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.actuators.wheels import WheelConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.task import actuators, rotations
from koz_jax.task.actuators import Actuators, ReactionWheels, TorqueBox
from koz_jax.task.any_spacecraft import units
from koz_jax.task.any_spacecraft.units import Units
from koz_jax.task.scenario import ScenarioRanges
from koz_jax.task.state import Model

# Smallest second moment of a body of unit largest one: no body is thinner.
_THINNEST = 0.05

# Separates the keys of what is drawn here from all others of a maneuver.
PURPOSE = 0x535052

# Separates the key of the delay from those of the other draws.
_DELAY = 0x44454C

# Separates the key of whether a maneuver is nominal from those of the other draws.
_NOMINAL = 0x4E4F4D

# Separates the key of the other instruments from those of the other draws.
_OTHERS = 0x4F5448

# Share of the maneuvers at either end of the urgencies, beyond which an agent learns nothing.
_AT_AN_END = 1.0 / 7.0

# Axes of the wheels that are drawn, in body axes; those of the pyramid are at 54.7 deg from z.
_SIDE = 3.0**-0.5
_WHEEL_AXES = {
    "three": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "pyramid": ((_SIDE, _SIDE, _SIDE), (-_SIDE, _SIDE, _SIDE), (-_SIDE, -_SIDE, _SIDE), (_SIDE, -_SIDE, _SIDE)),
}

# Of what a wheel holds, the most that it holds at the start.
_BIAS = 0.3

# Torque limits of the axes differ by at most this factor.
_UNEQUAL = 2.0


class Spread(struct.PyTreeNode):
    """How far maneuvers differ; traced but for whether spacecraft do."""

    step_shares: jax.Array  # (2,) [T] shortest and longest time step
    max_rates: jax.Array  # (2,) [rad/s]
    urgencies: jax.Array  # (2,)
    delays: jax.Array  # (2,) int32
    slenderness: jax.Array  # (2,) smallest over largest second moment
    wheel_momentum: jax.Array  # (2,) [u T]
    keep_in: jax.Array  # () share of the other instruments' zones that are cones to keep them in
    nominal: jax.Array  # () share of the maneuvers without errors, with fewest zones and the largest rate limit
    instruments: int = struct.field(pytree_node=False)
    spacecraft: bool = struct.field(pytree_node=False)
    rate_limits: bool = struct.field(pytree_node=False)
    late: bool = struct.field(pytree_node=False)
    slender: bool = struct.field(pytree_node=False)
    wheels: Literal["three", "pyramid"] | None = struct.field(pytree_node=False)


class Drawn(struct.PyTreeNode):
    """What is drawn for one maneuver."""

    model: Model
    ranges: ScenarioRanges  # for its instruments
    urgency: jax.Array  # ()
    delay: jax.Array | None  # () int32; None where it is not spread
    nominal: jax.Array  # () bool, to be flown without errors


def draw(spread: Spread, model: Model, ranges: ScenarioRanges, key: jax.Array) -> Drawn:
    """Draw for one maneuver; what is not spread is as given.  key: () typed PRNG key."""
    key_body, key_boresight, key_rate, key_urgency = jax.random.split(key, 4)
    nominal = jax.random.bernoulli(jax.random.fold_in(key, _NOMINAL), spread.nominal)
    fewest, most = ranges.zone_counts
    ranges = ranges.replace(zone_counts=jnp.stack([fewest, jnp.where(nominal, fewest, most)]))
    delay = None
    if spread.late:
        shortest, longest = spread.delays
        delay = jax.random.randint(jax.random.fold_in(key, _DELAY), (), shortest, longest + 1)
    if spread.spacecraft:
        model = _sample_body(spread, model, key_body)
        boresight_B = rotations.normalize(jax.random.normal(key_boresight, (3,)))
        ranges = ranges.replace(boresight_B=boresight_B, others_B=_others(spread, key), keep_in=spread.keep_in)
    if spread.rate_limits:
        low, high = jnp.log(spread.max_rates)
        limit = jax.random.uniform(key_rate, (), minval=low, maxval=high)
        model = model.replace(max_rate=jnp.exp(jnp.where(nominal, high, limit)))
    return Drawn(model, ranges, _urgency(spread, key_urgency), delay, nominal)


def _others(spread: Spread, key: jax.Array) -> jax.Array | None:
    """Boresights of the instruments after the first.  Returns (n, 3); None where there are none."""
    if spread.instruments == 1:
        return None
    drawn = jax.random.normal(jax.random.fold_in(key, _OTHERS), (spread.instruments - 1, 3))
    return jax.vmap(rotations.normalize)(drawn)


def _urgency(spread: Spread, key: jax.Array) -> jax.Array:
    """Evenly distributed, but for the shares at both ends.  Returns ()."""
    low, high = spread.urgencies
    share = (jax.random.uniform(key) - _AT_AN_END) / (1.0 - 2.0 * _AT_AN_END)
    return low + (high - low) * jnp.clip(share, 0.0, 1.0)


def _sample_body(spread: Spread, model: Model, key: jax.Array) -> Model:
    """Draw a body: its second moments, how it is turned, its torque limits and its time step.

    Second moments of mass along three axes make every inertia that a body can have: each principal moment is the sum
    of the other two's.
    """
    key_shape, key_turn, key_torque, key_step = jax.random.split(key, 4)
    own = units.of(model)
    second = _second_moments(spread, key_shape)
    moments = 1.5 * own.inertia * (1.0 - second / jnp.sum(second))
    turn = rotations.normalize(jax.random.normal(key_turn, (4,)))
    axes = jax.vmap(rotations.rotate, in_axes=(None, 0))(turn, jnp.eye(3))
    low, high = spread.step_shares
    share = jax.random.uniform(key_step, (), minval=low, maxval=high)
    return model.replace(
        inertia_B=axes.T @ (moments[:, None] * axes),
        actuators=_sample_actuators(spread, own, key_torque),
        dt=share * own.time,
    )


def _sample_actuators(spread: Spread, own: Units, key: jax.Array) -> Actuators:
    """Draw actuators of the strength of a spacecraft's own."""
    if spread.wheels is None:
        limits = _UNEQUAL ** jax.random.uniform(key, (3,), minval=-0.5, maxval=0.5)
        return TorqueBox(own.torque * limits / jnp.sqrt(jnp.mean(limits**2)))
    key_size, key_bias = jax.random.split(key)
    of_one = tuple(WheelConfig(axis=axis, max_torque=1.0, max_momentum=1.0) for axis in _WHEEL_AXES[spread.wheels])
    made = actuators.from_config(SpacecraftConfig(wheels=of_one))
    assert isinstance(made, ReactionWheels)
    strength = own.torque / jnp.sqrt(jnp.mean(made.box_B**2))
    low, high = spread.wheel_momentum
    largest = jax.random.uniform(key_size, (), minval=low, maxval=high) * own.torque * own.time
    bias = _BIAS * jax.random.uniform(key_bias, (len(of_one),), minval=-1.0, maxval=1.0)
    return made.replace(
        max_torque=strength * made.max_torque,
        max_momentum=largest * made.max_momentum,
        momentum=largest * bias,
        box_B=strength * made.box_B,
    )


def _second_moments(spread: Spread, key: jax.Array) -> jax.Array:
    """Second moments of mass along the principal axes, the largest possible 1.  Returns (3,)."""
    if not spread.slender:
        return jax.random.uniform(key, (3,), minval=_THINNEST, maxval=1.0)
    key_smallest, key_middle = jax.random.split(key)
    low, high = spread.slenderness
    smallest = jax.random.uniform(key_smallest, (), minval=low, maxval=high)
    middle = jax.random.uniform(key_middle, (), minval=smallest, maxval=1.0)
    return jnp.stack([smallest, middle, jnp.ones(())])


def from_config(task: TaskConfig) -> Spread | None:
    """What a task spreads, traced; None where it spreads nothing."""
    config: SpreadConfig = task.spread
    if config.is_none:
        return None
    return Spread(
        step_shares=jnp.array(config.step_shares),
        max_rates=jnp.deg2rad(jnp.array(config.max_rate_deg or (1.0, 1.0))),
        urgencies=jnp.array(config.urgency or (0.5, 0.5)),
        delays=jnp.array(config.delay_steps or (0, 0)),
        spacecraft=config.spacecraft,
        rate_limits=config.max_rate_deg is not None,
        late=config.delay_steps is not None,
        slenderness=jnp.array(config.slenderness or (1.0, 1.0)),
        slender=config.slenderness is not None,
        wheel_momentum=jnp.array(config.wheel_momentum),
        keep_in=jnp.float32(config.keep_in),
        nominal=jnp.float32(config.nominal),
        instruments=config.instruments,
        wheels=config.wheels,
    )
