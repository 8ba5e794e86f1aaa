"""The shield: lets a torque through only if the spacecraft can still come to rest outside all zones afterwards.

``docs/shield.md`` states and proves what it guarantees.  In short: braking against the angular momentum lets the
boresight trace the path of torque-free motion, so that a whole brake maneuver is checked with a few samples of free
motion (``brake_path``).  A request passes if the state after it has a brake path that keeps the margin.  Otherwise the
largest share of it that passes is let through, mixed with a guide that leads around the zone (``guide``); otherwise the
guide; otherwise the shield brakes, along a path that was found to be clear.
"""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jax.core import Tracer

from koz_jax.config.shield import ShieldConfig
from koz_jax.control.shield import brake_path, guide, rate_limit
from koz_jax.control.shield.brake_path import Brake
from koz_jax.control.shield.guide import Guide
from koz_jax.control.shield.rate_limit import RateLimit
from koz_jax.errors import SettingsError
from koz_jax.task import dynamics, pointing_constraints, rotations
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import Allowed, EnvState, Model, nominal_limits, torque_limits
from koz_jax.task.uncertainty import NOISE_BOUND

# Shares of the request in a mix with the guide, and of the guide in a mix with the brake, that are tried in this order.
REQUEST_SHARES = (1.0, 0.5, 0.25, 0.125)
GUIDE_SHARES = (1.0, 0.5, 0.25, 0.125)

# A state is as good as at rest where the brake has so few steps to go; its clearance is then exact.
SLOW_STEPS = 2.0

# [rad] By so much more clearance a request raises it.
RAISE = 1e-6

# What rounding may add to the rate of a cone.
ROUNDING = 1e-5

# Places in the search: the request, and the brake, whose clearance is found there for the others to be compared with.
_REQUEST, _BRAKE, _AWAY, _ASKED = 0, 1, 2, 3


