"""What the brake path promises, from the edge of the safe set on, against an independent float64 integration."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle, states

from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.shield import brake_path
from koz_jax.control.shield import filter as shield
from koz_jax.control.shield.filter import Shield
from koz_jax.task import environment
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.state import Model

EDGE_STATES = 32
INSTANTS = 20  # of a step, at which the float64 twin is looked at

SHAPES = {
    "paper": oracle.INERTIA,
    "flat": np.diag([40.0, 42.0, 80.0]),
    "slender": np.diag([10.0, 50.0, 50.0]),
    "slender across": np.diag([50.0, 10.0, 50.0]),
}


def _model(inertia: np.ndarray, step_seconds: float) -> Model:
    """A spacecraft with the torque limit of 2 N m, whose boresight is the x axis."""
    settings = {"spacecraft": {"inertia": inertia.tolist()}, "step_seconds": step_seconds}
    return environment.model_from_config(TaskConfig.model_validate(settings))


def _directions(rng: np.random.Generator, count: int) -> np.ndarray:
    drawn = rng.normal(size=(count, 3))
    return drawn / np.linalg.norm(drawn, axis=1, keepdims=True)


def _edge_of_the_safe_set(
    made: Shield, model: Model, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The fastest rates about random axes that are still called safe, by bisection, with a zone near by."""
    rng = np.random.default_rng(seed)
    q = np.tile(np.eye(4)[0], (EDGE_STATES, 1))
    turns = _directions(rng, EDGE_STATES)
    # A zone that is in the way of the boresight.
    ahead = np.cross(turns, oracle.BORESIGHT)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    away = rng.uniform(0.3, 1.2, size=(EDGE_STATES, 1))
    axes = np.cos(away) * oracle.BORESIGHT + np.sin(away) * (ahead + 0.2 * rng.normal(size=ahead.shape))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half_angles = oracle.angle_between(axes, oracle.BORESIGHT) - rng.uniform(0.01, 0.25, size=EDGE_STATES)
    zones = PointingConstraint(
        jnp.broadcast_to(states.LOOK, (EDGE_STATES, 1, 3)),
        jnp.asarray(axes[:, None], jnp.float32),
        jnp.asarray(half_angles[:, None], jnp.float32),
    )

    low, high = np.zeros(EDGE_STATES), np.full(EDGE_STATES, 1.0)
    for _ in range(24):
        middle = 0.5 * (low + high)
        bodies = RigidBodyState(jnp.float32(q), jnp.float32(middle)[:, None] * jnp.float32(turns))
        passed = np.asarray(_safe(made, model, bodies, zones))
        low, high = np.where(passed, middle, low), np.where(passed, high, middle)
    return q, low[:, None] * turns, axes, half_angles


def _smallest_margins(
    made: Shield, model: Model, q: np.ndarray, omega: np.ndarray, axes: np.ndarray, half_angles: np.ndarray
) -> np.ndarray:
    """Margin while the brake works until all are at rest, in double precision, many times a step.  Returns (n,)."""
    inertia, dt = np.asarray(model.inertia_B, np.float64), float(model.dt)
    q, omega = q.copy(), omega.copy()
    smallest = np.full(len(q), np.inf)
    moving = np.arange(len(q))
    for _ in range(2000):
        torques = np.asarray(_brake(made, model, RigidBodyState(jnp.float32(q), jnp.float32(omega))), np.float64)
        passed = []
        for _ in range(INSTANTS):
            now = oracle.propagate_many(q[moving], omega[moving], torques[moving], dt / INSTANTS, inertia)
            q[moving], omega[moving] = now
            passed.append(now[0])
        looks = oracle.rotation(np.concatenate(passed)).apply(oracle.BORESIGHT).reshape(INSTANTS, len(moving), 3)
        margins = oracle.angle_between(looks, axes[moving]) - half_angles[moving]
        smallest[moving] = np.minimum(smallest[moving], margins.min(axis=0))
        # What has come to rest stays where it is.
        moving = moving[np.linalg.norm(omega[moving], axis=1) >= 1e-5]
        if not len(moving):
            return smallest
    raise AssertionError("the brake does not come to rest")


@jax.jit
def _safe(made: Shield, model: Model, bodies: RigidBodyState, zones: PointingConstraint) -> jax.Array:
    return jax.vmap(lambda body, zone: shield.is_safe(made, body, zone, model))(bodies, zones)


@jax.jit
def _brake(made: Shield, model: Model, bodies: RigidBodyState) -> jax.Array:
    return jax.vmap(lambda body: brake_path.torque(made.brake, body, model))(bodies)


@pytest.mark.slow
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("step", [0.02, 0.1, 0.2, 0.5, 1.0])
def test_braking_from_the_edge_of_the_safe_set_keeps_the_margin(shape, step):
    """step: dt in units of T = sqrt(J / u)."""
    inertia = SHAPES[shape]
    model = _model(inertia, step * np.sqrt(np.trace(inertia) / 3.0 / 2.0))
    made = shield.from_config(ShieldConfig(), model)
    q, omega, axes, half_angles = _edge_of_the_safe_set(made, model, seed=int(1000 * step))
    assert np.linalg.norm(omega, axis=1).min() > 0.0
    assert np.all(_smallest_margins(made, model, q, omega, axes, half_angles) >= float(made.margin) - 1e-5)


@pytest.mark.slow
def test_a_step_of_the_brake_that_is_longer_than_it_needs_is_counted():
    """A state of the paper's spacecraft at steps of 1 s that was called safe, and came 0.1 deg into the zone."""
    model = _model(oracle.INERTIA, 1.0)
    made = shield.from_config(ShieldConfig(), model)
    omega = np.array([-1.8656e-4, -5.3635e-4, 1.387513e-2])
    axis, half_angle = np.array([0.86345534, 0.50404884, 0.01948424]), np.deg2rad(30.0)
    one = np.eye(4)[:1]
    found = _smallest_margins(made, model, one, omega[None], axis[None], np.array([half_angle]))
    assert np.rad2deg(found[0]) < 0.0
    zone = PointingConstraint(states.LOOK[None], jnp.float32(axis)[None], jnp.float32(half_angle)[None])
    body = RigidBodyState(jnp.float32(one[0]), jnp.float32(omega))
    assert not shield.is_safe(made, body, zone, model)


def test_the_free_motion_of_whole_and_of_broken_steps_adds_up():
    """Seconds of free motion of a brake by k dt a step, its momentum falling linearly in each: summed step by step."""
    model = _model(oracle.INERTIA, 0.5)
    brake = shield.from_config(ShieldConfig(), model).brake
    whole = float(brake.torque) * 0.5
    for momentum in [1e-4, 0.3 * whole, whole, 1.5 * whole, 7.2 * whole]:
        left, seconds = momentum, 0.0
        while left > 0.0:
            after = max(left - whole, 0.0)
            seconds += 0.5 * (left + after) / momentum * 0.5
            left = after
        found = brake_path._free_seconds(brake, jnp.float32(momentum), jnp.float32(0.5))
        np.testing.assert_allclose(found, seconds, rtol=1e-4)


def test_the_bound_on_the_speed_of_a_boresight_is_reached_and_not_passed():
    rng = np.random.default_rng(0)
    for inertia in SHAPES.values():
        inverse = np.linalg.inv(inertia)
        for look in _directions(rng, 5):
            bound = float(brake_path._speed_per_momentum(jnp.float32(look), jnp.float32(inverse)))
            speeds = np.linalg.norm(np.cross(_directions(rng, 20000) @ inverse, look), axis=1)
            assert 0.97 * bound < speeds.max() <= bound * (1 + 1e-5)
