"""Feedback on a logarithmic barrier potential, in the form of Lee & Mesbahi.

U. Lee, M. Mesbahi, "Feedback control for spacecraft reorientation under attitude constraints via convex potentials",
IEEE Transactions on Aerospace and Electronic Systems 50 (2014): V = |q_e - 1|^2 (1 - sum of k log(u)), where u is the
convexified constraint of a zone, scaled to (0, 1]; torque = - gradient - damping.  The potential may hold the attitude
in a saddle or a local minimum behind a zone; nothing is done about that here.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import feedback
from koz_jax.control.base import Memoryless
from koz_jax.control.feedback import Gain
from koz_jax.task import rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, Model, attitude_error, torque_limits

# Below this the barrier goes on as a straight line, so that it is finite inside a zone too.
_LEAST_ROOM = 1e-3

# Share of the rate that damping takes back within a time step, at most: all of it; with more than twice that a held
# torque would be unstable.  It is 0.992 on the paper's task.
_DAMPING_PER_STEP = 1.0


class Potential(struct.PyTreeNode):
    """V as a function of the attitude; without unit."""

    barrier: Gain  # () weight of a zone's barrier
    margin: Gain  # () [rad] by which zones are taken wider

    def value(self, q_e: jax.Array, looks_N: jax.Array, zones: PointingConstraint) -> jax.Array:
        """V.  q_e: (4,); looks_N: (zones, 3) boresight of each; zones: stacked.  Returns ()."""
        # (q_0 - 1)^2 + |q_vec|^2 = 2 (1 - q_0), but without cancellation near the target.
        away = (q_e[0] - 1.0) ** 2 + rotations.dot(q_e[1:], q_e[1:])
        edge = jnp.cos(jnp.minimum(zones.half_angle + self.margin, jnp.pi))
        cosines = jax.vmap(rotations.dot)(zones.axis_N, looks_N)
        room = (edge - cosines) / (1.0 + edge)
        barriers = jnp.where(zones.is_present, _minus_log(room), 0.0)
        return away * (1.0 + self.barrier * jnp.sum(barriers))

    def gradient(self, state: EnvState) -> jax.Array:
        """How V changes with a small turn about each body axis.  Returns (3,) [1/rad]."""

        def turned(vector_B: jax.Array) -> jax.Array:
            turn = jnp.concatenate([jnp.ones(1), 0.5 * vector_B])

            def look_N(boresight_B: jax.Array) -> jax.Array:
                return rotations.rotate(state.body.q_BN, boresight_B + rotations.cross(vector_B, boresight_B))

            looks_N = jax.vmap(look_N)(state.scenario.constraints.boresight_B)
            return self.value(rotations.multiply(attitude_error(state), turn), looks_N, state.scenario.constraints)

        return jax.grad(turned)(jnp.zeros(3))


def _minus_log(room: jax.Array) -> jax.Array:
    inside = jnp.maximum(room, _LEAST_ROOM)
    return -jnp.log(inside) + (inside - room) / _LEAST_ROOM


class PotentialFeedback(Memoryless):
    """Torque along minus the gradient of the potential, with damping.

    Gains are those of the error's linear dynamics near the target far from zones: a natural frequency and a damping
    ratio.  Both are lower where damping would be too strong for the time step.
    """

    # ``python -m koz_jax.cli.tune potential`` at commit 00b415c, which found 1.149 rad/s for T = sqrt(30) s.
    frequency: Gain = 6.293332  # () [rad/T]
    damping: Gain = 4.316  # () ratio
    barrier: Gain = 0.3762  # ()
    margin: Gain = 0.02756  # () [rad]

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        gradient_B = Potential(self.barrier, self.margin).gradient(state)
        frequency = self.frequency / units.of(model).time
        damping = 2.0 * self.damping * frequency
        # Near the target |q_e - 1|^2 is a quarter of the error squared, and its gradient half the error.
        spring_B = -2.0 * frequency**2 * gradient_B
        # Of both alike, so that the rate at which they balance stays, which is how fast the body goes about.
        share = jnp.minimum(_DAMPING_PER_STEP / (damping * model.dt), 1.0)
        acceleration_B = share * (spring_B - damping * state.body.omega_BN_B)
        return feedback.action(acceleration_B, state.body, model.inertia_B, torque_limits(state, model)), memory
