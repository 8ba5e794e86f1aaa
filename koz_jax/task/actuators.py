"""Actuators: what turns a command into a torque, and which torques can be asked for.

The socket for spacecraft engineers: everything else (reward, shield, controllers, figures, exports) reads ``limits``
and calls ``apply``, and knows no other torque limit.  Actuators are pytrees, so their numbers can be vmapped and
randomised; what they carry from step to step is their state, a pytree of fixed shapes, None where they have none.
"""

from typing import Any, Protocol

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.task import SpacecraftConfig

ActuatorState = Any  # a pytree of fixed shapes; None where actuators have no state


class TorqueLimits(struct.PyTreeNode):
    """Torques that can be asked for: a box in body axes, and the balls inside and around it."""

    box_B: jax.Array  # (3,) [N m] largest torque about each body axis

    @property
    def every_direction(self) -> jax.Array:
        """Norm of the torque that is there in every direction: radius of the ball inside.  Returns () [N m]."""
        return jnp.min(self.box_B)

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

    def limits(self, state: ActuatorState) -> TorqueLimits:
        """Torques that can be asked for now."""
        ...

    def apply(self, command: jax.Array, state: ActuatorState) -> tuple[jax.Array, ActuatorState]:
        """Turn a command into a torque.

        command: (3,) in [-1, 1] (clipped), share of the torque limit about each body axis.  Returns the torque (3,)
        [N m] in body axes, which is held over the step, and the state after it.
        """
        ...


class TorqueBox(struct.PyTreeNode):
    """Any torque inside a box in body axes, at once: the paper's actuators."""

    limit_B: jax.Array  # (3,) [N m] largest torque about each body axis

    def initial_state(self) -> None:
        """Carry nothing."""
        return

    def limits(self, state: None) -> TorqueLimits:
        """Return the box."""
        return TorqueLimits(self.limit_B)

    def apply(self, command: jax.Array, state: None) -> tuple[jax.Array, None]:
        """Scale the command by the limits.  command: (3,).  Returns the torque (3,) [N m]."""
        return self.limit_B * jnp.clip(command, -1.0, 1.0), state


def from_config(spacecraft: SpacecraftConfig) -> Actuators:
    """The actuators that the settings of a spacecraft ask for, float32."""
    return TorqueBox(jnp.array(spacecraft.torque_limits, jnp.float32))
