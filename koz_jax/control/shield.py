"""The shield: lets a torque through only if the spacecraft can still come to rest outside all zones afterwards.

``docs/shield.md`` states and proves what it guarantees.  In short: braking against the angular momentum H with a torque
of constant norm k lets the boresight trace exactly the path of torque-free motion, run through in |H| / (2 k) seconds
of it.  A state is *safe* if that path stays outside all zones, which a few samples and a bound between them decide.
A request passes if it leads to a safe state; otherwise torques that lead around the zone are tried; otherwise the
shield brakes, along a path that was found to be clear.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.shield import ShieldConfig
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model, torque_limits
from koz_jax.task.uncertainty import NOISE_BOUND

_BRAKE = 3  # place of the brake among the candidates: what is left when all others are refused
GUIDE_SECONDS = 0.5  # [s] how fast the guide takes up its rate

# [s] Over which a requested torque is taken to act where the guide asks to which side it pushes.
_LOOK_AHEAD_SECONDS = 1.0

# [1/s] Rate at which the guide leads the boresight away from a zone, per angle that is missing to twice the margin.
_OUTWARD_GAIN = 1.0


class Shield(struct.PyTreeNode):
    """A shield made for one spacecraft; traced but for the number of samples.  See ``from_config``."""

    margin: jax.Array  # () [rad] kept from every zone
    brake_torque: jax.Array  # () [N m] norm of the torque that brakes
    arc_error: jax.Array  # () relative error of a brake path
    rate_error: jax.Array  # () [rad/s] error of the rate with which a brake path begins
    guide_rate: jax.Array  # () [rad/s] with which the boresight is led around a zone
    smallest_moment: jax.Array  # () [kg m^2] of inertia
    largest_moment: jax.Array  # () [kg m^2]
    samples: int = struct.field(pytree_node=False)  # of a brake path

    def start(self, drawn: Scenario, model: Model) -> Scenario:
        """Halve the initial rate until the state is safe.

        The guarantee holds from safe states only.  A start that is not safe even at rest is returned at rest.
        """

        def too_fast(body: RigidBodyState) -> jax.Array:
            moves = rotations.norm(body.omega_BN_B) > 1e-9
            return moves & ~is_safe(self, body, drawn.constraints, model, self.margin)

        def slow_down(body: RigidBodyState) -> RigidBodyState:
            return body.replace(omega_BN_B=0.5 * body.omega_BN_B)

        return drawn.replace(initial=jax.lax.while_loop(too_fast, slow_down, drawn.initial))

    def allow(self, measured: EnvState, action: jax.Array, model: Model) -> jax.Array:
        """Action (3,) in [-1, 1] that is let through in place of the requested one (3,) in [-1, 1]."""
        limits = torque_limits(measured, model)
        torque_B = limits.box_B * action
        allowed_B = self.filter(measured.body, torque_B, measured.scenario.constraints, limits, model)
        # What passes comes back to the last bit, also where the limit is no power of two.
        return jnp.where(jnp.all(allowed_B == torque_B), action, allowed_B / limits.box_B)

    def filter(
        self,
        body: RigidBodyState,
        torque_B: jax.Array,
        constraints: PointingConstraint,
        limits: TorqueLimits,
        model: Model,
    ) -> jax.Array:
        """Return the torque (3,) [N m] that is let through in place of the requested one, within the same box.

        torque_B: (3,) [N m], each component within its limit; constraints: stacked along a leading axis.
        """
        guide_B = _guide_torque(self, body, torque_B, constraints, limits, model)
        candidates_B = jnp.stack([torque_B, 0.5 * (torque_B + guide_B), guide_B, brake_torque(self, body, model)])
        margins = self.margin * jnp.array([1.0, 1.0, 0.5])

        def attempt(choice: _Choice) -> _Choice:
            after = dynamics.step(body, candidates_B[choice.candidate], model.inertia_B, model.dt)
            clear = _step_clearance(self, body, after, constraints, limits, model)
            passed = clear & is_safe(self, after, constraints, model, margins[choice.candidate])
            return _Choice(jnp.where(passed, choice.candidate, choice.candidate + 1), passed)

        # A loop, not a branch: a batch then computes no more than its most critical case needs.
        first = _Choice(jnp.int32(0), jnp.array(False))
        last = jax.lax.while_loop(lambda choice: ~choice.made & (choice.candidate < _BRAKE), attempt, first)
        return candidates_B[last.candidate]


class _Choice(struct.PyTreeNode):
    """Which of the candidates is let through."""

    candidate: jax.Array  # () int32
    made: jax.Array  # () bool


def from_config(config: ShieldConfig, model: Model) -> Shield:
    """Make a shield for a spacecraft, with a margin for the errors that ``config`` has to withstand."""
    errors = config.error_bounds
    moments = jnp.linalg.eigvalsh(model.inertia_B)
    limits = model.actuators.limits(model.actuators.initial_state())
    brake = limits.every_direction - errors.disturbance_torque
    # Of the torque in a step, this much may push elsewhere than the model says.
    astray = limits.largest * errors.inertia_error + errors.disturbance_torque
    attitude_noise, rate_noise = (
        NOISE_BOUND * jnp.sqrt(3.0) * jnp.deg2rad(deviation)
        for deviation in (errors.attitude_noise_deg, errors.rate_noise_deg)
    )
    return Shield(
        margin=jnp.deg2rad(jnp.float32(config.margin_deg)) + 2.0 * attitude_noise,
        brake_torque=brake,
        arc_error=2.0 * errors.inertia_error / (1.0 - errors.inertia_error) + errors.disturbance_torque / brake,
        rate_error=rate_noise + astray * model.dt / moments[0],
        guide_rate=jnp.deg2rad(jnp.float32(config.guide_rate_deg)),
        smallest_moment=moments[0],
        largest_moment=moments[2],
        samples=config.samples,
    )


def brake_torque(shield: Shield, body: RigidBodyState, model: Model) -> jax.Array:
    """Torque against the angular momentum as it stands in the middle of the step.  Returns (3,) [N m]."""
    momentum_B = dynamics.matvec(model.inertia_B, body.omega_BN_B)
    # What is fixed in inertial axes turns in body axes by v' = v x w.
    middle_B = momentum_B + 0.5 * model.dt * rotations.cross(momentum_B, body.omega_BN_B)
    size = rotations.norm(middle_B)
    strength = jnp.minimum(shield.brake_torque, size / model.dt)
    return -strength * middle_B / jnp.where(size > 0.0, size, 1.0)


def is_safe(
    shield: Shield, body: RigidBodyState, constraints: PointingConstraint, model: Model, margin: jax.Array
) -> jax.Array:
    """Whether braking from here keeps the boresights ``margin`` () [rad] from all zones.  Returns () bool."""
    momentum_B = dynamics.matvec(model.inertia_B, body.omega_BN_B)
    momentum = rotations.norm(momentum_B)
    fastest = momentum / shield.smallest_moment
    error = shield.arc_error + (fastest * model.dt) ** 2
    # Torque-free seconds of the brake path, and of one piece of it.
    length = (1.0 + error) * momentum / (2.0 * shield.brake_torque)
    piece = length / shield.samples
    axes_B = jax.vmap(pointing_constraints.axis_B, in_axes=(None, 0))(body.q_BN, constraints)
    start = _Coast(*jnp.concatenate([momentum_B[None], axes_B]).T)
    half_angle, boresights_B = constraints.half_angle, constraints.boresight_B
    limits = _Limits(jnp.cos(half_angle), jnp.sin(half_angle), ~constraints.is_present)

    # Not even a straight path towards a zone would reach it.
    drift = fastest * error + 2.0 * shield.rate_error
    straight = fastest * length + 2.0 * shield.rate_error * length
    at_once = jnp.all(limits.allow(_cosines(start, boresights_B), margin + straight))

    # Between samples the cosine rises above the chord by at most its second derivative times piece^2 / 8.
    bulge = (1.0 + _spread(shield)) * (fastest * piece) ** 2 / 8.0
    integration = shield.samples * (fastest * piece) ** 5 / 120.0
    inverse_B = dynamics.inverse(model.inertia_B)

    def clear_so_far(walk: _Walk) -> jax.Array:
        tolerance = margin + drift * walk.done * piece + integration
        return jnp.all(limits.allow(_cosines(walk.at, boresights_B) + bulge, tolerance))

    def go_on(walk: _Walk) -> jax.Array:
        return walk.clear & (walk.done < shield.samples)

    def advance(walk: _Walk) -> _Walk:
        after = walk.replace(at=_coast(walk.at, inverse_B, piece), done=walk.done + 1)
        return after.replace(clear=clear_so_far(after))

    begin = _Walk(at=start, done=jnp.where(at_once, shield.samples, 0), clear=jnp.array(True))
    begin = begin.replace(clear=at_once | clear_so_far(begin))
    return jax.lax.while_loop(go_on, advance, begin).clear


class _Coast(struct.PyTreeNode):
    """Vectors in body axes that are fixed in inertial ones: the momentum first, then every zone's axis.

    Component by component, which is how processors like small vectors of large batches.  Leaves (1 + zones,).
    """

    x: jax.Array
    y: jax.Array
    z: jax.Array


class _Limits(struct.PyTreeNode):
    """Zones as limits on the cosine between boresight and axis.  Leaves (zones,)."""

    cosine: jax.Array  # of the half angle
    sine: jax.Array
    absent: jax.Array  # bool

    def allow(self, cosines: jax.Array, tolerance: jax.Array) -> jax.Array:
        """Whether cosines (zones,) keep at least ``tolerance`` () [rad] from the edges.  Returns (zones,) bool.

        Uses a lower bound of cos(half angle + tolerance) that needs no cosine.
        """
        shrunk = jnp.where(self.cosine > 0.0, self.cosine * (1.0 - 0.5 * tolerance**2), self.cosine)
        return (cosines <= shrunk - self.sine * tolerance) | self.absent


class _Walk(struct.PyTreeNode):
    """Along a brake path."""

    at: _Coast
    done: jax.Array  # () int32 pieces
    clear: jax.Array  # () bool, of all zones so far


def _spread(shield: Shield) -> jax.Array:
    """Bound on |dw/dt| / |w|^2 of torque-free motion.  Returns ()."""
    return (shield.largest_moment - shield.smallest_moment) / (2.0 * shield.smallest_moment)


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


def _cosines(fixed: _Coast, boresights_B: jax.Array) -> jax.Array:
    """Cosines between boresights and zone axes.  boresights_B: (zones, 3).  Returns (zones,)."""
    b1, b2, b3 = boresights_B.T
    return b1 * fixed.x[1:] + b2 * fixed.y[1:] + b3 * fixed.z[1:]


def _step_clearance(
    shield: Shield,
    before: RigidBodyState,
    after: RigidBodyState,
    constraints: PointingConstraint,
    limits: TorqueLimits,
    model: Model,
) -> jax.Array:
    """Whether the boresights stay outside all zones during the step itself.  Returns () bool."""
    push = limits.largest / shield.smallest_moment
    fastest = jnp.maximum(rotations.norm(before.omega_BN_B), rotations.norm(after.omega_BN_B)) + push * model.dt
    bulge = ((1.0 + _spread(shield)) * fastest**2 + push) * model.dt**2 / 8.0
    allowed = jnp.cos(jnp.minimum(constraints.half_angle, jnp.pi))

    def cosines(body: RigidBodyState) -> jax.Array:
        looks_N = jax.vmap(pointing_constraints.boresight_N, in_axes=(None, 0))(body.q_BN, constraints)
        return jax.vmap(rotations.dot)(constraints.axis_N, looks_N)

    highest = jnp.maximum(cosines(before), cosines(after))
    return jnp.all((highest + bulge <= allowed) | ~constraints.is_present)


def _guide_torque(
    shield: Shield,
    body: RigidBodyState,
    torque_B: jax.Array,
    constraints: PointingConstraint,
    limits: TorqueLimits,
    model: Model,
) -> jax.Array:
    """Torque that leads the boresight around the nearest zone, to the side that it moves or is pushed to already.

    Returns (3,) [N m] within the box.
    """
    margins = pointing_constraints.margins(body.q_BN, constraints)
    nearest = jax.tree.map(lambda leaf: leaf[jnp.argmin(margins)], constraints)
    look_B = nearest.boresight_B
    axis_B = pointing_constraints.axis_B(body.q_BN, nearest)
    inward_B = axis_B - rotations.dot(axis_B, look_B) * look_B
    size = rotations.norm(inward_B)
    inward_B = inward_B / jnp.where(size > 0.0, size, 1.0)
    aside_B = rotations.cross(inward_B, look_B)
    inertia_B, inverse_B = model.inertia_B, dynamics.inverse(model.inertia_B)
    pushed_B = dynamics.angular_acceleration(body.omega_BN_B, torque_B, inertia_B, inverse_B)
    soon_B = body.omega_BN_B + _LOOK_AHEAD_SECONDS * pushed_B
    drift = rotations.dot(aside_B, rotations.cross(soon_B, look_B))
    sideways = jnp.where(drift >= 0.0, shield.guide_rate, -shield.guide_rate)
    missing = 2.0 * shield.margin - jnp.min(margins)
    outward = jnp.clip(_OUTWARD_GAIN * missing, -shield.guide_rate, shield.guide_rate)
    wanted_B = rotations.cross(look_B, sideways * aside_B - outward * inward_B)
    change_B = (wanted_B - body.omega_BN_B) / GUIDE_SECONDS
    guide_B = dynamics.matvec(inertia_B, change_B) + dynamics.gyroscopic_torque(body.omega_BN_B, inertia_B)
    return guide_B / jnp.maximum(1.0, jnp.max(jnp.abs(guide_B) / limits.box_B))


def under_shield(env: Reorientation, config: ShieldConfig | None) -> Reorientation:
    """Put a shield between controllers and actuators of an environment; None leaves it as it is."""
    return env if config is None else env.replace(action_filter=from_config(config, env.model))
