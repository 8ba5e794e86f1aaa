"""What planners share, which search for a path in their first decision: its timing, what it costs, its tracking."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import feedback
from koz_jax.control.feedback import Gain
from koz_jax.control.planning import attitude_path
from koz_jax.control.planning.attitude_path import Path, Samples, Timing
from koz_jax.task import dynamics, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.state import EnvState, Model, largest_rate, torque_limits

# What a path too close to a zone costs [T/rad]; more than any detour.
_TIME_PER_SHORTFALL = 365.1484

# Of the rate limit that a plan needs; what is left is for its tracking.
_RATE_SHARE = 0.97

# Of the error at which the clock begins to slow down; at twice that it stands still.
_LOST = 3.0


class Plan(struct.PyTreeNode):
    """A path with its timing, and how far it has been flown."""

    path: Path
    timing: Timing
    clock: jax.Array  # () [s] of the plan; stands still while the body is too far from it
    key: jax.Array  # () typed PRNG key of the next search
    found: jax.Array  # () bool, false before the first search

    def reference(self, time: jax.Array, pace: jax.Array) -> RigidBodyState:
        """Where the body should be at a time () [s] of the plan whose clock goes at a pace ()."""
        s, speed = self.timing.at(time)
        q, slope_B = self.path.attitude_and_slope(s)
        return RigidBodyState(q, pace * speed * slope_B)

    def error(self, body: RigidBodyState) -> jax.Array:
        """Rotation vector (3,) [rad] from where the body should be to where it is."""
        s, _ = self.timing.at(self.clock)
        return feedback.rotation_vector(rotations.multiply(rotations.conjugate(self.path.attitude(s)), body.q_BN))


class _Search(struct.PyTreeNode):
    """For a plan, where one is needed."""

    plan: Plan
    needed: jax.Array  # () bool


def _max_speed(samples: Samples, state: EnvState, model: Model) -> jax.Array | None:
    """Largest ds/dt (points,) [1/s] that the shield would let pass; None without a rate limit."""
    largest = largest_rate(state, model)
    if largest is None:
        return None
    form_B = dynamics.peak_rate_form(model.inertia_B)
    squared = jax.vmap(lambda slope_B: rotations.dot(slope_B, dynamics.matvec(form_B, slope_B)))(samples.slope_B)
    return _RATE_SHARE * largest / jnp.sqrt(jnp.maximum(squared, 1e-12))


class PathTracker(struct.PyTreeNode):
    """Base of planners: has a path made in the first decision, tracks it, and has one made anew where the body left it.

    The tracking error decays with ``bandwidth``, its rate with ``rate_bandwidth``.
    """

    # ``koz tune planner --cases 100 --candidates 16 --rounds 6`` at commit 00b415c, which found 0.2939 and 3.296 1/s
    # for T = sqrt(30) s.
    margin: Gain = 0.0472  # () [rad] that the path keeps from the zones
    torque_share: Gain = 0.9932  # () of the torque limit that the path needs at most
    bandwidth: Gain = 1.609757  # () [1/T]
    rate_bandwidth: Gain = 18.05294  # () [1/T]
    patience: Gain = 0.0425  # () [rad] tracking error at which the plan waits
    points: int = struct.field(pytree_node=False, default=49)  # at which a path is timed

    def staying(self, state: EnvState) -> Path:
        """Make a path of the kind that ``search`` finds, but one that stays where it begins."""
        raise NotImplementedError

    def search(self, state: EnvState, model: Model, key: jax.Array) -> tuple[Path, Timing]:
        """Find a path from the state to its target, and time it.  key: () typed PRNG key."""
        raise NotImplementedError

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> Plan:
        """Make a plan that is none yet: there is one search in the program, that of ``decide``."""
        timing = Timing(jnp.zeros(self.points), jnp.zeros(self.points))
        return Plan(self.staying(state), timing, jnp.zeros(()), key, jnp.array(False))

    def planned(self, state: EnvState, model: Model, key: jax.Array) -> Plan:
        """Search for a path from the state to its target."""
        key, key_search = jax.random.split(key)
        path, timing = self.search(state, model, key_search)
        return Plan(path, timing, jnp.zeros(()), key, jnp.array(True))

    def timed(self, path: Path, state: EnvState, model: Model) -> tuple[Samples, Timing]:
        """Sample a path, and time it as fast as the spacecraft can follow."""
        samples = jax.lax.optimization_barrier(attitude_path.sample(path, self.points))
        limit_B = self.torque_share * torque_limits(state, model).box_B
        most = _max_speed(samples, state, model)
        return samples, attitude_path.fastest_timing(samples, model.inertia_B, limit_B, most)

    def judged(self, path: Path, state: EnvState, model: Model) -> tuple[jax.Array, Timing]:
        """How long a path takes () [s], and more where it comes too close to a zone; and its timing."""
        samples, timing = self.timed(path, state, model)
        clear = attitude_path.clearance(samples, state.scenario.constraints, timing)
        per_shortfall = _TIME_PER_SHORTFALL * units.of(model).time
        return timing.duration + per_shortfall * jnp.maximum(self.margin - clear, 0.0), timing

    def decide(self, state: EnvState, model: Model, memory: Plan) -> tuple[jax.Array, Plan]:
        """Action (3,), and the plan with its clock moved on."""
        body, dt = state.body, model.dt
        plan = self._not_lost(state, model, memory)
        error_B = plan.error(body)
        pace = jnp.clip(2.0 - rotations.norm(error_B) / self.patience, 0.0, 1.0)
        now, soon = plan.reference(plan.clock, pace), plan.reference(plan.clock + pace * dt, pace)
        bandwidth, rate_bandwidth = (feedback.bandwidth(gain, model) for gain in (self.bandwidth, self.rate_bandwidth))
        wanted_B = now.omega_BN_B - bandwidth * error_B
        change_B = (soon.omega_BN_B - now.omega_BN_B) / dt - bandwidth * (body.omega_BN_B - now.omega_BN_B)
        acceleration_B = change_B + rate_bandwidth * (wanted_B - body.omega_BN_B)
        middle = body.replace(omega_BN_B=body.omega_BN_B + 0.5 * dt * change_B)
        action = feedback.action(acceleration_B, middle, model.inertia_B, torque_limits(state, model))
        return action, plan.replace(clock=plan.clock + pace * dt)

    def _not_lost(self, state: EnvState, model: Model, plan: Plan) -> Plan:
        """The plan, or a new one from here where there is none, or the body is too far from it."""
        lost = ~plan.found | (rotations.norm(plan.error(state.body)) > _LOST * self.patience)

        def anew(search: _Search) -> _Search:
            # Without the barrier the search is done in advance, at every step, as it does not depend on the loop.
            search, here = jax.lax.optimization_barrier((search, state))
            return _Search(self.planned(here, model, search.plan.key), jnp.array(False))

        # A loop, not a branch: a batch then plans only when one of it is lost.
        return jax.lax.while_loop(lambda search: search.needed, anew, _Search(plan, lost)).plan
