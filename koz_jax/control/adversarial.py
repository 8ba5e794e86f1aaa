"""Controllers that do their worst, to try the shield: none of them knows what is good for the telescope.

Times are in units of T, see ``any_spacecraft.units``.
"""

from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import registry
from koz_jax.control.base import Memoryless
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.state import EnvState, Model, torque_limits

# [T/rad] How much a rate that does not lead to the zone weighs with the adversary, beside the way that does.
_ASIDE = 1.825742


class _Drawn(struct.PyTreeNode):
    """An action that is held, and the key for the next one."""

    key: jax.Array
    action: jax.Array  # (3,)


class Random(struct.PyTreeNode):
    """Uniform torque in the box, a new one at every step."""

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> jax.Array:
        """Remember the key."""
        return key

    def decide(self, state: EnvState, model: Model, memory: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw an action (3,)."""
        key, key_action = jax.random.split(memory)
        return jax.random.uniform(key_action, (3,), minval=-1.0, maxval=1.0), key


class BangBang(struct.PyTreeNode):
    """Full throttle: a random corner of the torque box, held for some time."""

    hold: jax.Array = struct.field(default_factory=lambda: jnp.float32(0.7302967))  # () [T]

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> _Drawn:
        """Draw the first corner."""
        return self._draw(key)

    def decide(self, state: EnvState, model: Model, memory: _Drawn) -> tuple[jax.Array, _Drawn]:
        """Action (3,): the corner that is held."""
        steps = jnp.maximum(_steps(self.hold, model), 1)
        again = (state.steps % steps == 0) & (state.steps > 0)
        fresh = self._draw(memory.key)
        memory = jax.tree.map(lambda new, old: jnp.where(again, new, old), fresh, memory)
        return memory.action, memory

    @staticmethod
    def _draw(key: jax.Array) -> _Drawn:
        key, key_action = jax.random.split(key)
        return _Drawn(key, jax.random.rademacher(key_action, (3,), jnp.float32))


class Adversary(Memoryless):
    """Steers the boresight into the first zone with all its might, damping only what does not lead there."""

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,) at the edge of the box."""
        return _full(_towards_zone(state) - _aside(state, model), state, model), memory


class SpinUp(Memoryless):
    """Builds up rate for some time about an axis of the body, then steers into the zone."""

    spin_time: jax.Array = struct.field(default_factory=lambda: jnp.float32(3.651484))  # () [T]
    axis_B: jax.Array = struct.field(default_factory=lambda: jnp.array([1.0, 1.0, 1.0]))  # (3,) spun up about

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,)."""
        steer = _full(_towards_zone(state), state, model)
        return jnp.where(state.steps < _steps(self.spin_time, model), self.axis_B, steer), memory


class AnyAdversary(struct.PyTreeNode):
    """One of the adversarial controllers, chosen by a traced number, so that all are compiled once."""

    which: jax.Array  # () int32
    controllers: tuple[Any, ...]

    @classmethod
    def named(cls, name: str) -> "AnyAdversary":
        """Choose by the name in the registry."""
        controllers = tuple(registry.load_controller(one).controller for one in registry.ADVERSARIAL)
        return cls(jnp.int32(registry.ADVERSARIAL.index(name)), controllers)

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> list[Any]:
        """Prepare all."""
        return [one.begin(state, model, key) for one in self.controllers]

    def decide(self, state: EnvState, model: Model, memory: list[Any]) -> tuple[jax.Array, list[Any]]:
        """Ask all, and take the action (3,) of one."""
        decided = [one.decide(state, model, kept) for one, kept in zip(self.controllers, memory, strict=True)]
        return jnp.stack([action for action, _ in decided])[self.which], [kept for _, kept in decided]


def _towards_zone(state: EnvState) -> jax.Array:
    """Body axis (3,) about which a turn brings the boresight to the first zone, of unit length."""
    first = jax.tree.map(lambda leaf: leaf[0], state.scenario.constraints)
    turn_B = rotations.cross(first.boresight_B, pointing_constraints.axis_B(state.body.q_BN, first))
    return turn_B / jnp.maximum(rotations.norm(turn_B), 1e-6)


def _steps(time: jax.Array, model: Model) -> jax.Array:
    """Steps () int32 in a time () [T]."""
    return jnp.round(time * units.of(model).time / model.dt).astype(jnp.int32)


def _aside(state: EnvState, model: Model) -> jax.Array:
    """Part of the rate that does not lead to the zone, (3,) beside the unit vector that does."""
    towards_B = _towards_zone(state)
    omega_B = state.body.omega_BN_B
    return _ASIDE * units.of(model).time * (omega_B - rotations.dot(omega_B, towards_B) * towards_B)


def _full(acceleration_B: jax.Array, state: EnvState, model: Model) -> jax.Array:
    """Largest action (3,) within the box that accelerates along a body axis (3,)."""
    limits = torque_limits(state, model)
    shares = dynamics.matvec(model.inertia_B, acceleration_B) / (units.of(model).inertia * limits.box_B / limits.scale)
    return shares / jnp.maximum(jnp.max(jnp.abs(shares)), 1e-9)
