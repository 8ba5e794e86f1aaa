"""Gimbals that turn rotors of constant momentum, and how they are steered.

Steering is the generalised singularity-robust inverse of Wie, Bailey & Heiberg ("Singularity robust steering logic for
redundant single-gimbal control moment gyros", JGCD 24(5), 2001): a pseudo-inverse that is damped near singular
arrangements, with small terms that oscillate beside the diagonal, so that no direction of torque leaves the gimbals
at rest for ever.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.actuators.gyros import Gyros
from koz_jax.task import dynamics

# Damping at a singular arrangement, how fast it falls with det(J J') in units of the mean momentum, and the size of
# the terms beside the diagonal, as a share of the damping.
_DAMPING, _FALL, _ASIDE = 0.01, 10.0, 0.1

# Manipulability below this, in units of the mean momentum's third power, is called a singular arrangement.
SINGULAR = 0.1


class Gimbals(struct.PyTreeNode):
    """Gimbals with their rotors."""

    rotors_B: jax.Array  # (gyros, 3) [N m s] momenta at gimbal angle zero
    turned_B: jax.Array  # (gyros, 3) [N m s] momenta a quarter turn later
    max_rate: jax.Array  # (gyros,) [rad/s]

    def momentum(self, angles: jax.Array) -> jax.Array:
        """Sum over the rotors.  angles: (gyros,) [rad].  Returns (3,) [N m s]."""
        return jnp.cos(angles) @ self.rotors_B + jnp.sin(angles) @ self.turned_B

    def slopes(self, angles: jax.Array) -> jax.Array:
        """J, the derivative of the momentum by the gimbal angles, in units of ``unit``.  Returns (3, gyros)."""
        return (jnp.cos(angles)[:, None] * self.turned_B - jnp.sin(angles)[:, None] * self.rotors_B).T / self.unit

    def manipulability(self, angles: jax.Array) -> jax.Array:
        """sqrt(det(J J')).  angles: (gyros,) [rad].  Returns () in units of the third power of ``unit``."""
        slopes = self.slopes(angles)
        return jnp.sqrt(jnp.maximum(jnp.linalg.det(slopes @ slopes.T), 0.0))

    @property
    def unit(self) -> jax.Array:
        """Mean momentum of a rotor.  Returns () [N m s]."""
        return jnp.mean(jnp.linalg.norm(self.rotors_B, axis=1))

    def steer(self, angles: jax.Array, change_B: jax.Array, seconds: jax.Array) -> jax.Array:
        """Rates that change the momentum by (3,) [N m] a second as far as they can, scaled down as a whole to limits.

        angles: (gyros,) [rad]; seconds: () [s] of the oscillation.  Returns (gyros,) [rad/s].
        """
        slopes = self.slopes(angles)
        square = slopes @ slopes.T
        damping = _DAMPING * jnp.exp(-_FALL * jnp.linalg.det(square))
        x, y, z = _ASIDE * jnp.sin(jnp.mean(self.max_rate) * seconds + jnp.array([0.0, 0.5, 1.0]) * jnp.pi)
        one = jnp.ones(())
        around = jnp.stack([jnp.stack([one, z, y]), jnp.stack([z, one, x]), jnp.stack([y, x, one])])
        rates = slopes.T @ dynamics.matvec(dynamics.inverse(square + damping * around), change_B / self.unit)
        return rates / jnp.maximum(1.0, jnp.max(jnp.abs(rates) / self.max_rate))


def from_config(gyros: Gyros) -> Gimbals:
    """Gimbals as settings say, float32."""
    momenta = jnp.array([gyro.momentum for gyro in gyros], jnp.float32)[:, None]
    gimbals_B = jnp.array([gyro.gimbal_axis for gyro in gyros], jnp.float32)
    rotors_B = jnp.array([gyro.rotor_axis for gyro in gyros], jnp.float32)
    return Gimbals(
        rotors_B=momenta * rotors_B,
        turned_B=momenta * jnp.cross(gimbals_B, rotors_B),
        max_rate=jnp.deg2rad(jnp.array([gyro.max_gimbal_rate_deg for gyro in gyros], jnp.float32)),
    )
