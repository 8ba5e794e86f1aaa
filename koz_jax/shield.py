"""The shield: lets a torque through only if the spacecraft can still come to rest outside all zones afterwards.

``docs/shield.md`` states and proves what it guarantees.  In short: braking against the angular momentum H with a torque
of constant norm k lets the boresight trace exactly the path of torque-free motion, run through in |H| / (2 k) seconds
of it.  A state is *safe* if that path stays outside all zones, which a few samples and a bound between them decide.
A request passes if it leads to a safe state; otherwise torques that lead around the zone are tried; otherwise the
shield brakes, along a path that was found to be clear.
"""

import functools

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax import dynamics, env, keep_out, rotations
from koz_jax.dynamics import RigidBodyState, Spacecraft
from koz_jax.env import EnvParams, EnvState
from koz_jax.keep_out import KeepOutZone
from koz_jax.scenario import Scenario
from koz_jax.shield_config import ShieldConfig
from koz_jax.uncertainty import NOISE_BOUND


class Shield(struct.PyTreeNode):
    """A shield made for one spacecraft; traced but for the number of samples.  See ``for_spacecraft``."""

    margin: jax.Array  # () [rad] kept from every zone
    brake_torque: jax.Array  # () [N m] norm of the torque that brakes
    arc_error: jax.Array  # () relative error of a brake path
    rate_error: jax.Array  # () [rad/s] error of the rate with which a brake path begins
    guide_rate: jax.Array  # () [rad/s] with which the boresight is led around a zone
    smallest_moment: jax.Array  # () [kg m^2] of inertia
    largest_moment: jax.Array  # () [kg m^2]
    samples: int = struct.field(pytree_node=False)  # of a brake path

    def filter(self, body: RigidBodyState, torque_B: jax.Array, zones: KeepOutZone, params: EnvParams) -> jax.Array:
        """Return the torque (3,) [N m] that is let through in place of the requested one, within the same box.

        torque_B: (3,) [N m], each component within the torque limit; zones: stacked along a leading axis.
        """
        guide_B = _guide_torque(self, body, torque_B, zones, params)
        candidates_B = jnp.stack([torque_B, 0.5 * (torque_B + guide_B), guide_B, brake_torque(self, body, params)])
        margins = self.margin * jnp.array([1.0, 1.0, 0.5])

        def attempt(choice: _Choice) -> _Choice:
            after = env.push(body, candidates_B[choice.candidate], params, params.dt)
            clear = _step_clearance(self, body, after, zones, params)
            passed = clear & is_safe(self, after, zones, params, margins[choice.candidate])
            return _Choice(jnp.where(passed, choice.candidate, choice.candidate + 1), passed)

        # A loop, not a branch: a batch then computes no more than its most critical case needs.
        first = _Choice(jnp.int32(0), jnp.array(False))
        last = jax.lax.while_loop(lambda choice: ~choice.made & (choice.candidate < _BRAKE), attempt, first)
        return candidates_B[last.candidate]


def guard(shield: Shield | None, state: EnvState, action: jax.Array, params: EnvParams) -> jax.Array:
    """What of an action (3,) reaches the actuators: clipped to [-1, 1], and changed where a shield says so."""
    requested = jnp.clip(action, -1.0, 1.0)
    if shield is None:
        return requested
    limit = params.spacecraft.torque_limit
    torque_B = limit * requested
    allowed_B = shield.filter(state.body, torque_B, state.scenario.zones, params)
    # What passes comes back to the last bit, also where the limit is no power of two.
    return jnp.where(jnp.all(allowed_B == torque_B), requested, allowed_B / limit)


class _Choice(struct.PyTreeNode):
    """Which of the candidates is let through."""

    candidate: jax.Array  # () int32
    made: jax.Array  # () bool


# Place of the brake among the candidates: what is left when all others are refused.
_BRAKE = 3


