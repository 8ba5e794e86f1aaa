"""Bounds of a barrier over all states that a spacecraft may be in, found by sampling.

A state is allowed while the energy is within its limit and the barrier of a cone is at most -delta.  mu is the largest
deceleration for which, in all states sampled on the edge of that set, the box holds a torque that keeps to it.  Both a
large and a small one can be too bold: that one asks for more than there is, and this one counts on braking far from
the cone, where a torque hardly moves kappa.  It depends on the half angle, so it is looked for at several.  What is
sampled is any instrument and any cone: neither is known when the filter is made.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.control.filters import barrier
from koz_jax.control.filters.barrier import Bounds, Look
from koz_jax.task import dynamics, rotations
from koz_jax.task.state import Model, nominal_limits

# [rad] At which mu is looked for; in between it is interpolated.
HALF_ANGLES = np.deg2rad([5.0, 10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 90.0, 120.0, 150.0, 165.0, 175.0])

# [1/T^2] Those that are tried.
DECELERATIONS = np.geomspace(0.03, 1.2, 20)

# Of the asked limit of the rate, what is tried in this order: near the middle of a cone to be kept in no torque moves
# kappa, so that only a slow body stops at its edge.
RATE_SHARES = np.array([1.0, 0.7, 0.5, 0.35, 0.2, 0.1])

# What is sampled may miss the worst state, and so much less than what is found is counted on.
_SAFETY = 0.8


class Limits(struct.PyTreeNode):
    """Bounds for cones of any half angle."""

    decelerations: jax.Array  # (angles,) [1/s^2] mu at ``HALF_ANGLES``
    energies: jax.Array  # (angles,) [J] largest w . I w there
    failures: jax.Array  # (angles,) share of the sampled states in which no torque keeps to the allowed set
    disturbed: jax.Array  # () [1/s^2] M2
    third: jax.Array  # () [1/s^3] M3

    def of(self, half_angle: jax.Array) -> Bounds:
        """Bounds for a half angle () [rad]."""
        return Bounds(jnp.interp(half_angle, HALF_ANGLES, self.decelerations), self.disturbed, self.third)

    def energy(self, half_angle: jax.Array) -> jax.Array:
        """Largest w . I w with a cone of a half angle () [rad].  Returns () [J]."""
        above = jnp.clip(jnp.searchsorted(jnp.asarray(HALF_ANGLES), half_angle), 1, len(HALF_ANGLES) - 1)
        return jnp.minimum(self.energies[above - 1], self.energies[above])


class Allowed(NamedTuple):
    """What bounds a set of states."""

    energy: jax.Array  # () [J] largest w . I w
    disturbance: jax.Array  # () [N m] torque from outside
    cone_rate: jax.Array  # () [rad/s] of cones' axes


class _Draw(struct.PyTreeNode):
    """A sampled state, before it is put on the edge of the allowed set of a cone."""

    boresight_B: jax.Array  # (3,) unit vector
    aside_B: jax.Array  # (3,) unit vector, square to it: where the cone is
    rate_B: jax.Array  # (3,) direction of the rate
    axis_rate_B: jax.Array  # (3,) unit vector
    angle: jax.Array  # () in [0, 1], between the edge of the cone and its far side
    share: jax.Array  # () in [0, 1], of the energy that is left for other rates


@functools.partial(jax.jit, static_argnames=("samples", "seed"))
def find(allowed: Allowed, samples: int, seed: int, model: Model) -> Limits:
    """Find the bounds of a spacecraft.  samples, seed: of the states in which they are looked for."""
    inverse_B = dynamics.inverse(model.inertia_B)
    draws = _draws(samples, seed)
    third = jnp.max(jax.vmap(_third, in_axes=(0, None, None, None))(draws, allowed, model, inverse_B))
    disturbed = allowed.disturbance * jnp.linalg.eigvalsh(inverse_B)[2]
    unit = nominal_limits(model).scale / (jnp.trace(model.inertia_B) / 3.0)
    # The largest first: argmin takes the first of those with the fewest failures.
    tried = np.meshgrid(HALF_ANGLES, RATE_SHARES**2, DECELERATIONS[::-1], indexing="ij")
    angles, shares, decelerations = (jnp.asarray(values.ravel(), jnp.float32) for values in tried)

    def failures(chosen: tuple[jax.Array, jax.Array, jax.Array]) -> jax.Array:
        half_angle, share, deceleration = chosen
        bounds = Bounds(deceleration * unit, disturbed, third)
        slower = allowed._replace(energy=share * allowed.energy)
        over_draws = jax.vmap(_is_kept, in_axes=(0, None, None, None, None, None))
        return jnp.sum(~over_draws(draws, half_angle, bounds, slower, model, inverse_B))

    counts = jax.lax.map(failures, (angles, shares, decelerations)).reshape(len(HALF_ANGLES), -1)
    best = jnp.argmin(counts, axis=1)
    return Limits(
        decelerations=_SAFETY * unit * decelerations[best],
        energies=allowed.energy * shares[best],
        failures=jnp.min(counts, axis=1) / samples,
        disturbed=disturbed,
        third=third,
    )


def _draws(samples: int, seed: int) -> _Draw:
    """States, leaves (samples, ...)."""
    rng = np.random.default_rng(seed)

    def directions() -> np.ndarray:
        vectors = rng.standard_normal((samples, 3))
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    boresights = directions()
    aside = np.cross(boresights, directions())
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    # Half of them with all of the energy, where there is least authority.
    shares = np.maximum(np.where(rng.random(samples) < 0.5, 1.0, rng.random(samples)), 1e-3)
    drawn = (boresights, aside, directions(), directions(), rng.random(samples), shares)
    return _Draw(*(jnp.asarray(values, jnp.float32) for values in drawn))


def _looking(draw: _Draw, angle: jax.Array, allowed: Allowed) -> Look:
    """Put the cone's axis at an angle () [rad] from the boresight; the rate is left as drawn."""
    axis_B = jnp.cos(angle) * draw.boresight_B + jnp.sin(angle) * draw.aside_B
    return Look(draw.boresight_B, axis_B, allowed.cone_rate * draw.axis_rate_B, draw.rate_B)