class Shield(struct.PyTreeNode):
    """A shield made for one spacecraft; traced but for the number of samples.  See ``from_config``."""

    margin: jax.Array  # () [rad] kept from every zone
    attitude_error: jax.Array  # () [rad] largest error of a measured attitude
    brake: Brake
    guide: Guide
    rate_limit: RateLimit | None = None  # None where the spacecraft has none

    def covers(self, at: EnvState, model: Model) -> jax.Array:
        """Whether the guarantee holds from this state on: braking keeps the margin.  Returns () bool.

        Braking itself is possible for actuators that store momentum only below their largest rate, and to lead away
        from what comes closer only where they leave a rate for that.
        """
        safe = is_safe(self, at.body, at.scenario.constraints, model) & _is_finite(at.body)
        away = (2.0 * self.brake.approach <= self.guide.rate) | (self.brake.approach == 0.0)
        safe = safe & (self.brake.torque > 0.0) & away
        rates_N = at.scenario.constraints.axis_rate_N
        if rates_N is not None:
            fastest = jnp.max(jnp.where(at.scenario.constraints.is_present, jax.vmap(rotations.norm)(rates_N), 0.0))
            safe = safe & (fastest <= self.brake.cone_rate * (1.0 + ROUNDING))
        if model.actuators.stored_momentum(at.actuators) is None:
            return safe
        limit = self.in_state(at, model).rate_limit
        if limit is None:
            return safe
        # A rate of twice that of the approach, whose largest in free motion is at most sqrt(2) times as large.
        holds = limit.squared >= 8.0 * self.brake.approach**2
        return safe & holds & (limit.squared_peak(at.body) <= limit.squared)

    def allow(self, measured: EnvState, action: jax.Array, model: Model) -> Allowed:
        """What is let through in place of the requested action (3,) in [-1, 1]; the brake at the worst.

        No torque where what is measured is not finite.
        """
        limits = torque_limits(measured, model)
        torque_B = limits.box_B * action
        now = self.in_state(measured, model)
        allowed_B = now.filter(measured.body, torque_B, measured.scenario.constraints, limits, model)
        allowed_B = jnp.where(_is_finite(measured.body), allowed_B, 0.0)
        # What passes comes back to the last bit, also where the limit is no power of two.
        passed = jnp.where(jnp.all(allowed_B == torque_B), action, allowed_B / limits.box_B)
        return Allowed(passed, jnp.array(True))

    def in_state(self, measured: EnvState, model: Model) -> "Shield":
        """The shield with the rate limit of a state, which depends on the momentum that actuators store."""
        if self.rate_limit is None or model.actuators.stored_momentum(measured.actuators) is None:
            return self
        return self.replace(rate_limit=rate_limit.now(self.rate_limit, measured, model))

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
        situation = brake_path.situation(constraints, model)
        brake_B = brake_path.torque(self.brake, body, model)
        torque_B = jnp.where(jnp.all(jnp.isfinite(torque_B)), torque_B, brake_B)
        if self.rate_limit is not None:
            torque_B = self.rate_limit.limit(body, torque_B, brake_B, model)
        guide_B, away_B = guide.torques(self.guide, body, torque_B, constraints, limits, model)
        tried_B = _candidates(torque_B, brake_B, guide_B, away_B)
        last = len(tried_B) - 1
        # In between the steps nothing may be entered; what is measured may be wrong.
        slack = self.attitude_error + self.brake.rate_error * model.dt
        lenient = self._is_slow(body, model) | (pointing_constraints.smallest_margin(body.q_BN, constraints) <= 0.0)

        def attempt(search: _Search) -> _Search:
            number, candidate_B = search.number, tried_B[search.number]
            after = dynamics.step(body, candidate_B, model.inertia_B, model.dt)
            inside = brake_path.step_clearance(self.brake, body, after, candidate_B, situation, model)
            # Of a slow state the clearance is known well, so what is no worse than braking will do where there is less
            # than there should be; of a fast one it is a bound that may have been better before.  Inside a zone any way
            # out is good, and so is the way straight away from a zone that comes.
            flees = (number == _AWAY) & (self.brake.approach > 0.0)
            present = jnp.where(lenient | flees, search.braking, jnp.inf)
            least = self._least(number, present)
            # Of a wrong inertia, or disturbed, braking and fleeing mostly do more or less than they should: they are
            # compared as they are meant.  Others are not, or to coast on would do, and less at every step.
            brake = self.brake.without_errors((number == _BRAKE) | (number == _AWAY))
            pushed = brake_path.push_error(brake, body, candidate_B, model)
            needed = jnp.where(number == _BRAKE, -jnp.inf, least)
            found = brake_path.clearance(brake, after, pushed, situation, model, self.margin, needed)
            made = (found >= least) & ((inside >= slack) | (present <= slack)) & (number != _BRAKE)
            # Only away from the zone where there is too little; else a craft at rest would stay where it is.
            made = made & ((number != _AWAY) | (search.braking < 0.5 * self.margin)) & self._keeps_rate(body, after)
            braking = jnp.where(number == _BRAKE, found, search.braking)
            return _Search(jnp.where(made, number, number + 1), made, braking)

        # A loop, not a branch: a batch then computes no more than its most critical case needs.
        begin = _Search(jnp.int32(_REQUEST), jnp.array(False), jnp.float32(jnp.inf))
        end = jax.lax.while_loop(lambda search: ~search.made & (search.number < last), attempt, begin)
        return tried_B[end.number]

    def _is_slow(self, body: RigidBodyState, model: Model) -> jax.Array:
        momentum = rotations.norm(dynamics.matvec(model.inertia_B, body.omega_BN_B))
        return momentum <= SLOW_STEPS * self.brake.torque * model.dt

    def _keeps_rate(self, before: RigidBodyState, after: RigidBodyState) -> jax.Array:
        return jnp.array(True) if self.rate_limit is None else self.rate_limit.keeps(before, after)

    def _least(self, number: jax.Array, present: jax.Array) -> jax.Array:
        """Clearance that a candidate must have.  present: () [rad] that braking leaves; inf where it does not count."""
        is_asked = (number >= _ASKED) & (number < _ASKED + len(REQUEST_SHARES))
        mixed = jnp.where(is_asked, jnp.minimum(self.margin, present + RAISE), jnp.minimum(0.5 * self.margin, present))
        return jnp.where(number == _REQUEST, self.margin, mixed)