def for_spacecraft(config: ShieldConfig, spacecraft: Spacecraft, dt: jax.Array) -> Shield:
    """Make a shield with a margin for the errors that ``config`` withstands."""
    errors = config.withstands
    moments = jnp.linalg.eigvalsh(spacecraft.inertia_B)
    limit = spacecraft.torque_limit
    brake = limit - errors.disturbance_torque
    # Of the torque in a step, this much may push elsewhere than the model says.
    astray = jnp.sqrt(3.0) * limit * errors.inertia_error + errors.disturbance_torque
    attitude_noise, rate_noise = (
        NOISE_BOUND * jnp.sqrt(3.0) * jnp.deg2rad(deviation)
        for deviation in (errors.attitude_noise_deg, errors.rate_noise_deg)
    )
    return Shield(
        margin=jnp.deg2rad(jnp.float32(config.margin_deg)) + 2.0 * attitude_noise,
        brake_torque=brake,
        arc_error=2.0 * errors.inertia_error / (1.0 - errors.inertia_error) + errors.disturbance_torque / brake,
        rate_error=rate_noise + astray * dt / moments[0],
        guide_rate=jnp.deg2rad(jnp.float32(config.guide_rate_deg)),
        smallest_moment=moments[0],
        largest_moment=moments[2],
        samples=config.samples,
    )


def safe_start(shield: Shield | None, scenario: Scenario, params: EnvParams) -> Scenario:
    """Halve the initial rate until the state is safe; without a shield the scenario stays as it is.

    The guarantee holds from safe states only.  A start that is not safe even at rest is returned at rest.
    """
    if shield is None:
        return scenario

    def too_fast(body: RigidBodyState) -> jax.Array:
        moves = rotations.norm(body.omega_BN_B) > 1e-9
        return moves & ~is_safe(shield, body, scenario.zones, params, shield.margin)

    slowed = jax.lax.while_loop(too_fast, lambda body: body.replace(omega_BN_B=0.5 * body.omega_BN_B), scenario.initial)
    return scenario.replace(initial=slowed)


def brake_torque(shield: Shield, body: RigidBodyState, params: EnvParams) -> jax.Array:
    """Torque against the angular momentum as it stands in the middle of the step.  Returns (3,) [N m]."""
    momentum_B = dynamics.matvec(params.spacecraft.inertia_B, body.omega_BN_B)
    # What is fixed in inertial axes turns in body axes by v' = v x w.
    middle_B = momentum_B + 0.5 * params.dt * rotations.cross(momentum_B, body.omega_BN_B)
    size = rotations.norm(middle_B)
    strength = jnp.minimum(shield.brake_torque, size / params.dt)
    return -strength * middle_B / jnp.where(size > 0.0, size, 1.0)


def is_safe(
    shield: Shield, body: RigidBodyState, zones: KeepOutZone, params: EnvParams, margin: jax.Array
) -> jax.Array:
    """Whether braking from here keeps the boresight ``margin`` () [rad] from all zones.  Returns () bool."""
    momentum_B = dynamics.matvec(params.spacecraft.inertia_B, body.omega_BN_B)
    momentum = rotations.norm(momentum_B)
    fastest = momentum / shield.smallest_moment
    error = shield.arc_error + (fastest * params.dt) ** 2
    # Torque-free seconds of the brake path, and of one piece of it.
    length = (1.0 + error) * momentum / (2.0 * shield.brake_torque)
    piece = length / shield.samples
    to_body = rotations.conjugate(body.q_BN)
    axes_B = jax.vmap(functools.partial(rotations.rotate, to_body))(zones.axis_N)
    start = _Coast(*jnp.concatenate([momentum_B[None], axes_B]).T)
    limits = _Limits(jnp.cos(zones.half_angle), jnp.sin(zones.half_angle), zones.half_angle <= 0.0)

    # Not even a straight path towards a zone would reach it.
    drift = fastest * error + 2.0 * shield.rate_error
    straight = fastest * length + 2.0 * shield.rate_error * length
    at_once = jnp.all(limits.allow(_cosines(start, params), margin + straight))

    # Between samples the cosine rises above the chord by at most its second derivative times piece^2 / 8.
    bulge = (1.0 + _spread(shield)) * (fastest * piece) ** 2 / 8.0
    integration = shield.samples * (fastest * piece) ** 5 / 120.0
    inverse_B = dynamics.inverse(params.spacecraft.inertia_B)

    def clear_so_far(walk: _Walk) -> jax.Array:
        tolerance = margin + drift * walk.done * piece + integration
        return jnp.all(limits.allow(_cosines(walk.at, params) + bulge, tolerance))

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


