"""The control-barrier-function filter: its programme against SciPy, its barrier, and what it keeps in a step."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from support import oracle, states

from koz_jax.config.filters import ZohCbfConfig
from koz_jax.control.filters import barrier, nearest_torque
from koz_jax.control.filters.barrier import Bounds, Look, Motion
from koz_jax.control.filters.from_settings import action_filter
from koz_jax.control.filters.nearest_torque import Ellipsoid, Halfspaces
from koz_jax.control.filters.zoh_cbf import ZohCbf
from koz_jax.task import dynamics, pointing_constraints
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import Allowed, EnvState, torque_limits

MODEL = states.MODEL
INVERSE_B = dynamics.inverse(MODEL.inertia_B)
BOX = np.array([2.0, 1.5, 1.0])
PROGRAMMES, STATES = 30, 200
nearest = jax.jit(jax.vmap(nearest_torque.nearest, in_axes=(0, None, 0, 0)))


@functools.cache
def made() -> ZohCbf:
    found = action_filter(ZohCbfConfig(samples=500), MODEL)
    assert isinstance(found, ZohCbf)
    return found


# --- the programme ---


def _programmes(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Requests, normals, limits, and the ellipsoids' forms, slopes, rooms; zero torque is always allowed."""
    rng = np.random.default_rng(0)
    normals = rng.standard_normal((count, 2, 3))
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    roots = rng.standard_normal((count, 3, 3))
    forms = 0.3 * roots @ roots.transpose(0, 2, 1) + 0.1 * np.eye(3)
    slopes, rooms = rng.standard_normal((count, 3)), rng.uniform(0.01, 1.0, count)
    return rng.uniform(-1, 1, (count, 3)) * BOX, normals, rng.uniform(0.0, 1.0, (count, 2)), forms, slopes, rooms


def _single(
    requests: np.ndarray,
    normals: np.ndarray,
    limits: np.ndarray,
    forms: np.ndarray,
    slopes: np.ndarray,
    rooms: np.ndarray,
) -> tuple[jax.Array, jax.Array, Halfspaces, Ellipsoid]:
    """In single precision, as ``nearest`` takes them."""
    arrays = [jnp.asarray(values, jnp.float32) for values in (requests, BOX, normals, limits, forms, slopes, rooms)]
    return arrays[0], arrays[1], Halfspaces(*arrays[2:4]), Ellipsoid(*arrays[4:])


@pytest.mark.slow
def test_the_torque_is_that_of_scipys_solver():
    requests, normals, limits, forms, slopes, rooms = _programmes(PROGRAMMES)
    found = nearest(*_single(requests, normals, limits, forms, slopes, rooms))
    assert np.all(found.exists)
    for i, request in enumerate(requests):
        constraints = [
            {"type": "ineq", "fun": lambda u, i=i: limits[i] - normals[i] @ u},
            {"type": "ineq", "fun": lambda u, i=i: rooms[i] - u @ forms[i] @ u - slopes[i] @ u},
        ]
        best = minimize(
            lambda u, request=request: np.sum((u - request) ** 2),
            np.zeros(3),
            bounds=list(zip(-BOX, BOX, strict=True)),
            constraints=constraints,
            options={"ftol": 1e-12},
        )
        np.testing.assert_allclose(found.torque_B[i], best.x, atol=2e-3)


def test_a_programme_without_a_solution_is_told():
    requests, normals, limits, forms, slopes, rooms = _programmes(PROGRAMMES)
    # More than the box holds; two that exclude each other.
    normals[0], limits[0] = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([-2.1, 1.0])
    normals[1], limits[1] = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]), np.array([-0.1, -0.1])
    # Less energy than any torque leads to.
    rooms[2] = -1e3
    found = nearest(*_single(requests, normals, limits, forms, slopes, rooms))
    assert np.flatnonzero(~np.asarray(found.exists)).tolist() == [0, 1, 2]


# --- the barrier ---


