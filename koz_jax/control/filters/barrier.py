"""The barrier of one cone, and what it asks of a torque that is held over a step.

With b the boresight and n the axis of a cone of half angle f, kappa = n . b - cos(f) is positive inside the cone, and

    h = kappa + kappa' |kappa'| / (2 mu)

is what kappa comes to when its growth is braked with mu.  Over a step of length T with a held torque u, the second
derivative of kappa begins at phi(u), is off by M2 at most, and grows by M3 per second at most.  So kappa and kappa'
at the end are bounded by sums that grow with phi, and h there is at most -delta while phi is below a limit: one
half-space of torques (Breeden & Panagou, "Autonomous spacecraft attitude reorientation using robust sampled-data
control barrier functions", JGCD 46(10), 2023).
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import dynamics, rotations


class Look(struct.PyTreeNode):
    """One instrument and one cone, seen from the body; and how the body turns."""

    boresight_B: jax.Array  # (3,) unit vector
    axis_B: jax.Array  # (3,) unit vector
    axis_rate_B: jax.Array  # (3,) [rad/s] angular velocity of the axis relative to inertial axes
    omega_BN_B: jax.Array  # (3,) [rad/s]


class Motion(struct.PyTreeNode):
    """How kappa of one cone goes on: its second derivative is free + row . u with a torque u."""

    kappa: jax.Array  # () cosine of the angle to the axis, less that of the half angle
    rate: jax.Array  # () [1/s] its derivative
    free: jax.Array  # () [1/s^2] its second derivative without a torque
    row: jax.Array  # (3,) [1/(s^2 N m)]


class Bounds(struct.PyTreeNode):
    """Numbers that hold for a cone in all states that are allowed."""

    deceleration: jax.Array  # () [1/s^2] mu
    disturbed: jax.Array  # () [1/s^2] M2: the second derivative is off by this much at most, either way
    third: jax.Array  # () [1/s^3] M3: largest size of the third derivative with a held torque

    def delta(self, dt: jax.Array) -> jax.Array:
        """What kappa may rise between two samples above the larger of them.  dt: () [s].  Returns ()."""
        half = 0.5 * dt
        return (self.deceleration + 2.0 * self.disturbed) * half**2 / 2.0 + self.third * half**3 / 6.0


def second_derivative(look: Look, torque_B: jax.Array, inertia_B: jax.Array, inverse_B: jax.Array) -> jax.Array:
    """phi, the second derivative of kappa with a torque (3,) [N m].  Returns () [1/s^2]."""
    relative_B = look.omega_BN_B - look.axis_rate_B
    turned_B = dynamics.angular_acceleration(look.omega_BN_B, torque_B, inertia_B, inverse_B)
    turned_B = turned_B - rotations.cross(look.axis_rate_B, look.omega_BN_B)
    drift_B = rotations.cross(look.axis_B, relative_B)
    return rotations.dot(turned_B, rotations.cross(look.boresight_B, look.axis_B)) + rotations.dot(
        relative_B, rotations.cross(look.boresight_B, drift_B)
    )


def third_derivative(look: Look, torque_B: jax.Array, inertia_B: jax.Array, inverse_B: jax.Array) -> jax.Array:
    """Derivative of phi in time while the torque (3,) [N m] is held.  Returns () [1/s^3]."""
    omega_B = look.omega_BN_B
    change = Look(
        boresight_B=jnp.zeros(3),
        axis_B=rotations.cross(look.axis_B, omega_B - look.axis_rate_B),
        axis_rate_B=rotations.cross(look.axis_rate_B, omega_B),
        omega_BN_B=dynamics.angular_acceleration(omega_B, torque_B, inertia_B, inverse_B),
    )
    return jax.jvp(lambda at: second_derivative(at, torque_B, inertia_B, inverse_B), (look,), (change,))[1]


def motion(look: Look, half_angle: jax.Array, inertia_B: jax.Array, inverse_B: jax.Array) -> Motion:
    """How kappa of a cone of a half angle () [rad] goes on."""
    turn_B = rotations.cross(look.boresight_B, look.axis_B)
    return Motion(
        kappa=rotations.dot(look.boresight_B, look.axis_B) - jnp.cos(half_angle),
        rate=rotations.dot(look.omega_BN_B - look.axis_rate_B, turn_B),
        free=second_derivative(look, jnp.zeros(3), inertia_B, inverse_B),
        row=dynamics.matvec(inverse_B, turn_B),
    )


def value(at: Motion, bounds: Bounds) -> jax.Array:
    """h.  Returns ()."""
    return at.kappa + at.rate * jnp.abs(at.rate) / (2.0 * bounds.deceleration)


def largest_second_derivative(at: Motion, bounds: Bounds, dt: jax.Array) -> jax.Array:
    """Largest phi with which kappa and h are at most -delta after a step of dt () [s].  Returns () [1/s^2].

    Both rise with phi, and phi with the rate after the step, in which the condition on h is a quadratic equation.
    """
    mu, delta = bounds.deceleration, bounds.delta(dt)
    rate = at.rate + bounds.disturbed * dt + bounds.third * dt**2 / 2.0
    kappa = at.kappa + at.rate * dt + bounds.disturbed * dt**2 / 2.0 + bounds.third * dt**3 / 6.0
    outside = (-delta - kappa) * 2.0 / dt**2
    excess = kappa - 0.5 * rate * dt + delta
    size = 4.0 * mu * jnp.abs(excess) / (mu * dt + jnp.sqrt((mu * dt) ** 2 + 8.0 * mu * jnp.abs(excess)))
    return jnp.minimum(outside, (-jnp.sign(excess) * size - rate) / dt)
