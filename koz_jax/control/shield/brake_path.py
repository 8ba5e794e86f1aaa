"""How far a brake maneuver keeps from all zones, bounded from below with a few samples of torque-free motion.

Braking against the angular momentum H with a torque of constant norm k follows exactly the path of torque-free motion,
and only |H| / (2 k) seconds of it (``docs/shield.md``).  Symbols: a, c smallest and largest principal moment of the
inertia I, w body rate, b boresight, n axis of a zone, theta = angle(b, n).
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import Model


class Brake(struct.PyTreeNode):
    """A brake, and bounds on what it does not know; traced but for the number of samples."""

    torque: jax.Array  # () [N m] norm of the torque that brakes whatever disturbs, k
    inertia_error: jax.Array  # () largest relative error of the inertia
    disturbance: jax.Array  # () [N m] largest torque from outside
    rate_error: jax.Array  # () [rad/s] largest error of a measured rate
    cone_rate: jax.Array  # () [rad/s] largest rate of a cone's axis
    approach: jax.Array  # () [rad/s] with which all of these may bring a zone closer while the craft is held at rest
    soon: jax.Array  # () [s] in which it is led away, during which this is counted alike whatever is decided
    later: jax.Array  # () [rad/s] the same after that time
    smallest_moment: jax.Array  # () [kg m^2] of inertia, a
    largest_moment: jax.Array  # () [kg m^2] c
    samples: int = struct.field(pytree_node=False)  # of a brake path

    def without_errors(self, meant: jax.Array) -> "Brake":
        """The brake as it is meant, where that is asked for: of no other inertia, undisturbed, with zones that come
        closer as long as it is led away from them.  meant: () bool.
        """
        return self.replace(
            inertia_error=jnp.where(meant, 0.0, self.inertia_error),
            disturbance=jnp.where(meant, 0.0, self.disturbance),
            later=jnp.where(meant, 0.0, self.later),
        )


class Situation(struct.PyTreeNode):
    """The constraints, with what of each depends on the spacecraft."""

    constraints: PointingConstraint  # stacked along a leading axis
    speed: jax.Array  # (constraints,) [1/(kg m^2)] largest speed of the boresight per angular momentum


class _Motion(struct.PyTreeNode):
    """Bounds that hold along a whole path of torque-free motion."""

    momentum: jax.Array  # () [N m s] |H|
    rate: jax.Array  # () [rad/s] largest |w|
    speed: jax.Array  # (constraints,) [rad/s] largest speed of each boresight
    bend: jax.Array  # (constraints,) [rad/s^2] largest second derivative of each boresight


class _Tolerance(struct.PyTreeNode):
    """How far the true path may be from the computed one."""

    at_rest: jax.Array  # () [rad] at its end, of what grows with the square of the time
    gyroscopic: jax.Array  # () [rad] at its end, of a wrong inertia's gyroscopic torque
    drift: jax.Array  # () [rad/s] per second of free motion
    integration: jax.Array  # () [rad]
    soon: jax.Array  # () [rad] that zones come closer in some time, which is the same whatever is decided
    swept: jax.Array  # () [rad] that they come closer in the rest of the brake's time

    def after(self, share: jax.Array, seconds: jax.Array) -> jax.Array:
        """Tolerance [rad] after a share () of the path, that is after so many seconds () of free motion."""
        time = 1.0 - jnp.sqrt(jnp.maximum(1.0 - share, 0.0))  # of the brake, as a share
        return (
            self.at_rest * time**2
            + self.gyroscopic * (2.0 * time**2 - time**4)
            + self.drift * seconds
            + self.integration
            + self.soon
            + self.swept * time
        )


class _Coast(struct.PyTreeNode):
    """Vectors in body axes that are fixed in inertial ones: the momentum first, then every zone's axis.

    Component by component, which is how processors like small vectors of large batches.  Leaves (1 + zones,).
    """

    x: jax.Array
    y: jax.Array
    z: jax.Array


class _Walk(struct.PyTreeNode):
    """Along a brake path."""

    at: _Coast
    done: jax.Array  # () int32 pieces
    lowest: jax.Array  # () [rad] clearance so far


def situation(constraints: PointingConstraint, model: Model) -> Situation:
    """Prepare for the questions below."""
    inverse_B = dynamics.inverse(model.inertia_B)
    return Situation(constraints, jax.vmap(_speed_per_momentum, in_axes=(0, None))(constraints.boresight_B, inverse_B))


def torque(brake: Brake, body: RigidBodyState, model: Model) -> jax.Array:
    """Torque against the angular momentum as it stands in the middle of the step.  Returns (3,) [N m].

    All that there is: what a disturbance may take of it is only not counted on.
    """
    momentum_B = dynamics.matvec(model.inertia_B, body.omega_BN_B)
    # What is fixed in inertial axes turns in body axes by v' = v x w.
    middle_B = momentum_B + 0.5 * model.dt * rotations.cross(momentum_B, body.omega_BN_B)
    size = rotations.norm(middle_B)
    strength = jnp.minimum(brake.torque + brake.disturbance, rotations.norm(momentum_B) / model.dt)
    return -strength * middle_B / jnp.where(size > 0.0, size, 1.0)


def clearance(
    brake: Brake,
    body: RigidBodyState,
    push_error: jax.Array,
    at: Situation,
    model: Model,
    enough: jax.Array,
    least: jax.Array,
) -> jax.Array:
    """Lower bound of the margin to all zones on the brake path from here.  Returns () [rad].

    Args:
        brake: the brake.
        body: where the path begins.
        push_error: () [rad/s] error of its rate beyond what ``approach`` counts, see ``push_error``.
        at: the zones.
        model: the spacecraft.
        enough: () [rad] a bound that is at least this need not be the best.
        least: () [rad] where the bound is found to be below this, it is returned as it stands.
    """
    momentum_B = dynamics.matvec(model.inertia_B, body.omega_BN_B)
    motion = _motion(brake, body, momentum_B, at)
    length = _free_seconds(brake, motion.momentum, model.dt)
    piece = length / brake.samples
    tolerance = _tolerance(brake, motion, length, push_error, model.dt)
    reach = motion.speed * length + tolerance.after(jnp.float32(1.0), length)
    straight = pointing_constraints.margins(body.q_BN, at.constraints) - reach
    at_once = jnp.min(jnp.where(at.constraints.is_present, straight, jnp.inf))

    is_enough = at_once >= enough
    begin = _Walk(_start(body, momentum_B, at), jnp.where(is_enough, brake.samples, 0), at_once)
    # Between samples the cosine of theta rises above the chord by at most its second derivative times piece^2 / 8.
    bulge = motion.bend * piece**2 / 8.0
    inverse_B = dynamics.inverse(model.inertia_B)

    def lower(walk: _Walk) -> _Walk:
        cosines = _cosines(walk.at, at.constraints.boresight_B) + bulge
        margin = _margin(cosines, at.constraints) - tolerance.after(walk.done / brake.samples, walk.done * piece)
        return walk.replace(lowest=jnp.minimum(walk.lowest, margin))

    def advance(walk: _Walk) -> _Walk:
        return lower(walk.replace(at=_coast(walk.at, inverse_B, piece), done=walk.done + 1))

    def go_on(walk: _Walk) -> jax.Array:
        return (walk.done < brake.samples) & (walk.lowest >= least)

    seen = lower(begin.replace(lowest=jnp.inf)).lowest
    first = begin.replace(lowest=jnp.where(is_enough, at_once, seen))
    return jax.lax.while_loop(go_on, advance, first).lowest


def _start(body: RigidBodyState, momentum_B: jax.Array, at: Situation) -> _Coast:
    axes_B = jax.vmap(pointing_constraints.axis_B, in_axes=(None, 0))(body.q_BN, at.constraints)
    return _Coast(*jnp.concatenate([momentum_B[None], axes_B]).T)


def step_clearance(
    brake: Brake, before: RigidBodyState, after: RigidBodyState, torque_B: jax.Array, at: Situation, model: Model
) -> jax.Array:
    """Lower bound of the margin to all zones during a step with a held torque (3,) [N m].  Returns () [rad]."""
    size = rotations.norm(torque_B) + brake.disturbance
    momenta = [dynamics.matvec(model.inertia_B, body.omega_BN_B) for body in (before, after)]
    energies = [
        rotations.dot(body.omega_BN_B, momentum_B) for body, momentum_B in zip((before, after), momenta, strict=True)
    ]
    # sqrt(2 E) changes by at most size / sqrt(a) per second, |H| by at most size.
    rate = jnp.sqrt(jnp.maximum(jnp.maximum(*energies), 0.0) / brake.smallest_moment)
    rate = rate + size * model.dt / (2.0 * brake.smallest_moment)
    momentum = jnp.maximum(*map(rotations.norm, momenta)) + 0.5 * size * model.dt
    bend = _bend(at.speed, momentum, rate) + at.speed * size

    def cosines(body: RigidBodyState) -> jax.Array:
        looks_N = jax.vmap(pointing_constraints.boresight_N, in_axes=(None, 0))(body.q_BN, at.constraints)
        return jax.vmap(rotations.dot)(at.constraints.axis_N, looks_N)

    highest = jnp.maximum(cosines(before), cosines(after)) + bend * model.dt**2 / 8.0
    return _margin(highest, at.constraints) - brake.cone_rate * model.dt


def _speed_per_momentum(boresight_B: jax.Array, inverse_B: jax.Array) -> jax.Array:
    """Largest |w x b| per |I w|: the spectral norm of [b] x I^-1, a matrix of rank two.  Returns () [1/(kg m^2)]."""
    moved = jnp.stack([rotations.cross(boresight_B, column) for column in inverse_B.T], axis=1)
    squared = moved.T @ moved
    trace = jnp.trace(squared)
    minors = 0.5 * (trace**2 - jnp.sum(squared * squared))
    return jnp.sqrt(0.5 * (trace + jnp.sqrt(jnp.maximum(trace**2 - 4.0 * minors, 0.0))))


def _motion(brake: Brake, body: RigidBodyState, momentum_B: jax.Array, at: Situation) -> _Motion:
    momentum = rotations.norm(momentum_B)
    # The energy of torque-free motion is constant, and |w|^2 <= 2 E / a.
    twice_energy = jnp.maximum(rotations.dot(body.omega_BN_B, momentum_B), 0.0)
    rate = jnp.sqrt(twice_energy / brake.smallest_moment)
    speed = jnp.minimum(at.speed * momentum, rate)
    return _Motion(momentum, rate, speed, _bend(at.speed, momentum, rate))


def _bend(speed_per_momentum: jax.Array, momentum: jax.Array, rate: jax.Array) -> jax.Array:
    """Bound on the second derivative of a boresight in free motion: |dw/dt x b| + |w| |w x b|.  [rad/s^2]."""
    speed = speed_per_momentum * momentum
    return rate * (speed + jnp.minimum(speed, rate))


def _free_seconds(brake: Brake, momentum: jax.Array, dt: jax.Array) -> jax.Array:
    """Seconds of torque-free motion that the brake runs through: whole steps, the last one with what is left.

    The momentum falls by k dt in each step and by the rest in the last.  Returns () [s].
    """
    whole = brake.torque * dt
    rest = momentum - whole * jnp.floor(momentum / whole)
    integral = (momentum**2 - rest**2) / (2.0 * brake.torque) + 0.5 * rest * dt
    # At rest as in the limit: what is measured as zero need not be, and braking takes a step.
    return jnp.where(momentum > 0.0, integral / jnp.where(momentum > 0.0, momentum, 1.0), 0.5 * dt)


def push_error(brake: Brake, body: RigidBodyState, torque_B: jax.Array, model: Model) -> jax.Array:
    """Error of the rate after a step with a torque (3,) [N m], from a wrong inertia.  Returns () [rad/s]."""
    e, a = brake.inertia_error, brake.smallest_moment
    size = rotations.norm(torque_B)
    twice_energy = rotations.dot(body.omega_BN_B, dynamics.matvec(model.inertia_B, body.omega_BN_B))
    rate = jnp.sqrt(jnp.maximum(twice_energy, 0.0) / a) + (size + brake.disturbance) * model.dt / a
    return (e / (1.0 - e) * size / a + _gyroscopic_error(brake) * rate**2) * model.dt


def _gyroscopic_error(brake: Brake) -> jax.Array:
    """Error of the angular acceleration without a torque, per squared rate.  Returns ()."""
    e, a, c = brake.inertia_error, brake.smallest_moment, brake.largest_moment
    return e * jnp.sqrt(c / a) + e / (1.0 - e) * ((c - a) + e * (c + a)) / (2.0 * a)


def _tolerance(brake: Brake, motion: _Motion, length: jax.Array, pushed: jax.Array, dt: jax.Array) -> _Tolerance:
    trust = brake.inertia_error / (1.0 - brake.inertia_error)
    arc = motion.rate * length
    # Torques act through a wrong inertia, and are held over a step instead of turned with the body.
    astray = trust + (motion.rate * dt) ** 2
    # What a wrong inertia leaves over at the end takes further steps to take out.
    over = trust * motion.rate * dt
    return _Tolerance(
        at_rest=arc * astray * (1.0 + astray) + over + 2.0 * brake.disturbance * length**2 / brake.smallest_moment,
        gyroscopic=_gyroscopic_error(brake) * arc**2,
        drift=2.0 * pushed,
        integration=brake.samples * (motion.rate * length / brake.samples) ** 5 / 120.0,
        soon=brake.approach * brake.soon,
        swept=brake.later * jnp.maximum(motion.momentum / brake.torque - (brake.soon - 2.0 * dt), 0.0),
    )


def _margin(cosines: jax.Array, constraints: PointingConstraint) -> jax.Array:
    """Smallest margin where boresights have these cosines (constraints,) to the zones' axes.  Returns () [rad]."""
    margins = jnp.arccos(jnp.clip(cosines, -1.0, 1.0)) - constraints.half_angle
    return jnp.min(jnp.where(constraints.is_present, margins, jnp.inf))


