"""The control-barrier-function filter for held torques: the nearest torque that keeps a barrier of every cone.

See ``barrier`` for what a cone asks of a torque, ``allowed_set`` for the bounds in that, and ``nearest_torque`` for the
programme.  A limit of the energy goes with them: a fast body has no authority against a cone.  Where the programme has
no solution, the corner of the torque box that passes the limits of the cones least is applied, or a braking torque.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.filters import ZohCbfConfig
from koz_jax.control.filters import allowed_set, barrier, nearest_torque
from koz_jax.control.filters.allowed_set import Limits
from koz_jax.control.filters.barrier import Look, Motion
from koz_jax.control.filters.nearest_torque import Ellipsoid, Halfspaces
from koz_jax.errors import SettingsError
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import Allowed, EnvState, Model, nominal_rate, torque_limits

# Share of an energy that rounding may add.
_ROUNDING = 1e-5


class ZohCbf(struct.PyTreeNode):
    """A filter made for one spacecraft; traced."""

    limits: Limits

    def covers(self, at: EnvState, model: Model) -> jax.Array:
        """Whether the state is in the allowed set of every cone.  Returns () bool."""
        constraints, motions = at.scenario.constraints, _motions(at, model)
        bounds = jax.vmap(self.limits.of)(constraints.half_angle)
        highest = jnp.maximum(motions.kappa, jax.vmap(barrier.value)(motions, bounds))
        kept = highest <= -jax.vmap(lambda one: one.delta(model.dt))(bounds)
        is_slow = _energy(at, model) <= (1.0 + _ROUNDING) * self._largest_energy(constraints)
        return jnp.all(kept | ~constraints.is_present) & is_slow

    def allow(self, measured: EnvState, action: jax.Array, model: Model) -> Allowed:
        """Action (3,) in [-1, 1] that is let through in place of the requested one (3,) in [-1, 1]."""
        box_B = torque_limits(measured, model).box_B
        cones, energy = self._cones(measured, model), self._energy_limit(measured, box_B, model)
        found = nearest_torque.nearest(box_B * action, box_B, cones, energy)
        torque_B = jnp.where(found.exists, found.torque_B, _least_bad(measured, box_B, cones, energy))
        same = jnp.all(jnp.abs(torque_B - box_B * action) <= nearest_torque.TOLERANCE * box_B)
        return Allowed(jnp.where(same, action, torque_B / box_B), found.exists)

    def _cones(self, measured: EnvState, model: Model) -> Halfspaces:
        """What the cones ask of the torque."""
        constraints = measured.scenario.constraints
        at = _motions(measured, model)
        bounds = jax.vmap(self.limits.of)(constraints.half_angle)
        largest = jax.vmap(barrier.largest_second_derivative, in_axes=(0, 0, None))(at, bounds, model.dt)
        size = jax.vmap(rotations.norm)(at.row)
        # Where the boresight is in line with the axis no torque moves kappa.
        counts = constraints.is_present & (size * jnp.trace(model.inertia_B) > 1e-6)
        divisor = jnp.where(counts, size, 1.0)
        return Halfspaces(
            normals=jnp.where(counts[:, None], at.row / divisor[:, None], 0.0),
            limits=jnp.where(counts, (largest - at.free) / divisor, 1e3 * torque_limits(measured, model).largest),
        )

    def _largest_energy(self, constraints: PointingConstraint) -> jax.Array:
        """Largest w . I w beside these cones.  Returns () [J]."""
        each = jax.vmap(self.limits.energy)(constraints.half_angle)
        return jnp.min(jnp.where(constraints.is_present, each, self.limits.energies[0]))

    def _energy_limit(self, measured: EnvState, box_B: jax.Array, model: Model) -> Ellipsoid:
        """Torques after which w . I w is within its limit, or falls half as fast as braking makes it.

        It grows by 2 T u . w + T^2 u . I^-1 (u - w x I w), but for the third power of T.
        """
        omega_B, dt = measured.body.omega_BN_B, model.dt
        inverse_B = dynamics.inverse(model.inertia_B)
        now = _energy(measured, model)
        braked = now - 0.5 * dt * jnp.min(box_B) * rotations.norm(omega_B)
        gyroscopic_B = dynamics.matvec(inverse_B, dynamics.gyroscopic_torque(omega_B, model.inertia_B))
        largest = self._largest_energy(measured.scenario.constraints)
        return Ellipsoid(
            form=dt**2 * inverse_B,
            slope=2.0 * dt * omega_B - dt**2 * gyroscopic_B,
            room=jnp.maximum(largest, braked) - now,
        )


def _motions(state: EnvState, model: Model) -> Motion:
    """How kappa of every cone goes on.  Returns leaves (constraints, ...)."""
    constraints, body = state.scenario.constraints, state.body
    inverse_B = dynamics.inverse(model.inertia_B)
    rates_N = jnp.zeros_like(constraints.axis_N) if constraints.axis_rate_N is None else constraints.axis_rate_N

    def of_one(one: PointingConstraint, rate_N: jax.Array) -> Motion:
        rate_B = rotations.rotate(rotations.conjugate(body.q_BN), rate_N)
        look = Look(one.boresight_B, pointing_constraints.axis_B(body.q_BN, one), rate_B, body.omega_BN_B)
        return barrier.motion(look, one.half_angle, model.inertia_B, inverse_B)

    return jax.vmap(of_one)(constraints, rates_N)


def _energy(state: EnvState, model: Model) -> jax.Array:
    """w . I w, twice the kinetic energy.  Returns () [J]."""
    omega_B = state.body.omega_BN_B
    return rotations.dot(omega_B, dynamics.matvec(model.inertia_B, omega_B))


def _least_bad(measured: EnvState, box_B: jax.Array, cones: Halfspaces, energy: Ellipsoid) -> jax.Array:
    """The corner of the box, or a torque that brakes, with the smallest excess over a cone's limit.  Returns (3,)."""
    omega_B = measured.body.omega_BN_B
    rate = rotations.norm(omega_B)
    brake_B = -0.5 * jnp.min(box_B) * omega_B / jnp.where(rate > 0.0, rate, 1.0)
    signs = jnp.stack(jnp.meshgrid(*[jnp.array([-1.0, 1.0])] * 3), axis=-1).reshape(8, 3)
    tried_B = jnp.concatenate([brake_B[None], signs * box_B[None]])
    passed = jnp.max(tried_B @ cones.normals.T - cones.limits[None], axis=1)
    # The limit of the energy holds for all of them; braking, the first, always keeps it.
    too_fast = (jax.vmap(energy.excess)(tried_B) > 0.0).at[0].set(False)
    return tried_B[jnp.argmin(jnp.where(too_fast, jnp.inf, passed))]


def from_config(config: ZohCbfConfig, model: Model) -> ZohCbf:
    """Make a filter for a spacecraft: look for its bounds in the states that it may be in.

    Raises:
        SettingsError: its actuators do not have their torque box at all times.

    """
    if model.actuators.brake_torque is None:
        raise SettingsError(
            "zoh_cbf: must have all of a torque box at its disposal, and control moment gyros do not in a singular"
            " arrangement; allowed are a torque_limit or wheels"
        )
    rate = config.max_rate / units.of(model).time
    of_spacecraft = nominal_rate(model)
    if of_spacecraft is not None:
        rate = jnp.minimum(rate, of_spacecraft)
    allowed = allowed_set.Allowed(
        # No rate is larger than that with which the axis of the smallest moment takes all of the energy.
        energy=jnp.linalg.eigvalsh(model.inertia_B)[0] * rate**2,
        disturbance=jnp.float32(config.disturbance_torque),
        cone_rate=jnp.deg2rad(jnp.float32(config.cone_rate_deg)),
    )
    return ZohCbf(allowed_set.find(allowed, config.samples, config.seed, model))
