"""Sliding mode on the logarithmic barrier potential, as published by Yang et al.

J. Yang, Y. Duan, M. K. Ben-Larbi, E. Stoll, "Potential field-based sliding surface design and its application in
spacecraft constrained reorientation", Journal of Guidance, Control, and Dynamics 44(2) (2021), 10.2514/1.G005026.
``sliding`` is our own relative, with a surface of its own, and tuned gains.

The paper aims at delta(q_e0) q_d, the sign of q_d that is nearer at the start.  A maneuver here begins with that sign,
so delta is 1; it is not looked at again, and an error that grows past half a turn is undone the way it came.  The
paper's equation of the derivative cannot be read in our copy; ours is the derivative itself.

The boundary layer is as thin as published, 1e-4 rad/s.  Held for 0.1 s, sigma changes the rate of the published
spacecraft by up to 8e-4 rad/s, so at such steps the switching term chatters between its bounds for ever.  It points no
worse, but half of the effort of that flight is chatter: 105 N^2 m^2 s in 150 s at steps of 0.1 s, 53 at 0.01 s, both
with 2 N m.  The published 113.4 are 108 here with no limit, which is lost, and steps of 0.01 s.
"""

import jax
import jax.numpy as jnp

from koz_jax.control.base import Memoryless
from koz_jax.control.feedback import Gain
from koz_jax.control.published import log_barrier
from koz_jax.control.published.log_barrier import TIME, TORQUE, LogBarrierPotential
from koz_jax.task import dynamics
from koz_jax.task.any_spacecraft import units
from koz_jax.task.state import EnvState, Model, torque_limits


class YangSliding(Memoryless):
    """Torque = w x I w - alpha I d/dt vec(q* (x) grad V) - sigma sat(s, eps) - k s, s = w + alpha vec(q* (x) grad V).

    sat(s, eps) is s / eps, cut at -1 and 1 by component.  While no torque limit binds, V + s' I s / 2 never rises.
    """

    away: Gain = 0.05  # () beta1 = 5 beta2
    barrier: Gain = 0.01  # () beta2 k1 = beta2 k2, where beta2 = 0.01 and k1 = k2 = 1
    slide: Gain = 2.0 * TIME  # () [1/T] alpha = 2 1/s
    switching: Gain = 0.35 / TORQUE  # () [u] sigma = 0.35 N m
    layer: Gain = 1e-4 * TIME  # () [rad/T] eps = 1e-4 rad/s
    reach: Gain = 4.0 / (TORQUE * TIME)  # () [u T] k = 4 N m s

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        unit, omega_B = units.of(model), state.body.omega_BN_B
        slope_B, change_B = LogBarrierPotential(self.away, self.barrier).slope_and_change(state)
        slide = self.slide / unit.time
        s_B = omega_B + slide * slope_B
        sat_B = jnp.clip(s_B / (self.layer / unit.time), -1.0, 1.0)
        torque_B = (
            dynamics.gyroscopic_torque(omega_B, model.inertia_B)
            - dynamics.matvec(model.inertia_B, slide * change_B)
            - self.switching * unit.torque * sat_B
            - self.reach * unit.torque * unit.time * s_B
        )
        return log_barrier.action(torque_B, torque_limits(state, model)), memory