def _third(draw: _Draw, allowed: Allowed, model: Model, inverse_B: jax.Array) -> jax.Array:
    """Largest size of the third derivative that any torque of the box gives, at any angle.  Returns () [1/s^3]."""
    look = _looking(draw, jnp.pi * draw.angle, allowed)
    turned = rotations.dot(draw.rate_B, dynamics.matvec(model.inertia_B, draw.rate_B))
    look = look.replace(omega_BN_B=jnp.sqrt(draw.share * allowed.energy / turned) * draw.rate_B)
    # Affine in the torque.
    free, slope_B = jax.value_and_grad(barrier.third_derivative, argnums=1)(
        look, jnp.zeros(3), model.inertia_B, inverse_B
    )
    return jnp.abs(free) + jnp.sum(nominal_limits(model).box_B * jnp.abs(slope_B))


def _is_kept(
    draw: _Draw, half_angle: jax.Array, bounds: Bounds, allowed: Allowed, model: Model, inverse_B: jax.Array
) -> jax.Array:
    """Whether the box holds a torque that keeps to the allowed set, in a state at its edge.  Returns () bool."""
    look = _looking(draw, half_angle + (jnp.pi - half_angle) * draw.angle, allowed)
    at = barrier.motion(look, half_angle, model.inertia_B, inverse_B)
    # The slowest rate with which kappa grows as fast as is allowed, and others that it does not feel.
    room = -at.kappa - bounds.delta(model.dt)
    turn_B = rotations.cross(look.boresight_B, look.axis_B)
    growth = jnp.sqrt(2.0 * bounds.deceleration * jnp.maximum(room, 0.0)) + rotations.dot(look.axis_rate_B, turn_B)
    per_rate = jnp.maximum(rotations.dot(turn_B, at.row), 1e-12)
    needed = growth**2 / per_rate
    other_B = rotations.cross(turn_B, draw.rate_B)
    other_energy = jnp.maximum(rotations.dot(other_B, dynamics.matvec(model.inertia_B, other_B)), 1e-12)
    left = jnp.maximum(allowed.energy - needed, 0.0)
    omega_B = growth / per_rate * at.row + jnp.sqrt(draw.share * left / other_energy) * other_B
    at = barrier.motion(look.replace(omega_BN_B=omega_B), half_angle, model.inertia_B, inverse_B)
    least = at.free - jnp.sum(nominal_limits(model).box_B * jnp.abs(at.row))
    is_possible = (room > 0.0) & (needed <= allowed.energy)
    return ~is_possible | (least <= barrier.largest_second_derivative(at, bounds, model.dt))
