"""Actuators: what turns a command into a torque, and which torques can be asked for.

The socket for spacecraft engineers: everything else (reward, shield, controllers, figures, exports) reads ``limits``
and calls ``apply``, and knows no other torque limit.  Actuators are pytrees, so their numbers can be vmapped and
randomised; what they carry from step to step is their state, a pytree of fixed shapes, None where they have none.
Momentum that they store is part of the motion, see ``dynamics.step``.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.actuators import wheels
from koz_jax.config.actuators.wheels import BRAKE_SHARE, LEAST_SHARE
from koz_jax.config.task import SpacecraftConfig
from koz_jax.task import dynamics, rotations
from koz_jax.task.gyros import gimbals
from koz_jax.task.gyros.gimbals import Gimbals

ActuatorState = Any  # a pytree of fixed shapes; None where actuators have no state

# Of a rotor's momentum, what all gyros together may hold for ``largest_rate``.
ROTORS_USED = 1.0


class TorqueLimits(struct.PyTreeNode):
    """Torques that can be asked for: a box in body axes, and the balls inside and around it."""

    box_B: jax.Array  # (3,) [N m] largest torque about each body axis

    @property
    def largest(self) -> jax.Array:
        """Norm of the largest torque: radius of the ball around, sqrt(3) u where all axes have u.  Returns () [N m]."""
        return jnp.sqrt(3.0) * self.scale

    @property
    def scale(self) -> jax.Array:
        """u, one number for the strength of the actuators: the root mean square over the axes.  Returns () [N m]."""
        return jnp.sqrt(jnp.mean(self.box_B**2))


class Actuators(Protocol):
    """What turns a command into a torque.  Implementations are pytrees."""

    def initial_state(self) -> ActuatorState:
        """State at the start of a maneuver."""
        ...

    def limits(self, state: ActuatorState, omega_BN_B: jax.Array) -> TorqueLimits:
        """Torques that can be asked for now.  omega_BN_B: (3,) [rad/s]."""
        ...

    def apply(
        self, command: jax.Array, state: ActuatorState, omega_BN_B: jax.Array, inertia_B: jax.Array, dt: jax.Array
    ) -> tuple[jax.Array, ActuatorState]:
        """Turn a command into a torque.

        command: (3,) in [-1, 1] (clipped), share of the torque limit about each body axis; omega_BN_B: (3,) [rad/s];
        inertia_B: (3, 3) [kg m^2]; dt: () [s].  Returns the torque (3,) [N m] in body axes, which is held over the
        step, and the state after it.
        """
        ...

    def stored_momentum(self, state: ActuatorState) -> jax.Array | None:
        """Angular momentum (3,) [N m s] that they hold, in body axes; None where they never hold any."""
        ...

    def largest_rate(self, state: ActuatorState, omega_BN_B: jax.Array, inertia_B: jax.Array) -> jax.Array | None:
        """Rate () [rad/s] up to which the body can be turned and stopped; None for any.  Arguments as of ``apply``."""
        ...

    @property
    def brake_torque(self) -> jax.Array | None:
        """Norm of the torque that is there in every direction up to the largest rate; None for none.  () [N m]."""
        ...


class WithoutMomentum(struct.PyTreeNode):
    """Base of actuators that hold no momentum, and whose torque does not depend on the rate."""

    def stored_momentum(self, state: ActuatorState) -> None:
        """Hold none."""
        return

    def largest_rate(self, state: ActuatorState, omega_BN_B: jax.Array, inertia_B: jax.Array) -> None:
        """Set no limit."""
        return

    @property
    def brake_torque(self) -> jax.Array:
        """The weakest axis.  Returns () [N m]."""
        return jnp.min(self.limits(self.initial_state(), jnp.zeros(3)).box_B)  # pyright: ignore


class TorqueBox(WithoutMomentum):
    """Any torque inside a box in body axes, at once: the paper's actuators."""

    limit_B: jax.Array  # (3,) [N m] largest torque about each body axis

    def initial_state(self) -> None:
        """Carry nothing."""
        return

    def limits(self, state: None, omega_BN_B: jax.Array) -> TorqueLimits:
        """Return the box."""
        return TorqueLimits(self.limit_B)

    def apply(
        self, command: jax.Array, state: None, omega_BN_B: jax.Array, inertia_B: jax.Array, dt: jax.Array
    ) -> tuple[jax.Array, None]:
        """Scale the command by the limits.  command: (3,).  Returns the torque (3,) [N m]."""
        return self.limit_B * jnp.clip(command, -1.0, 1.0), state


