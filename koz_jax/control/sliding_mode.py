"""Sliding mode on a surface made of a potential: s = w - v(attitude), in the way of Yang (2021).

On the surface the body turns against the gradient of the logarithmic potential, no faster than the torque limit can
brake, and with a part that leads around a zone that stands between boresight and target; the gradient alone would stall
behind it.  Torque = equivalent control - eta sat(s / eps).
"""

import jax
import jax.numpy as jnp

from koz_jax.control import feedback
from koz_jax.control.base import Memoryless
from koz_jax.control.feedback import Gain
from koz_jax.control.potential import Potential
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, Model, attitude_error, torque_limits


class PotentialSliding(Memoryless):
    """Reaches the surface with a limited switching term, and slides along it to the target."""

    # ``python -m koz_jax.cli.tune sliding`` at commit 00b415c, which found 5.753 1/s, 0.4328 1/s and 0.1371 rad/s for
    # T = sqrt(30) s.
    bandwidth: Gain = 31.51048  # () [1/T] with which the error decays near the target
    reach: Gain = 2.370543  # () [1/T], eta / eps: how fast s decays inside the boundary layer
    layer: Gain = 0.7509276  # () [rad/T], eps
    torque_share: Gain = 0.8932  # () of the torque limit that braking counts on
    detour_share: Gain = 0.2404  # () of the rate that is kept where the way leads aside
    barrier: Gain = 0.03003  # () weight of a zone in the potential
    margin: Gain = 0.02237  # () [rad] by which zones are taken wider
    swirl: Gain = 2.128  # () part that leads around a zone, relative to the part that leads away from it

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        body = state.body

        def wanted_rate(q_BN: jax.Array) -> jax.Array:
            return self.wanted_rate(state.replace(body=body.replace(q_BN=q_BN)), model)

        wanted_B, change_B = jax.jvp(wanted_rate, (body.q_BN,), (dynamics.attitude_rate(body.q_BN, body.omega_BN_B),))
        s_B = body.omega_BN_B - wanted_B
        size = rotations.norm(s_B)
        layer = self.layer / units.of(model).time
        switching_B = s_B * jnp.minimum(1.0, layer / jnp.where(size > 0.0, size, 1.0))
        acceleration_B = change_B - feedback.bandwidth(self.reach, model) * switching_B
        return feedback.action(acceleration_B, body, model.inertia_B, torque_limits(state, model)), memory

    def wanted_rate(self, state: EnvState, model: Model) -> jax.Array:
        """v, the body rate (3,) [rad/s] on the surface."""
        error_B = feedback.error_vector(state)
        angle = rotations.norm(error_B)
        home_B = -_unit(error_B)
        way_B = _unit(Potential(self.barrier, self.margin).gradient(state) * -1.0 + self._around(state))
        rate = jnp.abs(rotations.dot(state.body.omega_BN_B, way_B))
        deceleration = feedback.deceleration_about(
            way_B, rate, model.inertia_B, torque_limits(state, model), self.torque_share
        )
        straight = jnp.maximum(rotations.dot(way_B, home_B), 0.0)
        share = self.detour_share + (1.0 - self.detour_share) * straight
        bandwidth = feedback.bandwidth(self.bandwidth, model)
        return share * feedback.brake_rate(angle, jax.lax.stop_gradient(deceleration), bandwidth) * way_B

    def _around(self, state: EnvState) -> jax.Array:
        """Turn (3,) [1/rad] that leads the boresight around the zones between it and its target."""
        to_body = rotations.conjugate(state.body.q_BN)
        q_e = attitude_error(state)
        away = (q_e[0] - 1.0) ** 2 + rotations.dot(q_e[1:], q_e[1:])

        def around(zone: PointingConstraint) -> jax.Array:
            look_B = zone.boresight_B
            goal_B = rotations.rotate(to_body, rotations.rotate(state.scenario.q_DN, look_B))
            axis_B = pointing_constraints.axis_B(state.body.q_BN, zone)
            inward_B = axis_B - rotations.dot(axis_B, look_B) * look_B
            onward_B = goal_B - rotations.dot(goal_B, look_B) * look_B
            between = jnp.maximum(rotations.dot(_unit(inward_B), _unit(onward_B)), 0.0)
            aside = rotations.dot(rotations.cross(axis_B, look_B), goal_B)
            edge = jnp.cos(jnp.minimum(zone.half_angle + self.margin, jnp.pi))
            room = jnp.maximum(edge - rotations.dot(axis_B, look_B), 0.02)
            strength = jnp.where(zone.is_present, self.swirl * self.barrier * away * between / room, 0.0)
            return strength * jnp.where(aside >= 0.0, 1.0, -1.0) * _unit(inward_B)

        return jnp.sum(jax.vmap(around)(state.scenario.constraints), axis=0)


def _unit(v: jax.Array) -> jax.Array:
    size = rotations.norm(v)
    return v / jnp.where(size > 0.0, size, 1.0)
