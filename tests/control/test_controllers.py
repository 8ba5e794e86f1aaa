"""What all controllers promise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import states

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control import registry
from koz_jax.control.adversarial import Adversary, BangBang, Random, SpinUp
from koz_jax.control.base import Controller
from koz_jax.control.planning.icosphere_astar import IcosphereAStar
from koz_jax.control.planning.path_planner import PathPlanner
from koz_jax.control.planning.path_tracking import PathTracker
from koz_jax.control.planning.way_planner import WayPlanner
from koz_jax.control.potential import PotentialFeedback
from koz_jax.control.published.lee_mesbahi import LeeMesbahiBackstepping, LeeMesbahiPD
from koz_jax.control.published.yang_sliding import YangSliding
from koz_jax.control.quaternion_feedback import QuaternionFeedback
from koz_jax.control.sliding_mode import PotentialSliding
from koz_jax.evaluation import cases
from koz_jax.task import pointing_constraints, rotations, state
from koz_jax.task.actuators import TorqueBox
from koz_jax.task.any_spacecraft import units
from koz_jax.task.state import EnvState, Model

# Refinement chooses among near equals, and rounding may decide; without it the planner is compared exactly.
CLASSICAL: dict[str, Controller] = {
    "pd": QuaternionFeedback(),
    "potential": PotentialFeedback(),
    "sliding": PotentialSliding(),
    "lee_mesbahi_pd": LeeMesbahiPD(),
    "lee_mesbahi_backstepping": LeeMesbahiBackstepping(),
    "yang_sliding": YangSliding(),
    "planner": PathPlanner(rounds=0),
    # Coarse, for the time that it takes; it stands for all that search for a way, whose tests are in ``planning``.
    "icosphere_astar": IcosphereAStar(halvings=2, reach=0.6, points=33, eased=1, tried=1),
}
NAMES = (*CLASSICAL, *registry.ADVERSARIAL)

# These compile for long.
_SLOW = (PathTracker, PotentialSliding, LeeMesbahiBackstepping, YangSliding)

STEPS = 40


@jax.jit
def _fly(
    controller: Controller, starts: EnvState, model: Model, keys: jax.Array, steps: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """First actions (n, 3), and attitudes (n, STEPS, 4) after each of at most STEPS steps; one program for all."""

    def one(start: EnvState, key: jax.Array) -> tuple[jax.Array, jax.Array]:
        def advance(step, flight):
            (at, memory), first, attitudes = flight
            action, memory = controller.decide(at, model, memory)
            torque_B, _ = model.actuators.apply(action, None, at.body.omega_BN_B, model.inertia_B, model.dt)
            body = state.propagate(at.body, torque_B, state.nominal(model), model.dt)
            after = at.replace(body=body, steps=at.steps + 1), memory
            return after, jnp.where(step == 0, action, first), attitudes.at[step].set(body.q_BN)

        begun = (start, controller.begin(start, model, key)), jnp.zeros(3), jnp.zeros((STEPS, 4))
        return jax.lax.fori_loop(0, steps, advance, begun)[1:]

    return jax.vmap(one)(starts, keys)


def actions(controller: Controller, at: EnvState, model: Model = states.MODEL) -> np.ndarray:
    """What a controller does first in each of 32 states.  Returns (32, 3)."""
    keys = jax.random.split(jax.random.key(0), 32)
    return np.asarray(_fly(controller, at, model, keys, jnp.int32(1))[0])


def test_every_controller_is_tried_or_searches_as_one_that_is():
    others = [registry.load_controller(name).controller for name in registry.CLASSICAL if name not in CLASSICAL]
    assert all(isinstance(other, WayPlanner) for other in others)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_actions_are_finite_and_in_the_box_everywhere(name):
    controller = CLASSICAL.get(name) or registry.load_controller(name).controller
    for at in (states.special_states(), states.random_states(32, 5, rate=1.0)):
        found = actions(controller, at)
        assert np.all(np.isfinite(found))
        assert np.all(np.abs(found) <= 1.0)


@pytest.mark.slow
@pytest.mark.parametrize("controller", CLASSICAL.values(), ids=CLASSICAL)
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

    before, after = actions(controller, at), actions(controller, jax.vmap(turned)(at))
    np.testing.assert_allclose(after, before, atol=2e-3)
    assert np.abs(before).max() > 0.5


@pytest.mark.slow
def test_zones_matter_to_all_but_pd():
    at = states.random_states(32, 23)
    # From NumPy, as the other states are: what JAX fills with a number of Python is compiled anew.
    absent = jax.tree.map(lambda leaf: jnp.asarray(np.stack([leaf] * 32)), pointing_constraints.absent(3, states.LOOK))
    without = at.replace(scenario=at.scenario.replace(constraints=absent))
    for name, controller in CLASSICAL.items():
        same = np.all(actions(controller, at) == actions(controller, without), axis=1)
        assert same.all() if name == "pd" else not same.all(), name


# As long for both tests that fly it, so that they share a program.
DRAW = MonteCarloConfig(cases=50, seed=4, substeps=2)
SECONDS = 60.0


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planner", "sliding"])
def test_success_on_the_paper_s_draw(name):
    agent = registry.load_controller(name, TaskConfig(episode_seconds=SECONDS))
    results = cases.fly_cases(agent.controller, agent.task, DRAW)
    assert np.all(results.success)
    assert np.all(results.settling_time < 40.0)


# The last two change what they do so soon that a short flight has all of it.
ADVERSARIAL = [Random(), Adversary(), BangBang(hold=jnp.float32(0.3)), SpinUp(spin_time=jnp.float32(0.6))]


@pytest.mark.slow
@pytest.mark.parametrize(
    "controller",
    [
        pytest.param(one, id=type(one).__name__, marks=pytest.mark.slow if isinstance(one, _SLOW) else ())
        for one in (*CLASSICAL.values(), *ADVERSARIAL)
    ],
)
def test_all_spacecraft_of_a_shape_fly_one_maneuver_in_their_own_time(controller):
    """With T = sqrt(J / u), and time steps and first rates in units of it, the attitudes are the same at every step.

    So no gain is right for one spacecraft only.  Steps are about as long as the paper's, and so long that gains are
    capped.
    """

    # Eight, each four times: as many as the other tests have, for the same program.
    places = jnp.arange(32) % 8
    begun = jax.tree.map(lambda leaf: leaf[places], states.random_states(8, 11))
    keys = jax.random.split(jax.random.key(0), 8)[places]

    def fly(model):
        starts = begun.replace(body=begun.body.replace(omega_BN_B=begun.body.omega_BN_B / units.of(model).time))
        return _fly(controller, starts, model, keys, jnp.int32(STEPS))[1]

    # This one's gains are not capped: past the edge of a zone it then jumps about, and rounding decides.
    for step in (0.02,) if isinstance(controller, LeeMesbahiBackstepping) else (0.02, 0.15):
        found = [fly(scaled(*scale, step)) for scale in ((1.0, 1.0), (1e-3, 1e-5), (1e-5, 1e-3))]
        for other in found[1:]:
            np.testing.assert_allclose(other, found[0], atol=5e-4)
        assert np.abs(found[0][:, -1] - found[0][:, 0]).max() > 0.05


def scaled(inertia, torque, step):
    """The paper's spacecraft with inertia and torque limit times these, and a time step in units of T."""
    limit_B = torque * states.MODEL.actuators.limits(None, jnp.zeros(3)).box_B
    model = states.MODEL.replace(inertia_B=inertia * states.MODEL.inertia_B, actuators=TorqueBox(limit_B))
    return model.replace(dt=step * units.of(model).time)