class ReactionWheels(struct.PyTreeNode):
    """Wheels that take up what they give to the body.

    A command asks for a torque as of a ``TorqueBox``, and the wheels add what their own momentum h takes: w x h, as
    it will be in the middle of the step.  So the body moves as one without wheels, and controllers need not know of
    them; they know the box that is left.  A torque is shared out by the least norm, and scaled down as a whole where a
    wheel is at the end of its torque or of its momentum.
    """

    axes_B: jax.Array  # (wheels, 3) unit vectors
    allocation: jax.Array  # (wheels, 3) torque of each wheel per torque on the body
    max_torque: jax.Array  # (wheels,) [N m]
    max_momentum: jax.Array  # (wheels,) [N m s]
    momentum: jax.Array  # (wheels,) [N m s] at the start
    box_B: jax.Array  # (3,) [N m] torque about each body axis while the body rests

    def initial_state(self) -> jax.Array:
        """Momentum of each wheel (wheels,) [N m s]."""
        return self.momentum

    def limits(self, state: jax.Array, omega_BN_B: jax.Array) -> TorqueLimits:
        """The box that is left beside what the wheels' own momentum takes."""
        taken = self.allocation @ rotations.cross(omega_BN_B, self.stored_momentum(state))
        room = (self.max_torque - jnp.abs(taken)) / (jnp.abs(self.allocation) @ self.box_B)
        return TorqueLimits(jnp.clip(jnp.min(room), LEAST_SHARE, 1.0) * self.box_B)

    def apply(
        self, command: jax.Array, state: jax.Array, omega_BN_B: jax.Array, inertia_B: jax.Array, dt: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Share the torque out.  Returns the torque (3,) [N m], and the momentum of each wheel (wheels,) after it."""
        wanted_B = self.limits(state, omega_BN_B).box_B * jnp.clip(command, -1.0, 1.0)
        each = self.torques(wanted_B, state, omega_BN_B, inertia_B, dt)
        return self.axes_B.T @ each, state - dt * each

    def torques(
        self, wanted_B: jax.Array, state: jax.Array, omega_BN_B: jax.Array, inertia_B: jax.Array, dt: jax.Array
    ) -> jax.Array:
        """Torque that each wheel gives the body.  wanted_B: (3,) [N m] within the limits.  Returns (wheels,) [N m]."""
        each = self.allocation @ _with_gyroscopic(wanted_B, self.stored_momentum(state), omega_BN_B, inertia_B, dt)
        size = jnp.maximum(jnp.abs(each), 1e-12 * self.max_torque)
        room = jnp.minimum(self.max_torque, (self.max_momentum + jnp.sign(each) * state) / dt)
        return jnp.clip(jnp.min(room / size), 0.0, 1.0) * each

    def stored_momentum(self, state: jax.Array) -> jax.Array:
        """Sum over the wheels.  Returns (3,) [N m s]."""
        return self.axes_B.T @ state

    def largest_rate(self, state: jax.Array, omega_BN_B: jax.Array, inertia_B: jax.Array) -> jax.Array:
        """The smaller of two rates, with H the total momentum, which stays, and a, c the extreme moments.

        No wheel is full: each holds at most its share of |H| + c w, beside what is shared among wheels alone.  And the
        gyroscopic torque, at most (c - a) w^2 / 2 + w |H|, takes no more than half of the torque.
        """
        held_B = self.stored_momentum(state)
        total = rotations.norm(dynamics.matvec(inertia_B, omega_BN_B) + held_B)
        moments = jnp.linalg.eigvalsh(inertia_B)
        share = jnp.linalg.norm(self.allocation, axis=1)
        idle = jnp.abs(state - self.allocation @ held_B)
        by_momentum = (jnp.min((self.max_momentum - idle) / share) - total) / moments[2]
        difference = moments[2] - moments[0]
        reserve = (1.0 - BRAKE_SHARE) * jnp.min(self.box_B)
        # The root of the quadratic equation, in the form that does not cancel.
        divisor = total + jnp.sqrt(total**2 + 2.0 * difference * reserve)
        by_torque = jnp.where(divisor > 0.0, 2.0 * reserve / jnp.where(divisor > 0.0, divisor, 1.0), jnp.inf)
        return jnp.maximum(jnp.minimum(by_momentum, by_torque), 0.0)

    @property
    def brake_torque(self) -> jax.Array:
        """What is left up to the largest rate.  Returns () [N m]."""
        return BRAKE_SHARE * jnp.min(self.box_B)


class GimbalState(struct.PyTreeNode):
    """Where gimbals are."""

    angles: jax.Array  # (gyros,) [rad]
    seconds: jax.Array  # () [s] since the start


class ControlMomentGyros(struct.PyTreeNode):
    """Gyros that exchange momentum with the body.

    A command asks for a torque as of a ``TorqueBox``, and the gimbals add what the gyros' momentum h takes: w x h, as
    for ``ReactionWheels``.  Near singular arrangements the torque is another one than was asked for.
    """

    gimbals: Gimbals
    angles: jax.Array  # (gyros,) [rad] at the start
    box_B: jax.Array  # (3,) [N m] that controllers are told of

    def initial_state(self) -> GimbalState:
        """Gimbal angles at the start."""
        return GimbalState(self.angles, jnp.zeros(()))

    def limits(self, state: GimbalState, omega_BN_B: jax.Array) -> TorqueLimits:
        """The box, wherever the gimbals are."""
        return TorqueLimits(self.box_B)

    def apply(
        self, command: jax.Array, state: GimbalState, omega_BN_B: jax.Array, inertia_B: jax.Array, dt: jax.Array
    ) -> tuple[jax.Array, GimbalState]:
        """Turn the gimbals.  Returns the mean torque (3,) [N m] over the step, and where they are after it."""
        wanted_B, held_B = self.box_B * jnp.clip(command, -1.0, 1.0), self.stored_momentum(state)
        change_B = -_with_gyroscopic(wanted_B, held_B, omega_BN_B, inertia_B, dt)
        # By the arrangement in the middle of the step, so that what is missed is of second order.
        begin = self.gimbals.steer(state.angles, change_B, state.seconds)
        rates = self.gimbals.steer(state.angles + 0.5 * dt * begin, change_B, state.seconds)
        after = GimbalState(state.angles + dt * rates, state.seconds + dt)
        return (held_B - self.stored_momentum(after)) / dt, after

    def stored_momentum(self, state: GimbalState) -> jax.Array:
        """Sum over the rotors.  Returns (3,) [N m s]."""
        return self.gimbals.momentum(state.angles)

    def largest_rate(self, state: GimbalState, omega_BN_B: jax.Array, inertia_B: jax.Array) -> jax.Array:
        """The rate up to which the gyros hold ``ROTORS_USED`` rotors' momentum at most, at any attitude."""
        total_B = dynamics.matvec(inertia_B, omega_BN_B) + self.stored_momentum(state)
        room = ROTORS_USED * self.gimbals.unit - rotations.norm(total_B)
        return jnp.maximum(room, 0.0) / jnp.linalg.eigvalsh(inertia_B)[2]

    @property
    def brake_torque(self) -> None:
        """None: in a singular arrangement there is a direction without a torque."""
        return


def _with_gyroscopic(
    wanted_B: jax.Array, held_B: jax.Array, omega_BN_B: jax.Array, inertia_B: jax.Array, dt: jax.Array
) -> jax.Array:
    """Add to a torque (3,) [N m] what stored momentum (3,) takes: w x h in the middle of the step.  Returns (3,)."""
    half, inverse_B = 0.5 * dt, dynamics.inverse(inertia_B)
    omega_middle_B = omega_BN_B + half * dynamics.angular_acceleration(omega_BN_B, wanted_B, inertia_B, inverse_B)
    held_middle_B = held_B - half * (wanted_B + rotations.cross(omega_BN_B, held_B))
    return wanted_B + rotations.cross(omega_middle_B, held_middle_B)


def from_config(spacecraft: SpacecraftConfig) -> Actuators:
    """The actuators that the settings of a spacecraft ask for, float32."""
    box_B = jnp.array(spacecraft.torque_limits, jnp.float32)
    if spacecraft.gyros:
        angles = jnp.deg2rad(jnp.array([gyro.angle_deg for gyro in spacecraft.gyros], jnp.float32))
        return ControlMomentGyros(gimbals.from_config(spacecraft.gyros), angles, box_B)
    if not spacecraft.wheels:
        return TorqueBox(box_B)
    of_each = {
        name: jnp.array([getattr(wheel, name) for wheel in spacecraft.wheels], jnp.float32)
        for name in ("max_torque", "max_momentum", "momentum")
    }
    axes_B = jnp.array([wheel.axis for wheel in spacecraft.wheels], jnp.float32)
    allocation = jnp.array(wheels.allocation(spacecraft.wheels), jnp.float32)
    return ReactionWheels(axes_B=axes_B, allocation=allocation, box_B=box_B, **of_each)
