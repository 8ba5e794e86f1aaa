"""Feedback on a logarithmic barrier potential, in the form of Lee & Mesbahi.

U. Lee, M. Mesbahi, "Feedback control for spacecraft reorientation under attitude constraints via convex potentials",
IEEE Transactions on Aerospace and Electronic Systems 50 (2014): V = |q_e - 1|^2 (1 - sum of k log(u)), where u is the
convexified constraint of a zone, scaled to (0, 1]; torque = - gradient - damping.  The potential may hold the attitude
in a saddle or a local minimum behind a zone; nothing is done about that here.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import env, rotations
from koz_jax.controllers import feedback
from koz_jax.controllers.base import Memoryless
from koz_jax.controllers.feedback import Gain
from koz_jax.env import EnvParams, EnvState
from koz_jax.keep_out import KeepOutZone

# Below this the barrier goes on as a straight line, so that it is finite inside a zone too.
_LEAST_ROOM = 1e-3


class Potential(struct.PyTreeNode):
    """V as a function of the attitude; without unit."""

    barrier: Gain  # () weight of a zone's barrier
    margin: Gain  # () [rad] by which zones are taken wider

    def value(self, q_e: jax.Array, looks_N: jax.Array, zones: KeepOutZone) -> jax.Array:
        """V.  q_e: (4,); looks_N: (3,) boresight; zones: stacked.  Returns ()."""
        # (q_0 - 1)^2 + |q_vec|^2 = 2 (1 - q_0), but without cancellation near the target.
        away = (q_e[0] - 1.0) ** 2 + rotations.dot(q_e[1:], q_e[1:])
        edge = jnp.cos(jnp.minimum(zones.half_angle + self.margin, jnp.pi))
        cosines = jax.vmap(rotations.dot, in_axes=(0, None))(zones.axis_N, looks_N)
        room = (edge - cosines) / (1.0 + edge)
        barriers = jnp.where(zones.half_angle > 0.0, _minus_log(room), 0.0)
        return away * (1.0 + self.barrier * jnp.sum(barriers))

    def gradient(self, state: EnvState, params: EnvParams) -> jax.Array:
        """How V changes with a small turn about each body axis.  Returns (3,) [1/rad]."""

        def turned(vector_B: jax.Array) -> jax.Array:
            turn = jnp.concatenate([jnp.ones(1), 0.5 * vector_B])
            look_B = params.spacecraft.boresight_B
            look_N = rotations.rotate(state.body.q_BN, look_B + rotations.cross(vector_B, look_B))
            return self.value(rotations.multiply(env.attitude_error(state), turn), look_N, state.scenario.zones)

        return jax.grad(turned)(jnp.zeros(3))


def _minus_log(room: jax.Array) -> jax.Array:
    inside = jnp.maximum(room, _LEAST_ROOM)
    return -jnp.log(inside) + (inside - room) / _LEAST_ROOM


class PotentialFeedback(Memoryless):
    """Torque along minus the gradient of the potential, with damping.

    Gains are those of the error's linear dynamics near the target far from zones: a natural frequency and a damping
    ratio.
    """

    # ``python -m koz_jax.controllers.tune potential`` at commit 00b415c.
    frequency: Gain = 1.149  # () [rad/s]
    damping: Gain = 4.316  # () ratio
    barrier: Gain = 0.3762  # ()
    margin: Gain = 0.02756  # () [rad]

    def decide(self, state: EnvState, params: EnvParams, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        gradient_B = Potential(self.barrier, self.margin).gradient(state, params)
        # Near the target |q_e - 1|^2 is a quarter of the error squared, and its gradient half the error.
        spring_B = -2.0 * self.frequency**2 * gradient_B
        damping_B = -2.0 * self.damping * self.frequency * state.body.omega_BN_B
        return feedback.action(spring_B + damping_B, state.body, params), memory