def _looks(count: int) -> Look:
    slow = 0.01 * states.directions(count, 3)
    rates = 0.15 * states.directions(count, 2)
    return Look(states.directions(count, 0), states.directions(count, 1), slow, rates)


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, 0, None))
def _slopes(look: Look, torque_B: jax.Array, seconds: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Derivatives as the module has them, and differences over a time: rows of kappa', phi, phi'."""
    upright = jnp.array([1.0, 0.0, 0.0, 0.0])

    def at(time: jax.Array) -> Look:
        body = dynamics.step(RigidBodyState(upright, look.omega_BN_B), torque_B, MODEL.inertia_B, time)
        zone = PointingConstraint(look.boresight_B[None], look.axis_B[None], jnp.ones(1), look.axis_rate_B[None])
        turned = pointing_constraints.later(zone, time)
        seen = pointing_constraints.axis_B(body.q_BN, jax.tree.map(lambda leaf: leaf[0], turned))
        rate_B = pointing_constraints.axis_B(body.q_BN, zone.replace(axis_N=look.axis_rate_B))
        return Look(look.boresight_B, seen, rate_B, body.omega_BN_B)

    def of(look: Look) -> jax.Array:
        one = barrier.motion(look, jnp.float32(0.0), MODEL.inertia_B, INVERSE_B)
        return jnp.stack([one.kappa, one.rate, one.free + one.row @ torque_B])

    third = barrier.third_derivative(look, torque_B, MODEL.inertia_B, INVERSE_B)
    differences = (of(at(seconds)) - of(at(-seconds))) / (2.0 * seconds)
    return jnp.concatenate([of(look)[1:], third[None]]), differences


@pytest.mark.slow
def test_derivatives_are_those_of_the_motion():
    torques_B = 2.0 * states.directions(50, 4)
    found, expected = _slopes(_looks(50), torques_B, jnp.float32(0.1))
    np.testing.assert_allclose(found, expected, atol=3e-4)


def test_at_the_largest_second_derivative_the_barrier_is_just_kept():
    """In double precision, for states that move towards the cone and away from it, near it and far."""
    rng = np.random.default_rng(1)
    mu, third, dt = 0.012, 0.03, 0.1
    bounds = Bounds(jnp.float32(mu), jnp.float32(0.001), jnp.float32(third))
    delta = (mu + 0.002) * (dt / 2) ** 2 / 2 + third * (dt / 2) ** 3 / 6
    for kappa, rate in zip(rng.uniform(-0.5, 0.05, 50), rng.uniform(-0.1, 0.1, 50), strict=True):
        at = Motion(jnp.float32(kappa), jnp.float32(rate), jnp.float32(0.0), jnp.zeros(3))
        phi = float(barrier.largest_second_derivative(at, bounds, jnp.float32(dt)))
        after = kappa + rate * dt + (phi + 0.001) * dt**2 / 2 + third * dt**3 / 6
        slope = rate + (phi + 0.001) * dt + third * dt**2 / 2
        assert max(after, after + slope * abs(slope) / (2 * mu)) == pytest.approx(-delta, abs=1e-5)


@pytest.mark.parametrize(("angle_deg", "rate_deg"), [(15.0, 25.0), (30.0, 20.9), (90.0, 13.0)])
def test_the_papers_spacecraft_loses_its_authority_at_the_published_rates(angle_deg, rate_deg):
    count = 4000
    angle, around = np.deg2rad(angle_deg), np.random.default_rng(2).uniform(0, 2 * np.pi, count)
    aside = np.sin(angle) * np.stack([0 * around, np.cos(around), np.sin(around)], axis=1)
    axes = jnp.asarray(np.cos(angle) * np.array([1.0, 0.0, 0.0]) + aside, jnp.float32)
    looks = Look(jnp.tile(states.LOOK, (count, 1)), axes, jnp.zeros((count, 3)), states.directions(count, 5))
    at = jax.vmap(barrier.motion, in_axes=(0, None, None, None))(looks, jnp.float32(angle), MODEL.inertia_B, INVERSE_B)
    # Without a torque the second derivative grows with the square of the rate.
    authority = 2.0 * np.abs(at.row).sum(axis=1)
    lost = np.rad2deg(np.sqrt((authority / np.maximum(at.free, 1e-9)).min()))
    assert rate_deg - 0.1 < lost < 1.06 * rate_deg


@pytest.mark.slow
def test_up_to_the_published_rate_limit_a_torque_is_found_at_the_edge_of_every_cone():
    limits = made().limits
    assert np.all(np.asarray(limits.failures) == 0.0)
    assert np.all(np.asarray(limits.decelerations) > 0.0)
    # Cones of up to 90 deg do not ask for less than the limit; those to be kept in do.
    fastest = np.rad2deg(np.sqrt(np.asarray(limits.energies) / np.linalg.eigvalsh(MODEL.inertia_B)[0]))
    assert np.all(np.abs(fastest[:8] - 10.0) < 0.01) and np.all(np.diff(fastest[8:]) < 0.0)


# --- a step ---


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def _stepped(filtered: ZohCbf, at: EnvState, action: jax.Array) -> tuple[jax.Array, Allowed, EnvState]:
    allowed = filtered.allow(at, action, MODEL)
    body = dynamics.step(at.body, torque_limits(at, MODEL).box_B * allowed.action, MODEL.inertia_B, MODEL.dt)
    return filtered.covers(at, MODEL), allowed, at.replace(body=body)


def _with_three_cones(at: EnvState) -> EnvState:
    """A telescope and a second instrument that are kept out of a cone each, and a third that is kept in a wide one."""
    zones = at.scenario.constraints
    looks_B = zones.boresight_B.at[:, 1:].set(jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
    half_angle = jnp.tile(jnp.array([0.4, 0.3, np.pi - 1.9]), (STATES, 1))
    return at.replace(
        scenario=at.scenario.replace(constraints=zones.replace(boresight_B=looks_B, half_angle=half_angle))
    )


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0, 0))
def _at_the_edge(filtered: ZohCbf, at: EnvState, direction_B: jax.Array) -> EnvState:
    """With the fastest rate in a direction that is in the allowed set."""
    rates_B = jnp.linspace(0.0, 0.2, 100)[:, None] * direction_B[None]
    moving = jax.vmap(lambda rate_B: at.replace(body=at.body.replace(omega_BN_B=rate_B)))(rates_B)
    covered = jax.vmap(filtered.covers, in_axes=(0, None))(moving, MODEL)
    return jax.tree.map(lambda leaf: leaf[jnp.argmin(covered) - 1], moving)


@pytest.mark.slow
def test_a_step_from_the_allowed_set_ends_in_it_whatever_is_asked_for():
    at = _with_three_cones(states.random_states(STATES, 7))
    first = jax.tree.map(lambda leaf: leaf[:, 0], at.scenario.constraints)
    axis_B = jax.vmap(pointing_constraints.axis_B)(at.body.q_BN, first)
    towards_B = jnp.cross(first.boresight_B, axis_B) + 0.5 * states.directions(STATES, 8)
    at = _at_the_edge(made(), at, towards_B / jnp.linalg.norm(towards_B, axis=1, keepdims=True))
    actions = jnp.sign(towards_B)
    covered, allowed, after = _stepped(made(), at, actions)
    still, _, _ = _stepped(made(), after, actions)
    intervened = np.any(np.asarray(allowed.action != actions), axis=1)
    assert np.sum(covered & intervened) > 100
    # Cones of several instruments at once are not looked at when the bounds are found.
    assert np.mean(np.asarray(allowed.feasible)[covered]) > 0.98
    assert np.all(np.asarray(still)[covered & allowed.feasible])


@pytest.mark.slow
def test_a_request_that_is_safe_passes_unchanged():
    at = states.random_states(STATES, 0, rate=0.0)
    zones = at.scenario.constraints.replace(axis_N=jnp.tile(-states.LOOK, (STATES, 3, 1)))
    looking = at.body.replace(q_BN=jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (STATES, 1)))
    at = at.replace(body=looking, scenario=at.scenario.replace(constraints=zones))
    actions = states.directions(STATES, 5)
    covered, allowed, _ = _stepped(made(), at, actions)
    assert np.all(covered) and np.all(allowed.feasible)
    np.testing.assert_array_equal(allowed.action, actions)


def test_a_body_that_is_too_fast_is_braked():
    at = states.random_states(STATES, 3, rate=0.4)
    covered, _, after = _stepped(made(), at, jnp.ones((STATES, 3)))
    rates = [np.asarray(state.body.omega_BN_B, np.float64) for state in (at, after)]
    before, later = (np.sum(rate @ oracle.INERTIA * rate, axis=1) for rate in rates)
    assert not np.any(covered) and np.mean(later < before) > 0.9
