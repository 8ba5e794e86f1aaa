"""Slews, and their choice by the double DQN that comes with the package."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import states

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.control import registry
from koz_jax.control.slews import slews
from koz_jax.evaluation import cases
from koz_jax.task import pointing_constraints, rotations

_slew = jax.jit(jax.vmap(slews.slew))


def angle_between(a, b):
    """Angle (n,) [rad] of the rotation from attitudes (n, 4) to others (n, 4), in NumPy float64."""
    cosine = np.abs(np.sum(np.asarray(a, float) * np.asarray(b, float), axis=1))
    return 2.0 * np.arccos(np.minimum(cosine, 1.0))


def rested(count, seed):
    at = states.random_states(count, seed)
    return jax.vmap(slews.at_rest)(at, at.body.q_BN)


@pytest.mark.slow
def test_there_are_eighteen_ways_to_turn_and_one_home():
    assert slews.COUNT == 19 and len(np.unique(slews.AXES_B, axis=0)) == 18
    np.testing.assert_allclose(np.linalg.norm(slews.AXES_B, axis=1), 1.0, rtol=1e-6)
    at = rested(19, 3)
    found = _slew(at, jnp.arange(19))
    np.testing.assert_allclose(found.angle[:18], slews.SLEW_ANGLE, rtol=1e-5)
    np.testing.assert_allclose(angle_between(at.body.q_BN, found.state.body.q_BN), found.angle, atol=1e-3)
    np.testing.assert_array_equal(found.state.body.omega_BN_B, 0.0)


def test_the_way_home_is_the_shortest_and_ends_at_the_target():
    at = rested(32, 5)
    left = np.asarray(at.angle)
    for _ in range(18):
        found = _slew(at, jnp.full(32, slews.COUNT - 1))
        at, expected = found.state, np.maximum(left - slews.SLEW_ANGLE, 0.0)
        np.testing.assert_allclose(at.angle, expected, atol=2e-3)
        left = expected
    assert np.all(jax.vmap(slews.is_there)(at))


def test_the_margin_is_the_smallest_on_the_way():
    at = rested(32, 7)
    choice = jnp.arange(32) % slews.COUNT
    found = _slew(at, choice)
    unit = jax.vmap(rotations.normalize)
    begin, end = at.body.q_BN, found.state.body.q_BN
    ways = [unit(begin * (1 - s) + end * s) for s in np.linspace(0.125, 1.0, 29)]
    smallest = jax.jit(jax.vmap(pointing_constraints.smallest_margin))
    along = np.min([smallest(way, at.scenario.constraints) for way in ways], axis=0)
    np.testing.assert_allclose(found.margin, along, atol=np.deg2rad(0.5))
    assert np.all(found.margin >= along - 1e-4)


@pytest.mark.slow
def test_it_flies_them():
    named = registry.load_controller("dqn")
    results = cases.fly_cases(named.controller, named.task, MonteCarloConfig(cases=50, seed=4, substeps=2))
    assert np.mean(results.success) > 0.95