UNEQUAL = states.model_with(torque_limit=(0.5, 2.0, 1.2))


@pytest.mark.parametrize(
    "controller",
    [
        pytest.param(one, id=name, marks=pytest.mark.slow if isinstance(one, _SLOW) else ())
        for name, one in CLASSICAL.items()
    ],
)
def test_unequal_limits_are_kept_and_used(controller):
    """Each component stays in its own share of the box, and some action comes near the edge of every axis."""
    found = actions(controller, states.random_states(32, 5, rate=0.3), UNEQUAL)
    assert np.all(np.abs(found) <= 1.0)
    assert np.all(np.abs(found).max(axis=0) > 0.8)
    assert np.max(np.abs(found - actions(controller, states.random_states(32, 5, rate=0.3)))) > 0.1


@pytest.mark.parametrize("name", ["pd", "sliding", "planner"])
@pytest.mark.slow
def test_a_spacecraft_with_unequal_limits_is_flown_to_its_target(name):
    task = TaskConfig.model_validate({"spacecraft": {"torque_limit": (0.7, 2.0, 1.2)}, "episode_seconds": SECONDS})
    agent = registry.load_controller(name, task)
    results = cases.fly_cases(agent.controller, task, DRAW)
    assert np.all(results.settled)
    # Effort is of torques inside the box: its corner all the time is the most there can be.
    assert np.all(results.control_effort <= SECONDS * (0.7**2 + 2.0**2 + 1.2**2))
