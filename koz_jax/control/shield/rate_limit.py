"""The shield's rate limit: no torque that could ever lead to a rate above it, coasting and braking included.

The squared largest rate of torque-free motion is a quadratic form of the rate, which that motion keeps constant (see
``dynamics.peak_rate_form``).  A brake against the momentum follows the path of torque-free motion with a rate
that falls, so it keeps a bound on that form too.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import dynamics, rotations
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.state import EnvState, Model, largest_rate, nominal_rate

# What rounding may add to a squared rate that stays as it is.
ROUNDING = 1e-5


class RateLimit(struct.PyTreeNode):
    """A limit of the rate for one spacecraft; traced."""

    form_B: jax.Array  # (3, 3) M
    error: jax.Array  # () [rad/s] by which the limit is tighter
    squared: jax.Array  # () [(rad/s)^2] what w . M w keeps to

    def squared_peak(self, body: RigidBodyState) -> jax.Array:
        """Square [(rad/s)^2] of the largest rate that the body has if it coasts or brakes from here.  Returns ()."""
        return rotations.dot(body.omega_BN_B, dynamics.matvec(self.form_B, body.omega_BN_B))

    def keeps(self, before: RigidBodyState, after: RigidBodyState) -> jax.Array:
        """Whether a step keeps the limit, or is no worse than what was where that is above it.  Returns () bool."""
        bound = jnp.maximum(self.squared, self.squared_peak(before))
        return self.squared_peak(after) <= (1.0 + ROUNDING) * bound

    def limit(self, body: RigidBodyState, torque_B: jax.Array, brake_B: jax.Array, model: Model) -> jax.Array:
        """Mix a torque with the brake's, as far as the limit needs it.  torque_B, brake_B: (3,) [N m].  Returns (3,).

        The rate after a step is nearly linear in the share of the torque, so the largest share is the root of a
        quadratic equation.
        """
        asked = dynamics.step(body, torque_B, model.inertia_B, model.dt)
        braked = dynamics.step(body, brake_B, model.inertia_B, model.dt)
        change_B = asked.omega_BN_B - braked.omega_BN_B
        slope_B = dynamics.matvec(self.form_B, change_B)
        least = self.squared_peak(braked)
        room = jnp.maximum(self.squared - least, 0.0)
        square, half = rotations.dot(change_B, slope_B), rotations.dot(braked.omega_BN_B, slope_B)
        root = jnp.sqrt(half**2 + square * room)
        # Two forms of one root, each where it does not cancel.
        share = jnp.where(half > 0.0, room / _positive(half + root), (root - half) / _positive(square))
        mixed_B = brake_B + jnp.minimum(share, 1.0) * (torque_B - brake_B)
        return jnp.where(self.squared_peak(asked) <= jnp.maximum(self.squared, least), torque_B, mixed_B)


def from_model(model: Model, rate_error: jax.Array) -> RateLimit | None:
    """The limit of a spacecraft at the start, at rest; None where it has none.

    rate_error: () [rad/s] largest error of a measured rate.  The square root of w . M w is wrong by that times the
    square root of M's largest eigenvalue, and the momentum that actuators are taken to have to take up by that times
    the largest moment.
    """
    largest = nominal_rate(model)
    if largest is None:
        return None
    form_B = dynamics.peak_rate_form(model.inertia_B)
    stores = model.actuators.stored_momentum(model.actuators.initial_state()) is not None
    error = rate_error * (jnp.sqrt(jnp.linalg.eigvalsh(form_B)[2]) + (1.0 if stores else 0.0))
    return RateLimit(form_B, error, _squared(largest, error))


def now(limit: RateLimit, measured: EnvState, model: Model) -> RateLimit:
    """The limit in a state: that of actuators depends on the momentum that is on board."""
    largest = largest_rate(measured, model)
    return limit if largest is None else limit.replace(squared=_squared(largest, limit.error))


def _squared(largest: jax.Array, error: jax.Array) -> jax.Array:
    return jnp.maximum(largest - error, 0.0) ** 2


def _positive(x: jax.Array) -> jax.Array:
    return jnp.where(x > 0.0, x, 1.0)
