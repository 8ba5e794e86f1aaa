"""What all controllers promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import states

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control import registry
from koz_jax.control.path_planner import PathPlanner
from koz_jax.control.potential import PotentialFeedback
from koz_jax.control.quaternion_feedback import QuaternionFeedback
from koz_jax.control.sliding_mode import PotentialSliding
from koz_jax.evaluation import cases
from koz_jax.task import pointing_constraints, rotations

NAMES = (*registry.CLASSICAL, *registry.ADVERSARIAL)


# Refinement chooses among near equals, and rounding may decide; without it the planner is compared exactly.
CLASSICAL = [
    QuaternionFeedback(),
    PotentialFeedback(),
    PotentialSliding(),
    PathPlanner(rounds=0),
]


@pytest.mark.parametrize("name", NAMES)
def test_actions_are_finite_and_in_the_box_everywhere(name):
    controller = PathPlanner(rounds=0) if name == "planner" else registry.load_controller(name).controller
    for at in (states.special_states(), states.random_states(32, 5, rate=1.0)):
        found = states.actions(controller, at)
        assert np.all(np.isfinite(found))
        assert np.all(np.abs(found) <= 1.0)


@pytest.mark.parametrize("controller", CLASSICAL, ids=registry.CLASSICAL)
def test_turning_the_inertial_frame_changes_nothing(controller):
    at = states.random_states(32, 11)
    turn = states.quaternions(1, 17)[0]

    def turned(state):
        scenario = state.scenario
        axes_N = jax.vmap(rotations.rotate, in_axes=(None, 0))(turn, scenario.constraints.axis_N)
        return states.state_of(
            rotations.multiply(turn, state.body.q_BN),
            state.body.omega_BN_B,
            rotations.multiply(turn, scenario.q_DN),
            axes_N,
            scenario.constraints.half_angle,
        )

    before, after = states.actions(controller, at), states.actions(controller, jax.vmap(turned)(at))
    np.testing.assert_allclose(after, before, atol=2e-3)
    assert np.abs(before).max() > 0.5


def test_zones_matter_to_all_but_pd():
    at = states.random_states(32, 23)
    absent = jax.tree.map(lambda leaf: jnp.stack([leaf] * 32), pointing_constraints.absent(3, states.LOOK))
    without = at.replace(scenario=at.scenario.replace(constraints=absent))
    for name, controller in zip(registry.CLASSICAL, CLASSICAL, strict=True):
        same = np.all(states.actions(controller, at) == states.actions(controller, without), axis=1)
        assert same.all() if name == "pd" else not same.all(), name


@pytest.mark.slow
@pytest.mark.parametrize(("name", "allowed"), [("planner", 0), ("sliding", 0)])
def test_success_on_the_paper_s_draw(name, allowed):
    agent = registry.load_controller(name, TaskConfig(episode_seconds=40.0))
    results = cases.fly_cases(agent.controller, agent.task, MonteCarloConfig(cases=50, seed=4, substeps=2))
    assert np.sum(~np.asarray(results.success)) <= allowed


def test_other_spacecraft_are_flown_too():
    """A body a hundred times heavier with actuators to match flies the same way; gains are physical."""
    heavy = states.model_with(inertia=((6000, 500, 100), (500, 5000, 200), (100, 200, 7000)), torque_limit=200.0)
    at = states.random_states(32, 41)
    for controller in CLASSICAL:
        np.testing.assert_allclose(states.actions(controller, at, heavy), states.actions(controller, at), atol=2e-3)


UNEQUAL = states.model_with(torque_limit=(0.5, 2.0, 1.2))


@pytest.mark.parametrize("controller", CLASSICAL, ids=registry.CLASSICAL)
def test_unequal_limits_are_kept_and_used(controller):
    """Each component stays in its own share of the box, and some action comes near the edge of every axis."""
    found = states.actions(controller, states.random_states(32, 5, rate=0.3), UNEQUAL)
    assert np.all(np.abs(found) <= 1.0)
    assert np.all(np.abs(found).max(axis=0) > 0.9)
    assert np.max(np.abs(found - states.actions(controller, states.random_states(32, 5, rate=0.3)))) > 0.1


@pytest.mark.parametrize("name", ["pd", "sliding", "planner"])
@pytest.mark.slow
def test_a_spacecraft_with_unequal_limits_is_flown_to_its_target(name):
    task = TaskConfig.model_validate({"spacecraft": {"torque_limit": (0.7, 2.0, 1.2)}, "episode_seconds": 60.0})
    agent = registry.load_controller(name, task)
    results = cases.fly_cases(agent.controller, task, MonteCarloConfig(cases=20, seed=4))
    assert np.all(results.settled)
    # Effort is of torques inside the box: its corner all the time is the most there can be.
    assert np.all(results.control_effort <= 60.0 * (0.7**2 + 2.0**2 + 1.2**2))
