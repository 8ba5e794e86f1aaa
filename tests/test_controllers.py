"""Classical controllers: what each law promises."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from koz_jax import env, evaluation, keep_out, rotations, task
from koz_jax.controllers import attitude_path, feedback, registry, tune
from koz_jax.controllers.attitude_path import AttitudePath
from koz_jax.controllers.pd import QuaternionFeedback
from koz_jax.controllers.planner import PathPlanner
from koz_jax.controllers.potential import Potential, PotentialFeedback
from koz_jax.controllers.sliding import PotentialSliding
from koz_jax.dynamics import RigidBodyState
from koz_jax.errors import UserError
from koz_jax.keep_out import KeepOutZone
from koz_jax.scenario import Scenario
from koz_jax.task_config import TaskConfig

NAMES = (*registry.CLASSICAL, *registry.ROGUES)
# Refinement chooses among near equals, and rounding may decide; without it the planner is compared exactly.
CLASSICAL = [
    QuaternionFeedback(),
    PotentialFeedback(),
    PotentialSliding(),
    PathPlanner(rounds=0),
]


def quaternions(count, seed):
    draws = np.random.default_rng(seed).standard_normal((count, 4))
    return jnp.asarray(draws / np.linalg.norm(draws, axis=1, keepdims=True), jnp.float32)


def directions(count, seed):
    draws = np.random.default_rng(seed).standard_normal((count, 3))
    return jnp.asarray(draws / np.linalg.norm(draws, axis=1, keepdims=True), jnp.float32)


def state_of(q_BN, omega_B, q_DN, axes_N, half_angles):
    zones = KeepOutZone(axis_N=axes_N, half_angle=half_angles)
    return env.reset(Scenario(RigidBodyState(q_BN, omega_B), q_DN, zones))


states_of = jax.vmap(state_of)


def random_states(count, seed, rate=0.2):
    """States anywhere, with two zones and an absent one."""
    half_angles = jnp.tile(jnp.array([0.4, 0.3, keep_out.NO_ZONE_HALF_ANGLE]), (count, 1))
    axes_N = directions(3 * count, seed + 1).reshape(count, 3, 3)
    omega_B = rate * directions(count, seed + 2)
    return states_of(quaternions(count, seed), omega_B, quaternions(count, seed + 3), axes_N, half_angles)


@jax.jit
def first_actions(controller, states, params, keys):
    def first(state, key):
        return controller.decide(state, params, controller.begin(state, params, key))[0]

    return jax.vmap(first)(states, keys)


def actions(controller, states, params):
    keys = jax.random.split(jax.random.key(0), states.steps.shape[0])
    return np.asarray(first_actions(controller, states, params, keys))


def special_states(params):
    """At the target, half a turn and a whole turn away, and looking at a zone's axis, edge and inside.  As many as
    there are random states, for a single compilation."""
    look = params.spacecraft.boresight_B
    beside = jnp.array([0.0, 0.0, 1.0])

    def zone_at(angle):
        return rotations.rotate(rotations.from_axis_angle(beside, jnp.float32(angle)), look)

    upright, half, whole = jnp.eye(4)[0], jnp.eye(4)[2], -jnp.eye(4)[0]
    attitudes = jnp.stack([upright, half, whole, upright, upright, jnp.eye(4)[1], jnp.eye(4)[3], upright])
    axes = jnp.stack([zone_at(angle) for angle in (2.0, 1.0, 0.5, 0.0, 0.3, 0.1, 0.3, 0.2)])
    rates = jnp.repeat(jnp.array([[0.0, 0.0, 0.0], [0.5, -0.5, 1.0], [0.0, 0.0, 0.1], [-2.0, 0.0, 0.0]]), 8, axis=0)
    zones = jnp.tile(axes[None, :, None], (4, 1, 3, 1)).reshape(32, 3, 3)
    return states_of(
        jnp.tile(attitudes, (4, 1)),
        rates,
        jnp.tile(upright, (32, 1)),
        zones,
        jnp.tile(jnp.array([0.3, 0.3, -3.0]), (32, 1)),
    )


@pytest.mark.parametrize("name", NAMES)
def test_actions_are_finite_and_in_the_box_everywhere(name, params):
    controller = PathPlanner(rounds=0) if name == "planner" else registry.load_controller(name).controller
    for states in (special_states(params), random_states(32, 5, rate=1.0)):
        found = actions(controller, states, params)
        assert np.all(np.isfinite(found))
        assert np.all(np.abs(found) <= 1.0)


@pytest.mark.parametrize("controller", CLASSICAL, ids=registry.CLASSICAL)
def test_turning_the_inertial_frame_changes_nothing(controller, params):
    states = random_states(32, 11)
    turn = quaternions(1, 17)[0]

    def turned(state):
        scenario = state.scenario
        axes_N = jax.vmap(rotations.rotate, in_axes=(None, 0))(turn, scenario.zones.axis_N)
        return state_of(
            rotations.multiply(turn, state.body.q_BN),
            state.body.omega_BN_B,
            rotations.multiply(turn, scenario.q_DN),
            axes_N,
            scenario.zones.half_angle,
        )

    before, after = actions(controller, states, params), actions(controller, jax.vmap(turned)(states), params)
    np.testing.assert_allclose(after, before, atol=2e-3)
    assert np.abs(before).max() > 0.5


def test_zones_matter_to_all_but_pd(params):
    states = random_states(32, 23)
    without = states.replace(
        scenario=states.scenario.replace(zones=jax.vmap(lambda _: keep_out.no_zones(3))(states.steps))
    )
    for name, controller in zip(registry.CLASSICAL, CLASSICAL, strict=True):
        same = np.all(actions(controller, states, params) == actions(controller, without, params), axis=1)
        assert same.all() if name == "pd" else not same.all(), name


def test_pd_rests_at_its_target(params):
    states = random_states(32, 3, rate=0.0)
    at_target = states.replace(body=states.body.replace(q_BN=states.scenario.q_DN))
    assert np.all(np.abs(actions(QuaternionFeedback(), at_target, params)) < 1e-4)
    upright = jnp.tile(jnp.eye(4)[0], (32, 1))
    exact = at_target.replace(body=states.body.replace(q_BN=upright), scenario=states.scenario.replace(q_DN=upright))
    assert np.all(actions(QuaternionFeedback(), exact, params) == 0.0)


def test_pd_brakes_in_time(params):
    """From half a turn away the error falls to the end without overshoot, where it counts on less torque than it has.

    The gains tuned for reward count on a little more.
    """
    far = states_of(
        jnp.eye(4)[1:], jnp.zeros((3, 3)), jnp.tile(jnp.eye(4)[0], (3, 1)), jnp.zeros((3, 0, 3)), jnp.zeros((3, 0))
    )
    controller = QuaternionFeedback(bandwidth=2.0, rate_bandwidth=2.0, torque_share=0.9)

    def one(state):
        def advance(state, _):
            action, _ = controller.decide(state, params, None)
            after = state.replace(body=env.push(state.body, params.spacecraft.torque_limit * action, params, params.dt))
            return after, feedback.error_vector(after)

        return jax.lax.scan(advance, state, None, length=300)[1]

    errors = np.asarray(jax.jit(jax.vmap(one))(far))
    about = errors[np.arange(3), :, np.arange(3)]
    assert np.all(about > -1e-3)
    assert np.all(about[:, -1] < 1e-3)


def test_pd_without_saturation_has_a_lyapunov_function(params):
    """V = |e|^2 + |w + k e|^2 / (k r) falls along every motion; e: error vector, k, r: the two bandwidths."""
    controller = QuaternionFeedback(bandwidth=1.0, rate_bandwidth=3.0)
    k, r = float(controller.bandwidth), float(controller.rate_bandwidth)
    rng = np.random.default_rng(1)
    step = params.replace(dt=jnp.float32(0.01))
    target, no_axes, no_angles = jnp.eye(4)[0], jnp.zeros((0, 3)), jnp.zeros(0)

    def value(body):
        error_B = feedback.rotation_vector(body.q_BN)
        follow_B = body.omega_BN_B + k * error_B
        return rotations.dot(error_B, error_B) + rotations.dot(follow_B, follow_B) / (k * r)

    def one(error_B, omega_B):
        state = state_of(feedback.from_rotation_vector(error_B), omega_B, target, no_axes, no_angles)
        action, _ = controller.decide(state, step, None)
        after = env.push(state.body, step.spacecraft.torque_limit * action, step, step.dt)
        return jnp.max(jnp.abs(action)), value(state.body), value(after)

    errors = jnp.asarray(0.01 * rng.standard_normal((200, 3)), jnp.float32)
    rates = jnp.asarray(0.003 * rng.standard_normal((200, 3)), jnp.float32)
    strength, before, after = jax.jit(jax.vmap(one))(errors, rates)
    free = np.asarray(strength) < 1.0
    assert free.sum() > 100
    assert np.all(np.asarray(after)[free] < np.asarray(before)[free])


def potential_value(vector_B, state, potential, look_B):
    """V of the attitude turned by a rotation vector, in float64."""
    q0, *q_vec = np.asarray(state.body.q_BN, float)
    d0, *d_vec = np.asarray(state.scenario.q_DN, float)
    body = Rotation.from_quat([*q_vec, q0]) * Rotation.from_rotvec(vector_B)
    error = (Rotation.from_quat([*d_vec, d0]).inv() * body).as_quat()
    # The sign of the quaternion, which a rotation does not have, is that of the state.
    sign = np.sign(float(env.attitude_error(state)[0]) * error[3])
    away = 2.0 * (1.0 - sign * error[3])
    value = 1.0
    zones = state.scenario.zones
    for axis_N, half_angle in zip(np.asarray(zones.axis_N, float), np.asarray(zones.half_angle, float), strict=True):
        if half_angle > 0.0:
            edge = np.cos(half_angle + potential.margin)
            value -= potential.barrier * np.log((edge - axis_N @ body.apply(look_B)) / (1.0 + edge))
    return away * value


def test_potential_torque_is_minus_the_gradient_and_damping(params):
    controller = PotentialFeedback(frequency=0.02)
    potential = Potential(controller.barrier, controller.margin)
    states = random_states(96, 31, rate=0.01)
    found = actions(controller, states, params) * float(params.spacecraft.torque_limit)
    inertia_B, look_B = np.asarray(params.spacecraft.inertia_B, float), np.asarray(params.spacecraft.boresight_B)
    checked = 0
    for i in range(96):
        state = jax.tree.map(lambda leaf, i=i: leaf[i], states)
        margin = float(keep_out.smallest_margin(env.boresight_N(state.body, params.spacecraft), state.scenario.zones))
        if margin < 0.15 or np.abs(found[i]).max() > 1.9:
            continue
        ways = 1e-5 * np.eye(3)
        gradient_B = [
            (potential_value(way, state, potential, look_B) - potential_value(-way, state, potential, look_B)) / 2e-5
            for way in ways
        ]
        omega_B = np.asarray(state.body.omega_BN_B, float)
        acceleration_B = -2 * controller.frequency**2 * np.array(gradient_B)
        acceleration_B -= 2 * controller.damping * controller.frequency * omega_B
        expected = inertia_B @ acceleration_B + np.cross(omega_B, inertia_B @ omega_B)
        np.testing.assert_allclose(found[i], expected, rtol=2e-3, atol=2e-4)
        checked += 1
    assert checked > 20


def test_sliding_surface_is_reached_and_kept(params):
    """With strong actuators s decays at the rate of the reaching law, and stays small all the way to the target."""
    strong = params.replace(spacecraft=params.spacecraft.replace(torque_limit=jnp.float32(60.0)), dt=jnp.float32(0.01))
    controller = PotentialSliding(torque_share=0.02, layer=1.0)
    cases = jax.vmap(lambda i: evaluation.draw_case(TaskConfig(), evaluation.MonteCarloConfig(8, seed=3), i))(
        jnp.arange(8)
    )

    def one(case, omega_B):
        start = env.reset(case.replace(initial=case.initial.replace(omega_BN_B=omega_B)))

        def advance(state, _):
            action, _ = controller.decide(state, strong, None)
            s_B = state.body.omega_BN_B - controller.wanted_rate(state, strong)
            return env.step(state, action, strong)[0], (rotations.norm(s_B), state.angle)

        return jax.lax.scan(advance, start, None, length=6000)[1]

    sizes, angles = map(np.asarray, jax.jit(jax.vmap(one))(cases, 0.1 * directions(8, 7)))
    assert np.all(sizes[:, 0] > 0.05)
    reached = int(8.0 / controller.reach / 0.01)
    assert np.all(sizes[:, reached:] < 0.02)
    assert np.all(angles[:, -1] < 0.01)


def drawn_with_zones(count, zones):
    config = TaskConfig.model_validate({"scenario": {"min_zones": 1, "max_zones": zones}})
    draw = evaluation.MonteCarloConfig(count, seed=2)
    return jax.vmap(lambda i: evaluation.draw_case(config, draw, i))(jnp.arange(count))


# Start and target keep 2 deg (0.035 rad) from the zones, so no plan can keep more.
PLANNER = PathPlanner(margin=0.03)


@pytest.fixture(scope="module")
def plans(params):
    """Two hundred cases with one to three zones, and the plans for them."""
    cases = drawn_with_zones(200, 3)
    controller = PLANNER

    def plan(case, key):
        return controller.begin(env.reset(case), params, key)

    return cases, jax.jit(jax.vmap(plan))(cases, jax.random.split(jax.random.key(1), 200))


def test_planned_paths_stay_clear_of_all_zones(plans, params):
    cases, found = plans
    samples = jax.jit(jax.vmap(lambda path: attitude_path.sample(path, 1001)))(found.path)
    look = jax.vmap(jax.vmap(rotations.rotate, in_axes=(0, None)), in_axes=(0, None))
    looks_N = np.asarray(look(samples.q_BN, params.spacecraft.boresight_B), float)
    cosines = np.einsum("cpi,czi->cpz", looks_N, np.asarray(cases.zones.axis_N, float))
    margins = np.arccos(np.clip(cosines, -1, 1)) - np.asarray(cases.zones.half_angle, float)[:, None]
    assert (np.asarray(cases.zones.half_angle) > 0).sum(axis=1).max() == 3
    assert np.all(margins.min(axis=(1, 2)) >= PLANNER.margin - 1e-3)


def test_plans_begin_at_the_start_and_end_at_rest_at_the_target(plans):
    cases, found = plans
    begin = jax.vmap(lambda plan: plan.reference(jnp.float32(0.0)))(found)
    end = jax.vmap(lambda plan: plan.reference(plan.timing.duration + 1.0))(found)
    np.testing.assert_allclose(begin.q_BN, cases.initial.q_BN, atol=1e-6)
    # The sign too: the maneuver ends at +1.
    np.testing.assert_allclose(end.q_BN, cases.q_DN, atol=1e-5)
    np.testing.assert_allclose(begin.omega_BN_B, 0.0, atol=1e-6)
    np.testing.assert_allclose(end.omega_BN_B, 0.0, atol=1e-4)


def test_plans_need_no_more_torque_than_there_is(plans, params):
    """The rate along a plan, differentiated, is a torque inside the box, and most of the time at its edge."""
    _, found = plans
    h = 0.02

    def torque(plan, share):
        time = share * plan.timing.duration
        before, now, after = (plan.reference(time + shift).omega_BN_B for shift in (-h, 0.0, h))
        return (after - before) / (2 * h), now

    shares = jnp.linspace(0.02, 0.98, 97)
    acceleration, omega = jax.jit(jax.vmap(jax.vmap(torque, in_axes=(None, 0)), in_axes=(0, None)))(found, shares)
    inertia_B, omega = np.asarray(params.spacecraft.inertia_B, float), np.asarray(omega, float)
    momentum = omega @ inertia_B
    torques = np.abs(np.asarray(acceleration, float) @ inertia_B + np.cross(omega, momentum)).max(axis=2)
    limit = float(params.spacecraft.torque_limit)
    assert np.mean(torques > 1.05 * limit) < 0.01
    assert np.mean(torques > 0.9 * limit) > 0.8


def test_straight_turn_about_a_principal_axis_is_timed_as_bang_bang(params):
    spacecraft = params.spacecraft.replace(inertia_B=jnp.diag(jnp.array([60.0, 50.0, 70.0])))
    limit = spacecraft.torque_limit
    for axis, moment in enumerate((60.0, 50.0, 70.0)):
        path = AttitudePath(jnp.eye(4)[0], 2.0 * jnp.eye(3)[axis], jnp.zeros((2, 3)))
        timing = attitude_path.fastest_timing(attitude_path.sample(path, 65), spacecraft, limit)
        assert float(timing.duration) == pytest.approx(2.0 * np.sqrt(2.0 * moment / float(limit)), rel=1e-3)


@pytest.mark.parametrize(("name", "allowed"), [("planner", 0), ("sliding", 0)])
def test_success_on_the_paper_s_draw(name, allowed):
    pilot = registry.load_controller(name, TaskConfig(episode_seconds=40.0))
    results = evaluation.fly_cases(pilot.controller, pilot.task, evaluation.MonteCarloConfig(50, seed=4, substeps=2))
    assert np.sum(~np.asarray(results.success)) <= allowed


def test_other_spacecraft_are_flown_too():
    """A body a hundred times heavier with actuators to match flies the same way; gains are physical."""
    heavy = TaskConfig.model_validate(
        {
            "spacecraft": {"inertia": ((6000, 500, 100), (500, 5000, 200), (100, 200, 7000)), "torque_limit": 200.0},
            "episode_seconds": 20.0,
        }
    )
    states = random_states(32, 41)
    for controller in CLASSICAL:
        light = actions(controller, states, task.env_params(TaskConfig()))
        np.testing.assert_allclose(actions(controller, states, task.env_params(heavy)), light, atol=2e-3)


@pytest.mark.parametrize("name", NAMES)
def test_registry_knows_every_controller(name):
    pilot = registry.load_controller(name)
    assert (pilot.name, pilot.task) == (name, TaskConfig())
    other = TaskConfig(episode_seconds=5.0)
    assert registry.load_controller(name, other).task == other


def test_registry_refuses_what_it_does_not_know():
    with pytest.raises(UserError) as raised:
        registry.load_controller("pid")
    assert all(name in str(raised.value) for name in ("controller", "pid", *NAMES))


def test_tuning_finds_what_was_spoilt():
    """Gains far off are mended in a few rounds, and no round is worse than the one before."""
    args = tune.TuneArgs("pd", cases=8, candidates=8, rounds=3)
    spoilt = dataclasses.replace(
        registry.load_controller("pd", TaskConfig(episode_seconds=20.0)),
        controller=QuaternionFeedback(bandwidth=0.05, torque_share=0.1),
    )
    scores = [score for _, score in tune.search(spoilt, args)]
    assert scores == sorted(scores)
    assert scores[-1] > scores[0] + 1.0


@pytest.mark.parametrize(
    "argv", [["pid"], ["pd", "--seed", "0"], ["pd", "--cases", "0"], ["pd", "--spread", "0"], ["random"]]
)
def test_tuning_refuses_bad_settings(argv, capsys):
    assert tune.main(argv) == 2
    assert argv[-1] in capsys.readouterr().err
