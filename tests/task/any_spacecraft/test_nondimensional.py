"""What a policy for any spacecraft sees and commands: the same for all of one shape, however they are turned."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.states import directions, quaternions

from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.task import dynamics, pointing_constraints, rotations, state
from koz_jax.task.actuators import TorqueBox
from koz_jax.task.any_spacecraft import nondimensional, units
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import model_from_config
from koz_jax.task.observation_layout import FREE_RATE, LONGEST_TIME, SHORTEST_STEP, layout, size, slices
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model

WHERE = slices(1, scaled=True)


def spacecraft(scale: float = 1.0, torque_scale: float = 1.0, max_rate_deg: float | None = None) -> Model:
    """A body with products of inertia and unequal torque limits, of any size and strength."""
    inertia = scale * np.array([[3.0, 0.4, 0.1], [0.4, 2.0, -0.2], [0.1, -0.2, 4.0]])
    body = SpacecraftConfig.model_validate(
        {
            "inertia": inertia.tolist(),
            "torque_limit": (0.5 * torque_scale, torque_scale, 0.8 * torque_scale),
            "max_rate_deg": max_rate_deg,
        }
    )
    own = units.of(model_from_config(TaskConfig(spacecraft=body)))
    return model_from_config(TaskConfig(spacecraft=body, step_seconds=float(0.02 * own.time)))


def maneuver(model: Model, rate: float = 0.3) -> EnvState:
    """A state with the same attitude, and the same rate in units of the spacecraft, for every spacecraft."""
    boresights_B = jnp.tile(jnp.array([0.6, 0.0, 0.8]), (2, 1))
    zones = PointingConstraint(boresights_B, directions(2, 3), jnp.array([0.4, 0.3]))
    start, target = quaternions(2, 1)
    body = RigidBodyState(start, rate / units.of(model).time * jnp.array([0.2, -0.7, 0.4]))
    return state.begin(Scenario(body, target, zones), model)


@pytest.mark.slow
def test_the_observation_has_the_entries_that_are_declared():
    seen = nondimensional.observe(maneuver(spacecraft()), spacecraft(), 0.5, zones=2)
    assert seen.shape == (size(2, scaled=True),) == (sum(layout(2, scaled=True).values()),)
    assert bool(jnp.all(jnp.isfinite(seen)))


@pytest.mark.slow
@pytest.mark.parametrize(("scale", "torque_scale"), [(1e-3, 1e-4), (1e3, 5.0)])
def test_spacecraft_of_one_shape_look_alike_and_ask_for_the_same_share(scale, torque_scale):
    small, large = spacecraft(), spacecraft(scale, torque_scale)
    seen, expected = (nondimensional.observe(maneuver(model), model, 0.3) for model in (small, large))
    np.testing.assert_allclose(seen, expected, atol=1e-5)
    action = jnp.array([0.3, -0.9, 0.1])
    share, other = (nondimensional.command(action, maneuver(model), model) for model in (small, large))
    np.testing.assert_allclose(share, other, rtol=1e-5)


@pytest.mark.slow
def test_a_turn_of_the_bodys_axes_that_keeps_the_policys_changes_nothing():
    """The same spacecraft in other body axes: observation and torque, seen from the policy's axes, stay."""
    model = spacecraft().replace(actuators=model_from_config(TaskConfig()).actuators)  # a cube of torques ...
    own = maneuver(model)
    boresight_B = own.scenario.constraints.boresight_B[0]
    axes = units.policy_axes(boresight_B)
    turned_model = model.replace(inertia_B=axes @ model.inertia_B @ axes.T)
    to_policy = _quaternion(axes)
    turned = own.replace(
        body=own.body.replace(
            q_BN=rotations.multiply(own.body.q_BN, rotations.conjugate(to_policy)),
            omega_BN_B=dynamics.matvec(axes, own.body.omega_BN_B),
        ),
        scenario=own.scenario.replace(
            q_DN=rotations.multiply(own.scenario.q_DN, rotations.conjugate(to_policy)),
            constraints=own.scenario.constraints.replace(boresight_B=jnp.tile(jnp.array([1.0, 0.0, 0.0]), (2, 1))),
        ),
    )
    seen = nondimensional.observe(own, model, 0.5), nondimensional.observe(turned, turned_model, 0.5)
    same = [name for name in WHERE if name not in {"reach", "stopping", "turning"}]  # ... which the turn does not keep
    for name in same:
        np.testing.assert_allclose(seen[0][WHERE[name]], seen[1][WHERE[name]], atol=2e-6, err_msg=name)
    action = jnp.array([0.2, -0.1, 0.3])
    first = dynamics.matvec(axes, nondimensional.command(action, own, model))
    np.testing.assert_allclose(first, nondimensional.command(action, turned, turned_model), atol=1e-6)