def _candidates(torque_B: jax.Array, brake_B: jax.Array, guide_B: jax.Array, away_B: jax.Array) -> jax.Array:
    """Torques (3,) [N m] in the order in which they are tried.  Returns (candidates, 3)."""
    asked_B = [share * torque_B + (1.0 - share) * guide_B for share in REQUEST_SHARES]
    led_B = [share * guide_B + (1.0 - share) * brake_B for share in GUIDE_SHARES]
    return jnp.stack([torque_B, brake_B, away_B, *asked_B, *led_B, brake_B])


class _Search(struct.PyTreeNode):
    """For the first candidate that can be let through."""

    number: jax.Array  # () int32 of the candidate
    made: jax.Array  # () bool, it can
    braking: jax.Array  # () [rad] clearance after a step of the brake; inf until it is known


def from_config(config: ShieldConfig, model: Model) -> Shield:
    """Make a shield for a spacecraft, with a margin for the errors that ``config`` has to withstand.

    Raises:
        SettingsError: its actuators have no torque that is always there to brake with, or a disturbance is half of it.

    """
    errors, brake_torque = config.error_bounds, model.actuators.brake_torque
    if brake_torque is None:
        raise SettingsError(
            "shield: must have a torque in every direction to brake with, and control moment gyros have none in a"
            " singular arrangement; allowed are a torque_limit or wheels"
        )
    if not isinstance(brake_torque, Tracer):
        there = float(brake_torque)
        config.check((there, there, there))
    limits = nominal_limits(model)
    attitude_error, rate_error = (
        jnp.deg2rad(jnp.float32(NOISE_BOUND * np.sqrt(3.0) * deviation + bias))
        for deviation, bias in (
            (errors.attitude_noise_deg, errors.attitude_bias_deg),
            (errors.rate_noise_deg, errors.rate_bias_deg),
        )
    )
    seconds = guide.take_up_seconds(limits, model)
    brake = _brake(config, brake_torque, rate_error, seconds, model)
    margin = jnp.deg2rad(jnp.float32(config.margin_deg)) + 2.0 * attitude_error
    return Shield(
        margin=margin,
        attitude_error=attitude_error,
        brake=brake,
        guide=guide.from_config(config, brake, margin, seconds, limits, model),
        rate_limit=rate_limit.from_model(model, rate_error),
    )


def _brake(
    config: ShieldConfig, brake_torque: jax.Array, rate_error: jax.Array, seconds: jax.Array, model: Model
) -> Brake:
    """Make a brake.  brake_torque: () [N m] that is there; rate_error: () [rad/s]; seconds: () [s] of the guide."""
    errors = config.error_bounds
    moments = jnp.linalg.eigvalsh(model.inertia_B)
    cone_rate = jnp.deg2rad(jnp.float32(config.cone_rate_deg))
    disturbance = jnp.float32(errors.disturbance_torque)
    # A rate that is measured wrongly is held as if it were none, and a disturbance is balanced where the guide asks for
    # a rate that takes as much torque.
    approach = cone_rate + rate_error + disturbance * seconds / moments[0]
    torque = brake_torque - disturbance
    return Brake(
        torque=torque,
        inertia_error=jnp.float32(errors.inertia_error),
        disturbance=disturbance,
        rate_error=rate_error,
        cone_rate=cone_rate,
        approach=approach,
        later=approach,
        # With the time in which the torque takes up a rate that is twice as large.
        soon=guide.soon(seconds, model.dt) + 2.0 * approach * moments[2] / torque,
        smallest_moment=moments[0],
        largest_moment=moments[2],
        samples=config.samples,
    )


def is_safe(shield: Shield, body: RigidBodyState, constraints: PointingConstraint, model: Model) -> jax.Array:
    """Whether braking from here keeps the margin to all zones.  Returns () bool."""
    situation = brake_path.situation(constraints, model)
    found = brake_path.clearance(shield.brake, body, jnp.zeros(()), situation, model, shield.margin, shield.margin)
    return found >= shield.margin


def _is_finite(body: RigidBodyState) -> jax.Array:
    return jnp.all(jnp.isfinite(body.q_BN)) & jnp.all(jnp.isfinite(body.omega_BN_B))


def under_shield(env: Reorientation, config: ShieldConfig | None) -> Reorientation:
    """Put a shield between controllers and actuators of an environment; None leaves it as it is."""
    return env if config is None else env.replace(action_filter=from_config(config, env.model))
