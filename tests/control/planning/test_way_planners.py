"""Planners that search a graph or a tree: their paths, in a maze and among zones anywhere."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import states, tiny

from koz_jax import load_maneuver
from koz_jax.control.planning import attitude_path
from koz_jax.control.planning.icosphere_astar import IcosphereAStar
from koz_jax.control.planning.mrp_astar import MRPAStar
from koz_jax.control.planning.rrt import RRT
from koz_jax.control.planning.way_planner import WayPlanner
from koz_jax.evaluation import maneuver
from koz_jax.task import rotations

MAZE = maneuver.scenario(load_maneuver(tiny.MANEUVER_FILES["maze"]))
COUNT = 4


def _maneuvers():
    """The maze, and maneuvers between attitudes anywhere; start and target are clear of all zones by 3 deg."""
    starts, targets = np.array(states.quaternions(COUNT, 1)), np.array(states.quaternions(COUNT, 2))
    zones = MAZE.constraints.count
    axes = np.array(states.directions(COUNT * zones, 3)).reshape(COUNT, zones, 3)
    half_angles = np.tile(np.linspace(0.2, 0.4, zones, dtype=np.float32), (COUNT, 1))
    # The second begins more than half a turn away, which is undone the way it came.
    starts *= np.where(np.sum(starts * targets, axis=1) < 0.0, -1.0, 1.0)[:, None] * np.array([1, -1, 1, 1])[:, None]
    maze = MAZE.initial.q_BN, MAZE.q_DN, MAZE.constraints.axis_N, MAZE.constraints.half_angle
    for of, first in zip((starts, targets, axes, half_angles), maze, strict=True):
        of[0] = first
    looks = np.stack([_looks(starts), _looks(targets)])
    nearest = np.min(_angles(looks[:, :, None], axes[None]), axis=0)
    half_angles[nearest < half_angles + 0.05] = -3.0
    assert np.all(half_angles[0] > 0.0) and np.all(np.sum(half_angles > 0.0, axis=1) > 5)
    arrays = (starts, np.zeros((COUNT, 3)), targets, axes, half_angles)
    return states.states_of(*(jnp.asarray(array, jnp.float32) for array in arrays))


def _looks(attitudes):
    """Where the boresight x looks.  attitudes: (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(attitudes, float), -1, 0)
    return np.stack([1 - 2 * (y**2 + z**2), 2 * (x * y + w * z), 2 * (x * z - w * y)], axis=-1)


def _angles(a, b):
    return np.arccos(np.clip(np.sum(a * b, axis=-1), -1.0, 1.0))


@jax.jit
def _ways(planner, starts):
    keys = jax.random.split(jax.random.key(1), COUNT)
    return jax.vmap(planner.way, in_axes=(0, None, 0))(starts, states.MODEL, keys)


@jax.jit
def _smoothed(ways, starts):
    """What ``begin`` makes of ways, one program for those of all planners."""
    paths, timings = jax.vmap(WayPlanner().smoothed, in_axes=(0, 0, None))(ways, starts, states.MODEL)
    return timings, jax.vmap(lambda path: attitude_path.sample(path, 1001))(paths)


# Of one length, for one program.
PLANNERS = [IcosphereAStar(hops=128), MRPAStar(hops=128), RRT(hops=128)]


@pytest.fixture(scope="module", params=PLANNERS, ids=lambda planner: type(planner).__name__)
def planned(request):
    starts = _maneuvers()
    timings, samples = _smoothed(_ways(request.param, starts), starts)
    return starts, timings, jax.tree.map(lambda leaf: np.asarray(leaf, float), samples)


@pytest.mark.slow
def test_paths_clear_all_zones_of_the_maze_and_anywhere(planned):
    starts, _, samples = planned
    zones = starts.scenario.constraints
    angles = _angles(_looks(samples.q_BN)[:, :, None], np.asarray(zones.axis_N, float)[:, None])
    margins = np.rad2deg((angles - np.asarray(zones.half_angle, float)[:, None]).min(axis=(1, 2)))
    # The gaps of the maze are 4 deg wide.
    assert 0.3 < margins[0] < 2.0 and np.all(margins > 0.3)


@pytest.mark.slow
def test_paths_lead_from_the_start_to_the_target_with_its_sign(planned):
    starts, timing, samples = planned
    np.testing.assert_allclose(samples.q_BN[:, 0], starts.body.q_BN, atol=3e-6)
    np.testing.assert_allclose(samples.q_BN[:, -1], starts.scenario.q_DN, atol=3e-6)
    np.testing.assert_allclose(timing.speed[:, [0, -1]], 0.0, atol=2e-3)
    assert np.all(np.isfinite(timing.time))
    assert rotations.dot(starts.body.q_BN[1], starts.scenario.q_DN[1]) < 0.0