def test_it_is_time_to_brake_where_stopping_takes_as_long_as_turning():
    """About a principal axis, the full torque stops a rate w over the angle w^2 J / (2 u)."""
    body = SpacecraftConfig(inertia=((3.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 4.0)), torque_limit=(0.5, 1.0, 0.8))
    model = model_from_config(TaskConfig(spacecraft=body))
    own, angle = units.of(model), 0.02
    for axis, (moment, limit) in enumerate(zip((3.0, 2.0, 4.0), body.torque_limits, strict=True)):
        along = jnp.eye(3)[axis]
        at = maneuver(model)
        start = rotations.multiply(at.scenario.q_DN, jnp.concatenate([jnp.ones(1), 0.5 * angle * along]))
        rate = np.sqrt(2.0 * angle * limit / moment)
        turning = at.replace(body=RigidBodyState(rotations.normalize(start), -rate * along))
        seen = nondimensional.observe(turning, model, 0.5)
        time, half_square = np.asarray(seen[WHERE["stopping"]])
        assert time == pytest.approx(moment * rate / limit / float(own.time), rel=1e-5)
        assert half_square == pytest.approx(0.5 * time**2, rel=1e-6)
        assert float(seen[WHERE["turning"]][0]) == pytest.approx(half_square, rel=1e-3)


def test_times_are_bounded():
    """Of a rate that takes long to stop, and of a weak axis that is hardly turned at all."""
    model = spacecraft()
    weak = model.replace(actuators=TorqueBox(jnp.array([1e-3, 1.0, 1.0])))
    seen = nondimensional.observe(maneuver(weak, rate=1e3), weak, 0.5)
    np.testing.assert_array_equal(seen[WHERE["stopping"]], [LONGEST_TIME, LONGEST_TIME**2 / 2])
    np.testing.assert_array_equal(seen[WHERE["turning"]], [LONGEST_TIME**2 / 2])


def test_an_action_is_an_angular_acceleration_along_the_policys_axes():
    model = spacecraft()
    at = maneuver(model, rate=0.0)
    share = nondimensional.command(jnp.array([0.1, 0.0, 0.0]), at, model)
    torque_B = np.asarray(share * model.actuators.limits(None, jnp.zeros(3)).box_B, np.float64)
    acceleration_B = np.linalg.solve(np.asarray(model.inertia_B, np.float64), torque_B)
    expected = 0.1 * nondimensional.FULL_ACTION * float(units.of(model).acceleration)
    boresight_B = np.asarray(at.scenario.constraints.boresight_B[0])
    np.testing.assert_allclose(acceleration_B, expected * boresight_B, atol=1e-5 * expected)


def test_entries_of_step_rate_limit_and_urgency():
    free, limited = spacecraft(), spacecraft(max_rate_deg=5.0)
    for model in (free, limited):
        seen = nondimensional.observe(maneuver(model), model, 0.25)
        np.testing.assert_allclose(seen[WHERE["step"]], np.log(0.02 / SHORTEST_STEP), rtol=1e-4)
        np.testing.assert_allclose(seen[WHERE["urgency"]], -0.5)
    expected = np.log(np.deg2rad(5.0) * float(units.of(limited).time) / FREE_RATE)
    np.testing.assert_allclose(
        nondimensional.observe(maneuver(limited), limited, 0.5)[WHERE["rate_limit"]], expected, rtol=1e-4
    )
    assert float(nondimensional.observe(maneuver(free), free, 0.5)[WHERE["rate_limit"]][0]) == 0.0


def test_the_reach_is_the_largest_torque_of_the_box_along_each_axis():
    model, at = spacecraft(), maneuver(spacecraft())
    axes = np.asarray(units.policy_axes(at.scenario.constraints.boresight_B[0]), np.float64)
    box = np.array([0.5, 1.0, 0.8])
    reach = np.asarray(nondimensional.observe(at, model, 0.5)[WHERE["reach"]]) * float(units.of(model).torque)
    for axis, length in zip(axes, reach, strict=True):
        assert np.max(np.abs(length * axis) / box) == pytest.approx(1.0, rel=1e-5)


def test_margins_and_angles_are_those_of_the_zone():
    at = maneuver(spacecraft())
    seen = nondimensional.observe(at, spacecraft(), 0.5)
    margin = pointing_constraints.smallest_margin(at.body.q_BN, at.scenario.constraints)
    np.testing.assert_allclose(seen[WHERE["zone_margin"]][0], margin, rtol=1e-6)


def _quaternion(matrix: jax.Array) -> jax.Array:
    """Quaternion q with v_P = rotate(q, v_B) for v_P = matrix v_B."""
    w = 0.5 * jnp.sqrt(1.0 + jnp.trace(matrix))
    vector = jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    return jnp.concatenate([w[None], vector / (4.0 * w)])
