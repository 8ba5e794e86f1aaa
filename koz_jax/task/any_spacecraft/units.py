"""Units and axes in which all spacecraft look alike: time in T = sqrt(J / u), the x axis along the instrument.

J is a third of the trace of the inertia, u the strength of the actuators.  In these units two spacecraft of one shape
fly the same maneuver in the same way, so a controller whose numbers are in them is right for any spacecraft.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import dynamics, state
from koz_jax.task.state import Model


class Units(struct.PyTreeNode):
    """The units of a spacecraft."""

    time: jax.Array  # () [s] T = sqrt(J / u), in which the torque u turns half a radian from rest
    inertia: jax.Array  # () [kg m^2] J, a third of the trace of the inertia: the mean of the principal moments
    torque: jax.Array  # () [N m] u, the root mean square of the torque limits over the axes

    @property
    def acceleration(self) -> jax.Array:
        """u / J = 1 / T^2.  Returns () [rad/s^2]."""
        return self.torque / self.inertia


def of(model: Model) -> Units:
    """The units of a spacecraft, by the limits that its actuators have at the start."""
    limits = state.nominal_limits(model)
    inertia = jnp.trace(model.inertia_B) / 3.0
    return Units(time=jnp.sqrt(inertia / limits.scale), inertia=inertia, torque=limits.scale)


def policy_axes(boresight_B: jax.Array) -> jax.Array:
    """The axes P of a policy: x along the instrument, by the smallest turn of the body's axes.

    boresight_B: (3,) unit vector.  Returns (3, 3), whose rows are the axes in body components: v_P = matrix v_B.  The
    turn is a continuous function of the boresight but at -x, where it is the half-turn about z: no rule is continuous
    everywhere.  An instrument along x keeps the body's own axes.
    """
    x, y, z = boresight_B
    opposite = x < -1.0 + 1e-6
    # 1 / (1 + x), by 1 - x^2 = y^2 + z^2 where the sum cancels.
    share = jnp.where(x < 0.0, 1.0 - x, 1.0) / jnp.where(opposite, 1.0, jnp.where(x < 0.0, y * y + z * z, 1.0 + x))
    turned = jnp.stack(
        [
            boresight_B,
            jnp.stack([-y, 1.0 - share * y * y, -share * y * z]),
            jnp.stack([-z, -share * y * z, 1.0 - share * z * z]),
        ]
    )
    return jnp.where(opposite, jnp.diag(jnp.array([-1.0, -1.0, 1.0])), turned)


def torque_for(acceleration_P: jax.Array, axes: jax.Array, model: Model) -> jax.Array:
    """Torque (3,) [N m] in body axes that turns a body at rest with an angular acceleration in units of u / J.

    acceleration_P: (3,) in the policy's axes; axes: (3, 3), see ``policy_axes``.
    """
    acceleration_B = of(model).acceleration * dynamics.matvec(axes.T, acceleration_P)
    return dynamics.matvec(model.inertia_B, acceleration_B)


def time_of_torque(change_B: jax.Array, box_B: jax.Array, model: Model) -> jax.Array:
    """Time [s] for which a torque box has to push along the momentum of a rate, until that is there or gone.

    change_B: (3,) [rad/s] in body axes; box_B: (3,) [N m].  For an angle (3,) [rad] in place of the rate it is t^2 / 2
    [s^2] of the time t in which a body at rest is turned by it.  Returns ().
    """
    return jnp.max(jnp.abs(dynamics.matvec(model.inertia_B, change_B)) / box_B)
