"""Control moment gyros: momentum is exchanged, not made, and a pyramid is steered through its singular arrangements."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pydantic import ValidationError
from support import oracle, states

from koz_jax.config.actuators.gyros import BOX_SHARE, GyroConfig, PyramidConfig
from koz_jax.config.filters import FilterConfig, ZohCbfConfig
from koz_jax.config.maneuvers.maneuver_tables import BodyConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.control.filters.from_settings import action_filter
from koz_jax.errors import SettingsError
from koz_jax.task import dynamics
from koz_jax.task.actuators import ROTORS_USED, ControlMomentGyros, from_config
from koz_jax.task.environment import Reorientation, model_from_config
from koz_jax.task.gyros.gimbals import SINGULAR
from koz_jax.task.state import EnvState

INERTIA = ((0.62, 0.0, 0.01), (0.0, 0.7, 0.0), (0.01, 0.0, 0.5))
MOMENTUM, RATE_DEG, STEP = 0.056, 30.0, 0.1
PYRAMID = PyramidConfig(momentum=MOMENTUM, max_gimbal_rate_deg=RATE_DEG).gyros
SPACECRAFT = SpacecraftConfig(inertia=INERTIA, gyros=PYRAMID)
ENV = Reorientation.from_config(TaskConfig(spacecraft=SPACECRAFT, step_seconds=STEP))
# The arrangement in which no gyro gives a torque about x.
NO_TORQUE_ABOUT_X = jnp.deg2rad(jnp.array([-90.0, 0.0, 90.0, 0.0]))


def made() -> ControlMomentGyros:
    found = from_config(SPACECRAFT)
    assert isinstance(found, ControlMomentGyros)
    return found


@functools.cache
def _flown(held: int = 40, steps: int = 600) -> tuple[EnvState, np.ndarray]:
    """Random commands, each for some steps.  Returns states, leaves (steps + 1, ...), and the commands."""

    @jax.jit
    def fly(env: Reorientation, commands: jax.Array) -> EnvState:
        start = env.reset(jax.random.key(0))

        def advance(at: EnvState, command: jax.Array) -> tuple[EnvState, EnvState]:
            after = env.step(at, command).state
            return after, after

        _, after = jax.lax.scan(advance, start, commands)
        return jax.tree.map(lambda first, rest: jnp.concatenate([first[None], rest]), start, after)

    commands = jnp.repeat(jax.random.uniform(jax.random.key(1), (steps // held, 3), minval=-1.0), held, axis=0)
    return fly(ENV, commands), np.asarray(commands)


@pytest.mark.slow
def test_total_angular_momentum_stays():
    flown, _ = _flown()
    stored = np.asarray(jax.vmap(made().gimbals.momentum)(flown.actuators.angles), np.float64)
    body = np.asarray(flown.body.omega_BN_B, np.float64) @ np.array(INERTIA)
    total_N = oracle.rotation(flown.body.q_BN).apply(body + stored)
    scale = np.linalg.norm(stored, axis=1).max()
    assert scale > MOMENTUM
    assert np.linalg.norm(total_N - total_N[0], axis=1).max() < 2e-5 * scale


@pytest.mark.slow
def test_no_gimbal_turns_faster_than_it_can():
    rates = np.diff(np.asarray(_flown()[0].actuators.angles, np.float64), axis=0) / STEP
    assert np.rad2deg(np.abs(rates)).max() < RATE_DEG * (1 + 1e-3)


def test_the_torque_is_what_was_asked_for_but_near_singular_arrangements():
    """Beside what the gyros' own momentum takes, and to second order in the step."""
    flown, commands = _flown()
    angles, omega_B = flown.actuators.angles, np.asarray(flown.body.omega_BN_B)
    held_B = np.asarray(jax.vmap(made().gimbals.momentum)(angles))
    middle_B = 0.5 * (np.cross(omega_B, held_B)[1:] + np.cross(omega_B, held_B)[:-1])
    missing = np.asarray(flown.torque_B)[1:] - middle_B - commands * np.asarray(made().box_B)
    rates = np.diff(np.asarray(angles, np.float64), axis=0) / STEP
    regular: np.ndarray = np.asarray(jax.vmap(made().gimbals.manipulability)(angles))[1:] > 0.7
    free = regular & (np.rad2deg(np.abs(rates)).max(axis=1) < 0.95 * RATE_DEG)
    assert free.sum() > 200
    assert np.abs(missing[free]).max() < 0.02 * float(made().box_B[0])


def test_the_momenta_of_a_pyramid_cancel_at_zero_and_its_manipulability_is_that_of_its_geometry():
    gimbals = made().gimbals
    np.testing.assert_allclose(gimbals.momentum(jnp.zeros(4)), np.zeros(3), atol=1e-8)
    # J J' = diag(2 cos^2, 2 cos^2, 4 sin^2) of the skew.
    cosine, sine = np.cos(np.deg2rad(54.74)), np.sin(np.deg2rad(54.74))
    assert float(gimbals.manipulability(jnp.zeros(4))) == pytest.approx(4 * cosine**2 * sine, rel=1e-5)
    assert float(gimbals.manipulability(NO_TORQUE_ABOUT_X)) < 1e-3
    np.testing.assert_allclose(gimbals.slopes(NO_TORQUE_ABOUT_X)[0], np.zeros(4), atol=1e-6)


