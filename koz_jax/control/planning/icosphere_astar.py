"""The shortest way of the boresight over a sphere of directions, zones cut out.

After Kjellberg & Lightsey, "Discretized constrained attitude pathfinding and control for satellites" (JGCD 36(5), 2013,
10.2514/1.60189): the sphere is that of 2,562 directions about 4 deg apart, and those inside a zone are left out.  The
body follows by the smallest turns that bring the boresight from one direction to the next, and what is left to roll
about it is spread over the way.  The search knows the zones of the first instrument, where they are at the start; the
smoothing knows all.
"""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.control.planning import icosphere, shortest_way, spline_path
from koz_jax.control.planning.shortest_way import Graph
from koz_jax.control.planning.way_planner import WayPlanner
from koz_jax.task import rotations
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import EnvState, Model

# Points of the arcs from start and target to the directions near them, at which their margins are looked at.
_SAMPLES = 4

# What a turn costs where a zone is at no distance, over what it costs at ``margin`` and farther.
_DEAREST = 5.0


class IcosphereAStar(WayPlanner):
    """Searches among the corners of an icosahedron halved again and again."""

    halvings: int = struct.field(pytree_node=False, default=4)  # of the edges of the icosahedron
    hops: int = struct.field(pytree_node=False, default=160)  # of a way, at most
    least: float = 0.002  # () [rad] margin of a direction that is not left out
    reach: float = 0.16  # () [rad] of start and target: they are joined to the directions so near

    def way(self, state: EnvState, model: Model, key: jax.Array) -> jax.Array:
        """Shortest way of the boresight, and attitudes along it.  Returns (hops + 2, 4)."""
        boresight_B = state.scenario.constraints.boresight_B[0]
        # In the axes of the target, so that it makes no difference how the inertial ones are turned.
        q_DN = state.scenario.q_DN
        q_BD = rotations.multiply(rotations.conjugate(q_DN), state.body.q_BN)
        zones_D = _seen_from(q_DN, state.scenario.constraints)
        looks_D, found = self._looks(rotations.rotate(q_BD, boresight_B), boresight_B, zones_D)
        followed = _follow(q_BD, looks_D, boresight_B)
        direct = jnp.concatenate([q_BD[None], jnp.tile(jnp.eye(4)[:1], (self.hops + 1, 1))])
        return jax.vmap(rotations.multiply, in_axes=(None, 0))(q_DN, jnp.where(found, followed, direct))

    def _looks(self, start: jax.Array, goal: jax.Array, zones: PointingConstraint) -> tuple[jax.Array, jax.Array]:
        """Directions (hops + 2, 3) from one (3,) to another (3,), and whether they get there () bool."""
        sphere = icosphere.sphere(self.halvings)
        directions = jnp.asarray(sphere.directions, jnp.float32)
        margins = jax.vmap(_margin, in_axes=(0, None))(directions, zones)
        open_ = jnp.where(margins > self.least, 1.0, jnp.inf)
        dear = open_ * (1.0 + (_DEAREST - 1.0) * jnp.clip(1.0 - margins / self.margin, 0.0, 1.0))
        neighbours = jnp.asarray(sphere.neighbours)
        angles = jnp.asarray(sphere.angles, jnp.float32)
        graph = Graph(neighbours, angles * 0.5 * (dear[:, None] + dear[neighbours]))
        first, last = (self._joined(look, directions, dear, zones) for look in (start, goal))
        to_go = shortest_way.costs_to_go(graph, last)
        nodes, found = shortest_way.follow(graph, to_go, first, last, self.hops)
        return jnp.concatenate([start[None], directions[nodes], goal[None]]), found

    def _joined(self, look: jax.Array, directions: jax.Array, dear: jax.Array, zones: PointingConstraint) -> jax.Array:
        """Cost from a direction (3,) straight to each of the grid's.  Returns (directions,)."""
        needed = jnp.minimum(self.least, _margin(look, zones) - 1e-4)

        def clear(other: jax.Array) -> jax.Array:
            share = (jnp.arange(_SAMPLES) + 1.0) / _SAMPLES
            between = look[None] + share[:, None] * (other - look)[None]
            return jnp.all(jax.vmap(lambda at: _margin(rotations.normalize(at), zones))(between) >= needed)

        angles = jax.vmap(rotations.angle_between, in_axes=(None, 0))(look, directions)
        near = angles < self.reach
        return jnp.where(near & jax.vmap(clear)(directions), angles * dear, jnp.inf)


def _seen_from(q_DN: jax.Array, zones: PointingConstraint) -> PointingConstraint:
    """Zones with their axes in those of the target; those that are not for the first instrument are absent."""
    axes_D = jax.vmap(rotations.rotate, in_axes=(None, 0))(rotations.conjugate(q_DN), zones.axis_N)
    apart = jax.vmap(rotations.angle_between, in_axes=(0, None))(zones.boresight_B, zones.boresight_B[0])
    return zones.replace(axis_N=axes_D, half_angle=jnp.where(apart < 1e-3, zones.half_angle, -jnp.pi))


def _margin(look: jax.Array, zones: PointingConstraint) -> jax.Array:
    """Margin of a direction (3,) to the nearest zone, in the same axes.  Returns () [rad]."""
    angles = jax.vmap(rotations.angle_between, in_axes=(None, 0))(look, zones.axis_N)
    return jnp.min(angles - zones.half_angle)


def _follow(q_begin: jax.Array, looks: jax.Array, boresight_B: jax.Array) -> jax.Array:
    """Attitudes (n, 4) whose boresight looks into directions (n, 3), from the first one (4,) to the identity."""

    def turn(q: jax.Array, look: jax.Array) -> tuple[jax.Array, jax.Array]:
        now = rotations.rotate(q, boresight_B)
        smallest = jnp.concatenate([1.0 + rotations.dot(now, look)[None], rotations.cross(now, look)])
        q = rotations.multiply(rotations.normalize(smallest), q)
        return q, q

    end, followed = jax.lax.scan(turn, q_begin, looks)
    roll = rotations.dot(spline_path.turn(end, jnp.eye(4)[0]), boresight_B)
    arcs = jax.vmap(rotations.angle_between)(looks[:-1], looks[1:])
    passed = jnp.concatenate([jnp.zeros(1), jnp.cumsum(arcs)])
    evenly = jnp.linspace(0.0, 1.0, looks.shape[0])
    share = jnp.where(passed[-1] > 0.0, passed / jnp.where(passed[-1] > 0.0, passed[-1], 1.0), evenly)
    rolls_B = (roll * share)[:, None] * boresight_B[None]
    return jax.vmap(spline_path.turned)(followed, rolls_B).at[-1].set(jnp.eye(4)[0])
