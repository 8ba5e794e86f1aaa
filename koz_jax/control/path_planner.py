"""Attitude path planning around the zones, tracked by feedback.

Before the maneuver a path is searched for: candidates bend the eigen-axis turn aside, each is timed as fast as the
torque box allows, and the fastest that keeps its distance from all zones is refined by a cross-entropy search.  After
Frazzoli, Dahleh, Feron & Kornfeld, "A randomized attitude slew planning algorithm for autonomous spacecraft" (AIAA GNC
2001), and Kjellberg & Lightsey, "Discretized constrained attitude pathfinding and control for satellites" (JGCD 2013),
who search a tree and a grid of attitudes instead.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control import attitude_path, feedback
from koz_jax.control.attitude_path import AttitudePath, Samples, Timing
from koz_jax.control.feedback import Gain
from koz_jax.task import dynamics, rotations
from koz_jax.task.any_spacecraft import units
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.state import EnvState, Model, largest_rate, torque_limits

# What a path too close to a zone costs [T/rad]; more than any detour.
_TIME_PER_SHORTFALL = 365.1484

# Bends that are tried first [deg], and to how many sides.
_BENDS_DEG = (30.0, 50.0, 80.0, 120.0)
_SIDES = 8

# Standard deviation [rad] of the first sine's amplitude in the first and in the last round; less for further sines.
_SPREADS = (0.3, 0.03)


# Of the rate limit that a plan needs; what is left is for its tracking.
_RATE_SHARE = 0.97

# Of the error at which the clock begins to slow down; at twice that it stands still.
_LOST = 3.0


class Plan(struct.PyTreeNode):
    """A path with its timing, and how far it has been flown."""

    path: AttitudePath
    timing: Timing
    clock: jax.Array  # () [s] of the plan; stands still while the body is too far from it
    key: jax.Array  # () typed PRNG key of the next search

    def reference(self, time: jax.Array, pace: jax.Array) -> RigidBodyState:
        """Where the body should be at a time () [s] of the plan whose clock goes at a pace ()."""
        s, speed = self.timing.at(time)
        q, slope_B = self.path.attitude_and_slope(s)
        return RigidBodyState(q, pace * speed * slope_B)

    def error(self, body: RigidBodyState) -> jax.Array:
        """Rotation vector (3,) [rad] from where the body should be to where it is."""
        s, _ = self.timing.at(self.clock)
        return feedback.rotation_vector(rotations.multiply(rotations.conjugate(self.path.attitude(s)), body.q_BN))


class _Found(struct.PyTreeNode):
    """Where a search stands."""

    mean_B: jax.Array  # (sines, 3) [rad] of the better candidates
    best_B: jax.Array  # (sines, 3) [rad]


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


class PathPlanner(struct.PyTreeNode):
    """Plans in ``begin``, tracks in ``decide``, and plans anew where something has led it off its path.

    The tracking error decays with ``bandwidth``, its rate with ``rate_bandwidth``.
    """

    # ``python -m koz_jax.cli.tune planner --cases 100 --candidates 16 --rounds 6`` at commit 00b415c, which found
    # 0.2939 and 3.296 1/s for T = sqrt(30) s.
    margin: Gain = 0.0472  # () [rad] that the path keeps from the zones
    torque_share: Gain = 0.9932  # () of the torque limit that the path needs at most
    bandwidth: Gain = 1.609757  # () [1/T]
    rate_bandwidth: Gain = 18.05294  # () [1/T]
    patience: Gain = 0.0425  # () [rad] tracking error at which the plan waits
    sines: int = struct.field(pytree_node=False, default=2)  # of the bend
    points: int = struct.field(pytree_node=False, default=49)  # of a path
    candidates: int = struct.field(pytree_node=False, default=32)  # of a round of refinement
    rounds: int = struct.field(pytree_node=False, default=16)

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> Plan:
        """Search for a path from the state to its target."""
        key, key_search = jax.random.split(key)

        def cost(bends_B: jax.Array) -> jax.Array:
            path = attitude_path.from_state(state.body, state.scenario.q_DN, bends_B)
            samples = attitude_path.sample(path, self.points)
            timing = attitude_path.fastest_timing(samples, model.inertia_B, limit_B, _max_speed(samples, state, model))
            clear = attitude_path.clearance(samples, state.scenario.constraints, timing)
            return timing.duration + per_shortfall * jnp.maximum(self.margin - clear, 0.0)

        per_shortfall = _TIME_PER_SHORTFALL * units.of(model).time
        limit_B = self.torque_share * torque_limits(state, model).box_B
        bends_B = self._search(cost, self._first_bends(state), key_search)
        path = attitude_path.from_state(state.body, state.scenario.q_DN, bends_B)
        samples = attitude_path.sample(path, self.points)
        timing = attitude_path.fastest_timing(samples, model.inertia_B, limit_B, _max_speed(samples, state, model))
        return Plan(path, timing, jnp.zeros(()), key)

    def _search(self, cost: Callable[[jax.Array], jax.Array], first_B: jax.Array, key: jax.Array) -> jax.Array:
        """Cross-entropy search from the best of the first bends (n, sines, 3).  Returns the best found (sines, 3)."""
        order = 1.0 / jnp.arange(1.0, self.sines + 1)[None, :, None]
        elite = max(self.candidates // 4, 1)
        weights = jnp.log(elite + 0.5) - jnp.log(jnp.arange(1.0, elite + 1))

        def refine(found: _Found, draw: tuple[jax.Array, jax.Array]) -> tuple[_Found, None]:
            key_round, spread = draw
            changes_B = spread * order * jax.random.normal(key_round, (self.candidates, self.sines, 3))
            tried_B = (found.mean_B[None] + changes_B).at[0].set(found.best_B)
            best_first = tried_B[jnp.argsort(jax.vmap(cost)(tried_B))]
            mean_B = jnp.tensordot(weights / jnp.sum(weights), best_first[:elite], axes=1)
            return _Found(mean_B, best_first[0]), None

        begin_B = first_B[jnp.argmin(jax.vmap(cost)(first_B))]
        draws = (jax.random.split(key, self.rounds), jnp.geomspace(*_SPREADS, self.rounds))
        return jax.lax.scan(refine, _Found(begin_B, begin_B), draws)[0].best_B

    def _first_bends(self, state: EnvState) -> jax.Array:
        """Bends to all sides, by several angles.  Returns (..., sines, 3) [rad]."""
        straight = attitude_path.from_state(state.body, state.scenario.q_DN, jnp.zeros((self.sines, 3)))
        half_way = feedback.from_rotation_vector(-0.5 * straight.turn_B)
        look_B = rotations.rotate(half_way, state.scenario.constraints.boresight_B[0])
        # A turn about an axis square to the boresight moves it most.
        square_B = rotations.cross(look_B, jnp.eye(3)[jnp.argmin(jnp.abs(look_B))])
        square_B = rotations.normalize(square_B)
        across_B = rotations.cross(look_B, square_B)
        sides = jnp.arange(_SIDES) * (2.0 * jnp.pi / _SIDES)
        axes_B = jnp.cos(sides)[:, None] * square_B[None] + jnp.sin(sides)[:, None] * across_B[None]
        bends_B = (jnp.deg2rad(jnp.array(_BENDS_DEG))[:, None, None] * axes_B[None]).reshape(-1, 1, 3)
        rest = jnp.zeros((bends_B.shape[0], self.sines - 1, 3))
        return jnp.concatenate([bends_B, rest], axis=1)

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
        """The plan, or a new one from here where the body is too far from it."""
        lost = rotations.norm(plan.error(state.body)) > _LOST * self.patience

        def anew(search: _Search) -> _Search:
            # Without the barrier the search is done in advance, at every step, as it does not depend on the loop.
            search, here = jax.lax.optimization_barrier((search, state))
            return _Search(self.begin(here, model, search.plan.key), jnp.array(False))

        # A loop, not a branch: a batch then plans only when one of it is lost.
        return jax.lax.while_loop(lambda search: search.needed, anew, _Search(plan, lost)).plan