def _cosines(fixed: _Coast, boresights_B: jax.Array) -> jax.Array:
    """Cosines between boresights and zone axes.  boresights_B: (zones, 3).  Returns (zones,)."""
    b1, b2, b3 = boresights_B.T
    return b1 * fixed.x[1:] + b2 * fixed.y[1:] + b3 * fixed.z[1:]


def _coast(fixed: _Coast, inverse_B: jax.Array, seconds: jax.Array) -> _Coast:
    """Torque-free motion seen from the body, where inertially fixed vectors turn by v' = v x w; one RK4 step."""

    def slope(v: _Coast) -> _Coast:
        w1, w2, w3 = (row[0] * v.x[0] + row[1] * v.y[0] + row[2] * v.z[0] for row in inverse_B)
        return _Coast(v.y * w3 - v.z * w2, v.z * w1 - v.x * w3, v.x * w2 - v.y * w1)

    def ahead(rate: _Coast, h: jax.Array) -> _Coast:
        return jax.tree.map(lambda v, dv: v + h * dv, fixed, rate)

    k1 = slope(fixed)
    k2 = slope(ahead(k1, 0.5 * seconds))
    k3 = slope(ahead(k2, 0.5 * seconds))
    k4 = slope(ahead(k3, seconds))
    return ahead(jax.tree.map(lambda a, b, c, d: (a + 2.0 * (b + c) + d) / 6.0, k1, k2, k3, k4), seconds)
