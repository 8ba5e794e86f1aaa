"""Where zones are on several sides, the guide leads away from the nearest as fast as if it were alone."""

import jax
import jax.numpy as jnp
import numpy as np
from support import states

from koz_jax.config.shield import ShieldConfig
from koz_jax.control.shield import filter as shield
from koz_jax.control.shield import guide
from koz_jax.control.shield.guide import Guide
from koz_jax.task import pointing_constraints, rotations
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint

UNLIMITED = TorqueLimits(jnp.full(3, 1e9))
CASES, ZONES = 400, 4


def leads_with(made: Guide, q_BN: jax.Array, zones: PointingConstraint) -> jax.Array:
    """Rate (3,) [rad/s] that the guide takes up from rest, to lead away only."""
    at_rest = RigidBodyState(q_BN, jnp.zeros(3))
    _, away_B = guide.torques(made, at_rest, jnp.zeros(3), zones, UNLIMITED, states.MODEL)
    return made.seconds * jnp.linalg.solve(states.MODEL.inertia_B, away_B)


def test_other_zones_take_nothing_from_what_leads_away_from_the_nearest():
    rng = np.random.default_rng(4)
    made = shield.from_config(ShieldConfig(), states.MODEL).guide
    q_BN = states.quaternions(CASES, 3)
    # All around where the telescope looks, with edges from half of the guide's margin to twice of it away.
    angles = rng.uniform(0.3, 0.6, (CASES, ZONES))
    around = rng.uniform(0.0, 2.0 * np.pi, (CASES, ZONES))
    axes_B = np.stack([np.cos(angles), np.sin(angles) * np.cos(around), np.sin(angles) * np.sin(around)], axis=-1)
    axes_N = jax.vmap(lambda q, axes: jax.vmap(lambda axis: rotations.rotate(q, axis))(axes))(q_BN, jnp.float32(axes_B))
    margins = jnp.float32(rng.uniform(0.5, 2.0, (CASES, ZONES))) * made.margin
    zones = PointingConstraint(jnp.tile(states.LOOK, (CASES, ZONES, 1)), axes_N, jnp.float32(angles) - margins)

    @jax.jit
    @jax.vmap
    def rates(q_BN: jax.Array, zones: PointingConstraint) -> tuple[jax.Array, jax.Array]:
        nearest = jnp.argmin(pointing_constraints.margins(q_BN, zones))
        alone = leads_with(made, q_BN, jax.tree.map(lambda leaf: leaf[nearest][None], zones))
        return alone, leads_with(made, q_BN, zones)

    alone, among_others = (np.asarray(rate, np.float64) for rate in rates(q_BN, zones))
    size = np.linalg.norm(alone, axis=1)
    assert size.min() > 0.0 and np.linalg.norm(among_others - alone, axis=1).max() > 0.5 * size.max()
    along = np.sum(among_others * alone, axis=1) / size
    assert np.all(along >= size * (1.0 - 1e-4))
