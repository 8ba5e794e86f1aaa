"""Reaction wheels: momentum is exchanged, not made, and the body moves as one without them."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.config.actuators.wheels import BRAKE_SHARE, WheelConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.task import dynamics
from koz_jax.task.actuators import ReactionWheels, from_config
from koz_jax.task.environment import Reorientation, model_from_config
from koz_jax.task.state import EnvState, Model, largest_rate

INERTIA = ((0.05, 0.002, 0.0), (0.002, 0.06, 0.001), (0.0, 0.001, 0.04))
TORQUE, MOMENTUM = 0.002, 0.03


def three(bias: float = 0.0) -> tuple[WheelConfig, ...]:
    """On the body axes."""
    wheel = functools.partial(WheelConfig, max_torque=TORQUE, max_momentum=MOMENTUM)
    return wheel(axis=(1, 0, 0), momentum=bias), wheel(axis=(0, 1, 0), momentum=-bias), wheel(axis=(0, 0, 1))


def pyramid(bias: float = 0.0) -> tuple[WheelConfig, ...]:
    """Four, at 54.7 deg from z."""
    side = float(1.0 / np.sqrt(3.0))
    axes = [(side, side, side), (-side, side, side), (-side, -side, side), (side, -side, side)]
    momenta = (bias, bias, -0.5 * bias, 0.2 * bias)
    return tuple(
        WheelConfig(axis=axis, max_torque=TORQUE, max_momentum=MOMENTUM, momentum=momentum)
        for axis, momentum in zip(axes, momenta, strict=True)
    )


def task_with(wheels: tuple[WheelConfig, ...], step_seconds: float = 0.1) -> TaskConfig:
    return TaskConfig(spacecraft=SpacecraftConfig(inertia=INERTIA, wheels=wheels), step_seconds=step_seconds)


SETS = {"three": three(), "pyramid": pyramid(), "three, biased": three(0.008), "pyramid, biased": pyramid(0.008)}
every_set = pytest.mark.parametrize("wheels", SETS.values(), ids=SETS)


def actuators_of(wheels: tuple[WheelConfig, ...]) -> ReactionWheels:
    found = from_config(SpacecraftConfig(inertia=INERTIA, wheels=wheels))
    assert isinstance(found, ReactionWheels)
    return found


@functools.partial(jax.jit, static_argnames="steps")
def _fly(env: Reorientation, key: jax.Array, steps: int, held: int = 10) -> EnvState:
    """Random commands, each for some steps.  Returns states, leaves (steps + 1, ...)."""
    commands = jax.random.uniform(key, (steps, 3), minval=-1.0, maxval=1.0)

    def advance(at: EnvState, i: jax.Array) -> tuple[EnvState, EnvState]:
        after = env.step(at, commands[i // held]).state
        return after, after

    start = env.reset(jax.random.key(0))
    _, states = jax.lax.scan(advance, start, jnp.arange(steps))
    return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, states)


@pytest.mark.slow
@every_set
def test_total_angular_momentum_stays(wheels):
    env = Reorientation.from_config(task_with(wheels))
    states = _fly(env, jax.random.key(1), 400)
    axes = np.array([wheel.axis for wheel in wheels])
    body = np.asarray(states.body.omega_BN_B, np.float64) @ np.array(INERTIA)
    stored = np.asarray(states.actuators, np.float64) @ axes
    total_N = oracle.rotation(states.body.q_BN).apply(body + stored)
    scale = np.linalg.norm(stored, axis=1).max()
    assert scale > 0.2 * MOMENTUM
    assert np.linalg.norm(total_N - total_N[0], axis=1).max() < 1e-5 * scale


@pytest.mark.slow
@every_set
def test_no_wheel_passes_its_torque_or_its_momentum(wheels):
    limit = 0.006
    small = tuple(
        wheel.model_copy(update={"max_momentum": limit, "momentum": 0.3 * wheel.momentum}) for wheel in wheels
    )
    env = Reorientation.from_config(task_with(small))
    for key in jax.random.split(jax.random.key(2), 3):
        momenta = np.asarray(_fly(env, key, 1000, held=200).actuators, np.float64)
        assert 0.99 * limit < np.abs(momenta).max() <= limit * (1 + 1e-5)
        assert np.abs(np.diff(momenta, axis=0)).max() <= TORQUE * 0.1 * (1 + 1e-4)


@every_set
def test_torque_is_shared_out_by_the_least_norm(wheels):
    made = actuators_of(wheels)
    axes = np.array([wheel.axis for wheel in wheels])
    np.testing.assert_allclose(axes.T @ np.asarray(made.allocation), np.eye(3), atol=1e-6)
    torque = np.array([3e-4, -2e-4, 4e-4])
    least = np.linalg.lstsq(axes.T, torque, rcond=None)[0]
    np.testing.assert_allclose(np.asarray(made.allocation) @ torque, least, rtol=1e-4, atol=1e-9)


@every_set
def test_every_corner_of_the_box_can_be_made_and_no_larger_box(wheels):
    made = actuators_of(wheels)
    corners = np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T * np.asarray(made.box_B)
    each = np.abs(corners @ np.asarray(made.allocation).T)
    assert each.max() == pytest.approx(TORQUE, rel=1e-5)
    assert float(made.brake_torque) == pytest.approx(BRAKE_SHARE * np.asarray(made.box_B).min(), rel=1e-6)


def test_a_torque_that_is_too_large_for_one_wheel_keeps_its_direction():
    """On a body so heavy that it does not begin to turn."""
    made, heavy_B, dt = actuators_of(pyramid()), 1e4 * jnp.array(INERTIA), jnp.float32(5.0)
    command = jnp.array([1.0, 1.0, 0.5])
    wanted_B = np.asarray(made.box_B * command)
    nearly_full = -0.95 * MOMENTUM * jnp.sign(made.allocation @ wanted_B)
    torque_B, after = made.apply(command, nearly_full, jnp.zeros(3), heavy_B, dt)
    share = np.linalg.norm(torque_B) / np.linalg.norm(wanted_B)
    assert 0.01 < share < 0.5
    np.testing.assert_allclose(torque_B, share * wanted_B, rtol=1e-3)
    np.testing.assert_allclose(np.abs(after).max(), MOMENTUM, rtol=1e-4)


def _difference(wheels: tuple[WheelConfig, ...], step_seconds: float) -> float:
    """Between a body on wheels and one of the same torques without, after 2 s [rad/s]."""
    model: Model = model_from_config(task_with(wheels, step_seconds))
    made, inertia_B, dt = actuators_of(wheels), model.inertia_B, model.dt
    wanted_B = 0.2 * made.box_B

    def advance(carry, _):
        on_wheels, without, state = carry
        limits = made.limits(state, on_wheels.omega_BN_B)
        torque_B, after = made.apply(wanted_B / limits.box_B, state, on_wheels.omega_BN_B, inertia_B, dt)
        stored = dynamics.StoredMomentum(made.stored_momentum(state), torque_B)
        moved = dynamics.step(on_wheels, torque_B, inertia_B, dt, stored)
        return (moved, dynamics.step(without, wanted_B, inertia_B, dt), after), None

    start = dynamics.RigidBodyState(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.02, -0.03, 0.04]))
    begin = (start, start, made.initial_state())
    (moved, without, _), _ = jax.lax.scan(advance, begin, None, length=round(2.0 / step_seconds))
    return float(jnp.linalg.norm(moved.omega_BN_B - without.omega_BN_B))


@pytest.mark.slow
@pytest.mark.parametrize("wheels", [three(0.008), pyramid(0.008)], ids=["three", "pyramid"])
def test_the_body_moves_as_one_without_wheels_but_for_the_square_of_the_step(wheels):
    coarse, fine = _difference(wheels, 1.0), _difference(wheels, 0.5)
    assert coarse < 1e-3 and coarse / fine > 3.0


@pytest.mark.slow
@every_set
def test_up_to_the_largest_rate_half_of_the_torque_is_left_and_no_wheel_is_full(wheels):
    """At any attitude: the total momentum is fixed, and any part of it may be the wheels' to hold."""
    model = model_from_config(task_with(wheels))
    at = Reorientation.from_config(task_with(wheels)).reset(jax.random.key(0))
    fastest = float(np.asarray(largest_rate(at, model)))
    assert fastest > 0.0
    made, rng = actuators_of(wheels), np.random.default_rng(0)
    at_rest = np.asarray(at.body.omega_BN_B, np.float64) @ np.array(INERTIA)
    axes = np.array([wheel.axis for wheel in wheels])
    start = np.array([wheel.momentum for wheel in wheels])
    total_B = at_rest + start @ axes
    idle = start - np.asarray(made.allocation) @ (start @ axes)
    for _ in range(200):
        omega_B = fastest * oracle.random_direction(rng)
        turned_B = oracle.rotation(oracle.random_attitude(rng)).apply(total_B)
        state = np.asarray(made.allocation) @ (turned_B - np.array(INERTIA) @ omega_B) + idle
        assert np.abs(state).max() <= MOMENTUM * (1 + 1e-4)
        left = made.limits(jnp.array(state), jnp.array(omega_B)).box_B
        assert np.all(np.asarray(left) >= BRAKE_SHARE * np.asarray(made.box_B) * (1 - 1e-4))


@pytest.mark.parametrize(
    ("wheels", "message"),
    [
        (three()[:2], "wheels must be at least three"),
        ((*three()[:2], three()[0]), "axes that do not lie in a plane"),
    ],
)
def test_wheels_that_cannot_turn_the_body_are_refused(wheels, message):
    with pytest.raises(ValueError, match=message):
        SpacecraftConfig(inertia=INERTIA, wheels=wheels)


def test_more_momentum_than_a_wheel_holds_is_refused():
    with pytest.raises(ValueError, match=r"momentum must be at most max_momentum = 0\.03 in size; got -0\.04"):
        WheelConfig(axis=(1, 0, 0), max_torque=TORQUE, max_momentum=MOMENTUM, momentum=-0.04)
