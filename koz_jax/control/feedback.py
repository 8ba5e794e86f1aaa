"""What the classical controllers share: the error as a rotation vector, the rate that can still be braked, the torque.

The maneuver ends where the attitude error is the quaternion +1, so no sign is ever flipped: an error of more than
half a turn is undone the way it came.  Gains are in units of T, see ``any_spacecraft.units``, so that those that
suit one spacecraft suit all of its shape.
"""

import jax
import jax.numpy as jnp

from koz_jax.task import dynamics, rotations
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.any_spacecraft import units
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.state import EnvState, Model, attitude_error

# A gain: a plain number by default, traced where gains are tuned.
Gain = jax.Array | float

# Share of an error that a held torque takes back within its time step, at most.  A loop with the bandwidths b and r is
# stable under a torque that is held over dt while (b + r) dt < 2; with this share each, that is 1.2, which leaves room
# for a wrong inertia.  On the paper's task (dt = 0.018 T) the largest is 0.586: nothing is capped there.
_SHARE_PER_STEP = 0.6


def rotation_vector(q: jax.Array) -> jax.Array:
    """Axis times angle in [0, 2 pi].  q: (4,) unit.  Returns (3,) [rad]; differentiable also at the identity."""
    size = rotations.norm(q[1:])
    turned = size > 0.0
    return q[1:] * jnp.where(turned, rotations.rotation_angle(q) / jnp.where(turned, size, 1.0), 2.0)


def from_rotation_vector(vector: jax.Array) -> jax.Array:
    """Unit quaternion of a rotation vector.  vector: (3,) [rad].  Returns (4,); differentiable also at zero."""
    half = 0.5 * rotations.norm(vector)
    scale = jnp.where(half > 0.0, jnp.sin(half) / jnp.where(half > 0.0, half, 1.0), 1.0)
    return jnp.concatenate([jnp.cos(half)[None], 0.5 * scale * vector])


def error_vector(state: EnvState) -> jax.Array:
    """Rotation vector (3,) [rad] from the target to the body, in the axes of both."""
    return rotation_vector(attitude_error(state))


def bandwidth(gain: Gain, model: Model) -> jax.Array:
    """Rate () [1/s] of a gain () [1/T], as far as a torque that is held over a time step can follow."""
    return jnp.minimum(gain / units.of(model).time, _SHARE_PER_STEP / model.dt)


def brake_rate(distance: jax.Array, deceleration: jax.Array, bandwidth: jax.Array) -> jax.Array:
    """Rate from which one comes to rest in a distance: linear near the end, a square root farther out.

    distance: () [rad]; deceleration: () [rad/s^2]; bandwidth: () [1/s] of the linear part.  Returns () [rad/s].
    """
    # The two parts meet with the same slope.
    linear_until = deceleration / bandwidth**2
    root = jnp.sqrt(2.0 * deceleration * jnp.maximum(distance - 0.5 * linear_until, 0.5 * linear_until))
    return jnp.where(distance <= linear_until, bandwidth * distance, root)


def deceleration_about(
    axis_B: jax.Array, rate: jax.Array, inertia_B: jax.Array, limits: TorqueLimits, share: Gain
) -> jax.Array:
    """Largest deceleration about a body axis that the torque box allows at a rate.

    axis_B: (3,) unit or zero; rate: () [rad/s]; inertia_B: (3, 3) [kg m^2]; share: () of the torque limits that is
    used.  Returns () [rad/s^2].
    """
    gyroscopic_B = dynamics.gyroscopic_torque(rate * axis_B, inertia_B)
    per_acceleration = -dynamics.matvec(inertia_B, axis_B)
    room = share * limits.box_B - jnp.sign(per_acceleration) * gyroscopic_B
    size = rotations.norm(inertia_B.reshape(-1))
    least = 0.1 * share * limits.scale / size
    return jnp.maximum(jnp.min(room / jnp.maximum(jnp.abs(per_acceleration), 1e-8 * size)), least)


def action(acceleration_B: jax.Array, body: RigidBodyState, inertia_B: jax.Array, limits: TorqueLimits) -> jax.Array:
    """Action (3,) for an angular acceleration (3,) [rad/s^2], which is scaled down where the box is too small for it.

    The acceleration keeps its direction, so that a turn about an axis stays one.
    """
    gyroscopic_B = dynamics.gyroscopic_torque(body.omega_BN_B, inertia_B)
    wanted_B = dynamics.matvec(inertia_B, acceleration_B)
    room = limits.box_B - jnp.sign(wanted_B) * gyroscopic_B
    share = jnp.min(room / jnp.maximum(jnp.abs(wanted_B), 1e-9 * limits.scale))
    torque_B = gyroscopic_B + jnp.clip(share, 0.0, 1.0) * wanted_B
    return jnp.clip(torque_B / limits.box_B, -1.0, 1.0)