def _cosines(fixed: _Coast, params: EnvParams) -> jax.Array:
    """Cosines between boresight and zone axes.  Returns (zones,)."""
    b1, b2, b3 = params.spacecraft.boresight_B
    return b1 * fixed.x[1:] + b2 * fixed.y[1:] + b3 * fixed.z[1:]


def _step_clearance(
    shield: Shield, before: RigidBodyState, after: RigidBodyState, zones: KeepOutZone, params: EnvParams
) -> jax.Array:
    """Whether the boresight stays outside all zones during the step itself.  Returns () bool."""
    spacecraft = params.spacecraft
    fastest = jnp.maximum(rotations.norm(before.omega_BN_B), rotations.norm(after.omega_BN_B))
    push = jnp.sqrt(3.0) * spacecraft.torque_limit / shield.smallest_moment
    fastest = fastest + push * params.dt
    bulge = ((1.0 + _spread(shield)) * fastest**2 + push) * params.dt**2 / 8.0
    allowed = jnp.cos(jnp.minimum(zones.half_angle, jnp.pi))

    def cosines(body: RigidBodyState) -> jax.Array:
        look_N = env.boresight_N(body, spacecraft)
        return jax.vmap(rotations.dot, in_axes=(0, None))(zones.axis_N, look_N)

    highest = jnp.maximum(cosines(before), cosines(after))
    return jnp.all((highest + bulge <= allowed) | (zones.half_angle <= 0.0))


def _guide_torque(
    shield: Shield, body: RigidBodyState, torque_B: jax.Array, zones: KeepOutZone, params: EnvParams
) -> jax.Array:
    """Torque that leads the boresight around the nearest zone, to the side that it moves or is pushed to already.

    Returns (3,) [N m] within the box.
    """
    spacecraft = params.spacecraft
    look_N = env.boresight_N(body, spacecraft)
    margins = jax.vmap(keep_out.margin, in_axes=(None, 0))(look_N, zones)
    nearest = jnp.argmin(margins)
    look_B = spacecraft.boresight_B
    axis_B = rotations.rotate(rotations.conjugate(body.q_BN), zones.axis_N[nearest])
    inward_B = axis_B - rotations.dot(axis_B, look_B) * look_B
    size = rotations.norm(inward_B)
    inward_B = inward_B / jnp.where(size > 0.0, size, 1.0)
    aside_B = rotations.cross(inward_B, look_B)
    gyroscopic_B = dynamics.gyroscopic_torque(body.omega_BN_B, spacecraft.inertia_B)
    inverse_B = dynamics.inverse(spacecraft.inertia_B)
    pushed_B = dynamics.angular_acceleration(body.omega_BN_B, torque_B, spacecraft.inertia_B, inverse_B)
    drift = rotations.dot(aside_B, rotations.cross(body.omega_BN_B + pushed_B, look_B))
    sideways = jnp.where(drift >= 0.0, shield.guide_rate, -shield.guide_rate)
    outward = jnp.clip(2.0 * shield.margin - margins[nearest], -shield.guide_rate, shield.guide_rate)
    wanted_B = rotations.cross(look_B, sideways * aside_B - outward * inward_B)
    change_B = (wanted_B - body.omega_BN_B) / GUIDE_SECONDS
    guide_B = dynamics.matvec(spacecraft.inertia_B, change_B) + gyroscopic_B
    return guide_B / jnp.maximum(1.0, jnp.max(jnp.abs(guide_B)) / spacecraft.torque_limit)


# How fast the guide takes up its rate [s].
GUIDE_SECONDS = 0.5
