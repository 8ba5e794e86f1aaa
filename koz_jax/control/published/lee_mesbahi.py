"""Feedback on the logarithmic barrier potential, as published by Lee & Mesbahi: proportional-derivative, backstepping.

U. Lee, M. Mesbahi, "Feedback control for spacecraft reorientation under attitude constraints via convex potentials",
IEEE Transactions on Aerospace and Electronic Systems 50 (2014), 10.1109/TAES.2014.120240.  ``potential`` is our own
relative, with tuned gains.

V has no part without barriers (b1 = 0).  So where there is no zone nothing turns the body, and a single zone makes a
minimum far from the target, where the instrument looks away from the zone: -log(room) is next to nothing there.  The
proportional-derivative form comes to rest in it in all of 1000 cases of the paper's task, and in half of them with
three zones.

Gains are those with which Yang et al. (10.2514/1.G005026) fly the first form: alpha = 20, k1 = k2 = 1.4.  Which of its
numbers alpha is, we could not read.  It is taken for the damping [N m s], and the gradient has the factor 1/2 with
which V + w' I w / 2 never rises, as dV/dt = w . vec(q* (x) grad V) / 2.  Torques are cut by component, which the
proofs do not cover.  The torque limit of the published flight is lost too: its 268.5 N^2 m^2 s are 183 here with 2 N m
and steps of 0.1 s; with no limit and steps of 0.003 s they are 256, and 1117 without the factor 1/2.
"""

import jax

from koz_jax.control.base import Memoryless
from koz_jax.control.feedback import Gain
from koz_jax.control.published import log_barrier
from koz_jax.control.published.log_barrier import TIME, TORQUE, LogBarrierPotential
from koz_jax.task import dynamics
from koz_jax.task.any_spacecraft import units
from koz_jax.task.state import EnvState, Model, torque_limits


class LeeMesbahiPD(Memoryless):
    """Torque = - c vec(q* (x) grad V) / 2 - alpha w."""

    barrier: Gain = 1.4  # () k1 = k2
    stiffness: Gain = 1.0 / TORQUE  # () [u] c = 1 N m
    damping: Gain = 20.0 / (TORQUE * TIME)  # () [u T] alpha = 20 N m s

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        unit = units.of(model)
        slope_B = LogBarrierPotential(0.0, self.barrier).slope(state.body.q_BN, state.scenario)
        spring_B = -0.5 * self.stiffness * unit.torque * slope_B
        torque_B = spring_B - self.damping * unit.torque * unit.time * state.body.omega_BN_B
        return log_barrier.action(torque_B, torque_limits(state, model)), memory


class LeeMesbahiBackstepping(Memoryless):
    """Torque = w x I w + I dv/dt - c vec(q* (x) grad V) / 2 - alpha (w - v), v = - k vec(q* (x) grad V).

    With it c V + (w - v)' I (w - v) / 2 never rises.  We have no published gains: alpha is that of the other form, and
    k = c / alpha, twice the slope with which that form's spring and damper balance.
    """

    barrier: Gain = 1.4  # () k1 = k2
    stiffness: Gain = 1.0 / TORQUE  # () [u] c = 1 N m
    damping: Gain = 20.0 / (TORQUE * TIME)  # () [u T] alpha = 20 N m s
    rate: Gain = TIME / 20.0  # () [1/T] k = 1/20 1/s

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        unit, omega_B = units.of(model), state.body.omega_BN_B
        slope_B, change_B = LogBarrierPotential(0.0, self.barrier).slope_and_change(state)
        rate = self.rate / unit.time
        torque_B = (
            dynamics.gyroscopic_torque(omega_B, model.inertia_B)
            - dynamics.matvec(model.inertia_B, rate * change_B)
            - 0.5 * self.stiffness * unit.torque * slope_B
            - self.damping * unit.torque * unit.time * (omega_B + rate * slope_B)
        )
        return log_barrier.action(torque_B, torque_limits(state, model)), memory
