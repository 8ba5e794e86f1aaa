"""Saturated quaternion feedback about the eigen-axis; it does not know the zones.

Quaternion and rate feedback with gyroscopic compensation.  Far from the target the attitude term is limited to the
rate from which the torque limit can still brake (after Wie & Lu, "Feedback control logic for spacecraft eigenaxis
rotations under slew rate and control constraints", JGCD 1995), so that large slews are nearly bang-bang.
"""

import jax
import jax.numpy as jnp

from koz_jax.control import feedback
from koz_jax.control.base import Memoryless
from koz_jax.control.feedback import Gain
from koz_jax.task import dynamics, rotations
from koz_jax.task.state import EnvState, Model, attitude_error, torque_limits


class QuaternionFeedback(Memoryless):
    """Drives the error about its eigen-axis to zero as fast as it can be braked.

    Without saturation the error decays with ``bandwidth`` and the rate follows with ``rate_bandwidth``.
    """

    # ``python -m koz_jax.cli.tune pd`` at commit 00b415c, which found 5.86 and 0.4071 1/s for T = sqrt(30) s.
    bandwidth: Gain = 32.09654  # () [1/T]
    rate_bandwidth: Gain = 2.229779  # () [1/T]
    torque_share: Gain = 1.066  # () of the torque limit that braking counts on

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        q_e, omega_B = attitude_error(state), state.body.omega_BN_B
        limits = torque_limits(state, model)
        bandwidth, rate_bandwidth = (feedback.bandwidth(gain, model) for gain in (self.bandwidth, self.rate_bandwidth))

        def wanted_rate(at: jax.Array) -> jax.Array:
            error_B = feedback.rotation_vector(at)
            angle = rotations.norm(error_B)
            axis_B = error_B / jnp.where(angle > 0.0, angle, 1.0)
            rate = jnp.abs(rotations.dot(omega_B, axis_B))
            brake = feedback.deceleration_about(
                axis_B, jax.lax.stop_gradient(rate), model.inertia_B, limits, self.torque_share
            )
            return -feedback.brake_rate(angle, jax.lax.stop_gradient(brake), bandwidth) * axis_B

        wanted_B, change_B = jax.jvp(wanted_rate, (q_e,), (dynamics.attitude_rate(q_e, omega_B),))
        acceleration_B = change_B + rate_bandwidth * (wanted_B - omega_B)
        return feedback.action(acceleration_B, state.body, model.inertia_B, limits), memory