@jax.jit
@functools.partial(jax.vmap, in_axes=(None, 0))
def _taken_up(gyros: ControlMomentGyros, direction_B: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Momentum and manipulability while the gyros take up momentum in a direction, from gimbal angle zero."""
    gimbals = gyros.gimbals

    def advance(angles: jax.Array, seconds: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        missing_B = seconds / 10.0 * MOMENTUM * direction_B - gimbals.momentum(angles)
        after = angles + STEP * gimbals.steer(angles, missing_B / STEP, seconds)
        return after, (jnp.linalg.norm(gimbals.momentum(after)) / gimbals.unit, gimbals.manipulability(after))

    return jax.lax.scan(advance, jnp.zeros(4), STEP * jnp.arange(1, 151))[1]


def test_up_to_the_largest_rate_no_arrangement_is_singular_and_beyond_it_some_are():
    momenta, manipulability = map(np.asarray, _taken_up(made(), states.directions(100, 0)))
    np.testing.assert_allclose(momenta[:, 99], 1.0, atol=0.02)
    assert manipulability[momenta < ROTORS_USED].min() > SINGULAR
    along_x = jnp.tile(jnp.array([1.0, 0.0, 0.0]), (100, 1))
    assert np.asarray(_taken_up(made(), along_x)[1]).min() < SINGULAR


def test_a_singular_arrangement_is_left():
    """Where the damped inverse alone would stay for ever: a torque is asked for that no gimbal gives."""
    gimbals, angles = made().gimbals, NO_TORQUE_ABOUT_X
    steer = jax.jit(gimbals.steer)
    for i in range(300):
        angles = angles + STEP * steer(angles, jnp.array([-0.005, 0.0, 0.0]), jnp.float32(STEP * i))
    assert float(gimbals.manipulability(angles)) > SINGULAR
    assert float(gimbals.momentum(angles)[0]) < float(gimbals.momentum(NO_TORQUE_ABOUT_X)[0]) - 0.1 * MOMENTUM


def test_the_box_takes_a_share_of_the_gimbal_rates_at_the_start():
    gimbals = made().gimbals
    corners = jnp.asarray(np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, -1).T, jnp.float32) * made().box_B[None]
    rates = jax.vmap(lambda torque_B: gimbals.steer(jnp.zeros(4), torque_B, jnp.zeros(())))(corners)
    assert np.rad2deg(np.abs(rates).max()) == pytest.approx(BOX_SHARE * RATE_DEG, rel=1e-3)


@pytest.mark.parametrize("config", [ShieldConfig(), ZohCbfConfig()], ids=["shield", "zoh_cbf"])
def test_filters_that_count_on_the_torque_refuse_gyros(config: FilterConfig):
    with pytest.raises(SettingsError, match=rf"{config.name}: must have .* singular arrangement; allowed are"):
        action_filter(config, model_from_config(TaskConfig(spacecraft=SPACECRAFT)))


def test_what_has_no_gyros_is_written_as_before_there_were_any():
    assert "gyros" not in SpacecraftConfig().model_dump() and "gyros" not in TaskConfig().model_dump_json()
    task = TaskConfig(spacecraft=SPACECRAFT)
    assert TaskConfig.model_validate_json(task.model_dump_json()) == task


def test_a_file_has_one_kind_of_actuators():
    pyramid = {"momentum": MOMENTUM, "max_gimbal_rate_deg": RATE_DEG}
    body = BodyConfig.model_validate({"inertia": INERTIA, "gyros": pyramid})
    assert body.spacecraft((1.0, 0.0, 0.0)).gyros == PYRAMID
    for more, got in (({"gyros": pyramid, "torque_limit": 1.0}, "torque_limit and gyros"), ({}, "none")):
        with pytest.raises(ValidationError, match=f"must have one of torque_limit, wheels and gyros; got {got}"):
            BodyConfig.model_validate({"inertia": INERTIA, **more})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"gimbal_axis": (0.0, 0.0, 2.0)}, r"gimbal_axis must be a unit vector; .* has length 2"),
        ({"rotor_axis": (0.0, 0.6, 0.8)}, r"rotor_axis must be square to gimbal_axis; got \(0\.0, 0\.6, 0\.8\), 0\.8"),
        ({"momentum": 0.0}, "momentum"),
    ],
)
def test_a_gyro_that_cannot_be_is_refused(changes, message):
    right = {
        "gimbal_axis": (0.0, 0.0, 1.0),
        "rotor_axis": (1.0, 0.0, 0.0),
        "momentum": 1.0,
        "max_gimbal_rate_deg": 10.0,
    }
    with pytest.raises(ValidationError, match=message):
        GyroConfig.model_validate(right | changes)


def test_gyros_that_cannot_turn_the_body_are_refused():
    with pytest.raises(ValidationError, match=r"gyros must be at least three, .* got 2 along"):
        SpacecraftConfig(inertia=INERTIA, gyros=PYRAMID[:2])


def test_a_body_moves_by_the_torque_that_its_gyros_give():
    """Against the float64 twin: the mean torque of a step, and the gyroscopic one of the momentum that is held."""
    flown, _ = _flown()
    i = 300
    at = jax.tree.map(lambda leaf: leaf[i], flown)
    held_B, torque_B = made().gimbals.momentum(at.actuators.angles), flown.torque_B[i + 1]
    q, omega = oracle.propagate(
        np.asarray(at.body.q_BN, np.float64),
        np.asarray(at.body.omega_BN_B, np.float64),
        np.asarray(torque_B - jnp.cross(at.body.omega_BN_B, held_B), np.float64),
        STEP,
        np.array(INERTIA),
    )
    moved = dynamics.step(at.body, torque_B, jnp.array(INERTIA), STEP, dynamics.StoredMomentum(held_B, torque_B))
    np.testing.assert_allclose(moved.omega_BN_B, flown.body.omega_BN_B[i + 1], atol=1e-7)
    np.testing.assert_allclose(omega, flown.body.omega_BN_B[i + 1], atol=2e-4)
    np.testing.assert_allclose(q, flown.body.q_BN[i + 1], atol=2e-5)
