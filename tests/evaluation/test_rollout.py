import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import RewardConfig, TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.base import Memoryless
from koz_jax.control.registry import load_controller
from koz_jax.control.shield.filter import under_shield
from koz_jax.evaluation import cases, rollout
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.task import reward, scenario, uncertainty
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.reward import RewardTerms
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model, attitude_error

pytestmark = pytest.mark.usefixtures("strict_shapes")

STEPS = 600
IDENTITY = (1.0, 0.0, 0.0, 0.0)
# Below this, float32 cannot tell a smaller pointing error from a larger one.
RESOLUTION = 2e-6


class ProportionalDerivative(Memoryless):
    """Action -(gain q_e_vec + damping w): enough to fly a maneuver, and ignorant of the zone."""

    gain: jax.Array
    damping: jax.Array

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        return -(self.gain * attitude_error(state)[1:] + self.damping * state.body.omega_BN_B), memory


def _pd(gain: float, damping: float) -> ProportionalDerivative:
    return ProportionalDerivative(jnp.float32(gain), jnp.float32(damping))


IDLE = _pd(0.0, 0.0)
STEADY = _pd(6.0, 25.0)
OSCILLATING = _pd(5.0, 3.0)


def _scenario(q, omega=(0.0, 0.0, 0.0), axis=(0.0, 0.0, 1.0), half_angle=ABSENT_HALF_ANGLE) -> Scenario:
    return Scenario(
        RigidBodyState(jnp.array(q, jnp.float32), jnp.array(omega, jnp.float32)),
        jnp.array(IDENTITY),
        PointingConstraint(*(jnp.array([x], jnp.float32) for x in (oracle.BORESIGHT, axis, half_angle))),
    )


def _turned(angle: float, axis=(0.0, 0.0, 1.0)) -> np.ndarray:
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * np.array(axis))])


def _cases() -> dict[str, tuple[ProportionalDerivative, Scenario]]:
    paper = scenario.paper_test()
    start_direction = oracle.rotation(np.asarray(paper.initial.q_BN)).apply(oracle.BORESIGHT)
    return {
        "across the zone": (STEADY, paper),
        "oscillating": (OSCILLATING, paper),
        "out of a zone at the start": (STEADY, _scenario(paper.initial.q_BN, axis=start_direction, half_angle=0.2)),
        "no zone": (STEADY, _scenario(paper.initial.q_BN)),
        "drifting": (IDLE, _scenario(_turned(1.0), omega=(0.001, 0.002, -0.01), half_angle=0.4)),
        "drifting into a zone": (
            IDLE,
            _scenario(_turned(1.0), omega=(0.0, 0.0, -0.01), axis=(0.8, 0.6, 0.0), half_angle=0.2),
        ),
        "at the target": (IDLE, _scenario(IDENTITY, half_angle=0.4)),
    }


NAMES = list(_cases())


@functools.partial(jax.jit, static_argnames=("steps", "substeps"))
def _run(controller, flown, env: Reorientation, steps: int, substeps: int = 1) -> CaseResult:
    return rollout.run_case(env.replace(episode_steps=steps), controller, flown, substeps)


@functools.partial(jax.jit, static_argnames=("steps", "substeps"))
def _run_all(controllers, flown, env: Reorientation, steps: int, substeps: int = 1) -> CaseResult:
    return jax.vmap(lambda controller, one: _run(controller, one, env, steps, substeps))(controllers, flown)


@functools.partial(jax.jit, static_argnames="steps")
def _fly(controller, flown, env: Reorientation, steps: int) -> History:
    return rollout.fly(env.replace(episode_steps=steps), controller, flown)


@pytest.fixture(scope="module")
def stacked(strict_shapes) -> tuple[ProportionalDerivative, Scenario]:
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *_cases().values())


@pytest.fixture(scope="module")
def results(stacked, env) -> CaseResult:
    return jax.tree.map(np.asarray, _run_all(*stacked, env, STEPS))


@pytest.fixture(scope="module")
def histories(stacked, env) -> History:
    flown = jax.jit(jax.vmap(lambda controller, one: _fly(controller, one, env, STEPS)))(*stacked)
    return jax.tree.map(np.asarray, flown)


@pytest.fixture(scope="module")
def twins(histories, stacked) -> list[dict[str, np.ndarray]]:
    """Pointing error, margin and torque of every instant, recomputed in float64 from the flown attitudes."""
    found = []
    for i in range(len(NAMES)):
        q = histories.state.body.q_BN[i].astype(np.float64)
        zone = jax.tree.map(lambda leaf, i=i: np.asarray(leaf[i]), stacked[1].constraints)
        found.append(
            {
                "phi": oracle.rotation_angle(q),
                "margin": np.array([oracle.margins(at, oracle.BORESIGHT, zone.axis_N, zone.half_angle)[0] for at in q]),
                "torque": histories.torque_B[i, :-1].astype(np.float64),
            }
        )
    return found


def _one(tree, i: int):
    return jax.tree.map(lambda leaf: leaf[i], tree)


# The history


@pytest.mark.slow
def test_history_starts_at_the_scenario_and_has_one_row_more_than_steps(histories, stacked):
    assert {leaf.shape[1] for leaf in jax.tree.leaves(histories)} == {STEPS + 1}
    np.testing.assert_array_equal(histories.state.body.q_BN[:, 0], stacked[1].initial.q_BN)
    np.testing.assert_array_equal(histories.state.body.omega_BN_B[:, 0], stacked[1].initial.omega_BN_B)


@pytest.mark.parametrize("name", ["across the zone", "oscillating", "drifting"])
def test_each_row_follows_from_the_one_before_by_its_torque(histories, name):
    flown = _one(histories, NAMES.index(name))
    for t in range(0, STEPS, 25):
        q, omega = oracle.propagate(flown.state.body.q_BN[t], flown.state.body.omega_BN_B[t], flown.torque_B[t], 0.1)
        np.testing.assert_allclose(flown.state.body.q_BN[t + 1], q, atol=1e-6)
        np.testing.assert_allclose(flown.state.body.omega_BN_B[t + 1], omega, atol=1e-7)


def test_torque_of_a_row_is_what_the_controller_answers_to_its_state(histories, stacked):
    for i in range(len(NAMES)):
        pd, q_e = _one(stacked[0], i), histories.attitude_error[i]
        actions = -(pd.gain * q_e[:, 1:] + pd.damping * histories.state.body.omega_BN_B[i])
        np.testing.assert_allclose(histories.torque_B[i, :-1], 2.0 * np.clip(actions, -1, 1)[:-1], rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(histories.torque_B[:, -1], histories.torque_B[:, -2])


@pytest.mark.slow
def test_pointing_error_and_margin_of_a_row_agree_with_the_oracle(histories, twins):
    for i, twin in enumerate(twins):
        np.testing.assert_allclose(histories.pointing_error[i], twin["phi"], atol=RESOLUTION)
        np.testing.assert_allclose(histories.zone_margin[i], twin["margin"], atol=RESOLUTION)


# The metrics of a case


def test_the_cases_reach_every_kind_of_outcome(results):
    kinds = set(zip(results.settled.tolist(), results.violated.tolist(), strict=True))
    assert kinds == {(True, True), (True, False), (False, False), (False, True)}


@pytest.mark.parametrize("name", NAMES)
def test_metrics_agree_with_the_oracle(results, twins, name):
    result, twin = _one(results, NAMES.index(name)), twins[NAMES.index(name)]
    expected = oracle.judge(**twin)
    # The judgement below is only meant where float32 can make it.
    assert np.min(np.abs(twin["phi"] - oracle.SETTLED)) > 1e-6 or name == "at the target"
    assert bool(result.settled) == expected["settled"]
    assert bool(result.violated) == expected["violated"]
    np.testing.assert_allclose(result.settling_time, expected["settling_time"], rtol=1e-5)
    np.testing.assert_allclose(result.control_effort, expected["control_effort"], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(result.control_accuracy, expected["control_accuracy"], atol=RESOLUTION)
    np.testing.assert_allclose(result.min_margin, expected["min_margin"], atol=5e-6)
    np.testing.assert_allclose(result.initial_angle, twin["phi"][0], atol=1e-6)


@pytest.mark.parametrize("name", NAMES)
def test_reward_agrees_with_the_oracle(results, twins, name):
    result, twin = _one(results, NAMES.index(name)), twins[NAMES.index(name)]
    undecided = int(np.sum(np.abs(np.diff(twin["phi"])) < RESOLUTION))
    expected = oracle.judge(**twin)["reward"]
    assert abs(float(result.reward) - expected) <= 5e-5 * abs(expected) + 0.02 + undecided


def test_some_case_decides_progress_in_every_step(twins):
    """Or the tolerance of the reward for undecided steps would hide anything."""
    assert min(int(np.sum(np.abs(np.diff(twin["phi"])) < RESOLUTION)) for twin in twins) == 0


@pytest.mark.parametrize("name", NAMES)
def test_each_reward_term_is_its_sum_over_the_maneuver(results, twins, name):
    result, twin = _one(results, NAMES.index(name)), twins[NAMES.index(name)]
    sums = dict.fromkeys((field.name for field in dataclasses.fields(RewardTerms)), 0.0)
    for t, torque in enumerate(twin["torque"]):
        before = twin["torque"][t - 1] if t else None
        step = oracle.reward_terms(twin["phi"][t + 1], twin["phi"][t], torque, before, twin["margin"][t + 1])
        for term, value in step.items():
            sums[term] += value
        sums["effort"] -= float(np.sum((torque / oracle.TORQUE_LIMIT) ** 2))
    undecided = int(np.sum(np.abs(np.diff(twin["phi"])) < RESOLUTION))
    for term, value in sums.items():
        slack = undecided if term == "no_progress" else 0
        assert abs(float(getattr(result.reward_terms, term)) - value) <= 5e-5 * abs(value) + 5e-3 + slack, term


def test_paper_reward_of_a_case_is_the_weighted_sum_of_its_terms(results):
    expected = sum(getattr(results.reward_terms, name) for name in vars(results.reward_terms) if name != "effort")
    np.testing.assert_allclose(results.reward, expected, rtol=1e-5, atol=1e-3)


def test_success_is_settled_and_not_violated(results):
    np.testing.assert_array_equal(results.success, results.settled & ~results.violated)


def test_measured_case_and_recorded_case_are_the_same_flight(results, histories):
    np.testing.assert_allclose(results.control_accuracy, histories.pointing_error[:, -1], atol=RESOLUTION)
    np.testing.assert_allclose(results.min_margin, histories.zone_margin.min(axis=1), atol=1e-5)
    effort = np.sum(histories.torque_B[:, :-1].astype(np.float64) ** 2, axis=(1, 2)) * 0.1
    np.testing.assert_allclose(results.control_effort, effort, rtol=1e-4, atol=1e-6)


def test_a_case_is_the_same_alone_and_among_others(results, env):
    for i, (controller, flown) in enumerate(_cases().values()):
        alone = _run(controller, flown, env, STEPS)
        for name in ("settling_time", "control_effort", "settled", "violated", "initial_angle"):
            np.testing.assert_allclose(getattr(alone, name), getattr(results, name)[i], rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(alone.control_accuracy, results.control_accuracy[i], atol=RESOLUTION)


def test_a_zone_around_the_start_is_violated_from_the_first_instant(results, histories):
    i = NAMES.index("out of a zone at the start")
    assert results.violated[i]
    np.testing.assert_allclose(histories.zone_margin[i, 0], -0.2, atol=1e-6)
    assert np.all(histories.zone_margin[i, 200:] > 0)


# Settling


def _principal(env: Reorientation, settled_angle: float | None = None) -> Reorientation:
    """A body that turns about its own axes, so that its motion is known in closed form."""
    model = env.model.replace(inertia_B=jnp.diag(jnp.array([60.0, 60.0, 60.0])))
    judged = env.reward if settled_angle is None else env.reward.replace(settled_angle=jnp.float32(settled_angle))
    return env.replace(model=model, reward=judged)


@pytest.mark.parametrize(("angle", "settled"), [(0.49, False), (0.5, True), (0.51, False)])
def test_only_a_maneuver_that_ends_inside_the_band_is_settled(env, angle, settled):
    """0.5 rad in 5 s: a little past the target, at it, and a little short of it; the band is 0.0044 rad wide."""
    result = _run(IDLE, _scenario(_turned(angle), omega=(0.0, 0.0, -0.1)), _principal(env), 50)
    assert bool(result.settled) == settled
    np.testing.assert_allclose(result.settling_time, 5.0 if settled else np.nan, rtol=1e-5)


def test_a_maneuver_that_starts_and_stays_inside_the_band_settles_at_once(results):
    i = NAMES.index("at the target")
    assert results.settled[i]
    assert results.settling_time[i] == 0.0


def test_entering_the_band_counts_from_the_first_instant_inside(env):
    """Turning at 0.1 rad/s from 0.5001 rad, cut before the band is left again: 0.5001 - 0.01 k <= 0.2 from k = 31."""
    result = _run(IDLE, _scenario(_turned(0.5001), omega=(0.0, 0.0, -0.1)), _principal(env, 0.2), 50)
    np.testing.assert_allclose(result.settling_time, 3.1, rtol=1e-5)


def test_a_start_just_outside_the_band_settles_at_the_first_step(env):
    """0.203 rad at the start, 0.198 rad a step later."""
    result = _run(IDLE, _scenario(_turned(0.203), omega=(0.0, 0.0, -0.05)), _principal(env, 0.2), 50)
    np.testing.assert_allclose(result.settling_time, 0.1, rtol=1e-5)


def test_settling_counts_from_the_last_entry_into_the_band(env):
    """An oscillation passes through the band again and again before it stays."""
    band = 0.2
    judged = _principal(env, band)
    swinging = _scenario(_turned(1.2))
    history = _fly(OSCILLATING, swinging, judged, STEPS)
    phi = oracle.rotation_angle(np.asarray(history.state.body.q_BN))
    inside = phi <= band
    entries = np.flatnonzero(~inside[:-1] & inside[1:]) + 1
    assert len(entries) >= 3
    assert inside[-1]
    result = _run(OSCILLATING, swinging, judged, STEPS)
    assert bool(result.settled)
    np.testing.assert_allclose(result.settling_time, 0.1 * entries[-1], rtol=1e-5)
    np.testing.assert_allclose(result.settling_time, oracle.settling_time(phi, settled=band), rtol=1e-5)


def test_half_convention_halves_the_accuracy_and_settles_no_later(env):
    half = env.replace(reward=reward.from_config(RewardConfig(), "half"))
    controller, flown = _cases()["across the zone"]
    full_result, half_result = _run(controller, flown, env, STEPS), _run(controller, flown, half, STEPS)
    np.testing.assert_allclose(half_result.control_accuracy, full_result.control_accuracy / 2, rtol=1e-4)
    assert half_result.settling_time < full_result.settling_time
    np.testing.assert_allclose(half_result.initial_angle, full_result.initial_angle)
    np.testing.assert_allclose(half_result.min_margin, full_result.min_margin, atol=1e-6)


# Between the steps


@pytest.mark.slow
@pytest.mark.parametrize(("substeps", "nearest"), [(1, 0.05), (2, 0.0), (3, 0.05 / 3)])
def test_substeps_see_what_the_boresight_does_between_steps(env, substeps, nearest):
    """At 1 rad/s the boresight is at 0, 0.1, 0.2, ... rad; a zone of 0.02 rad at 0.25 rad lies between."""
    passing = _scenario(IDENTITY, omega=(0.0, 0.0, 1.0), axis=(np.cos(0.25), np.sin(0.25), 0.0), half_angle=0.02)
    result = _run(IDLE, passing, _principal(env), 6, substeps)
    np.testing.assert_allclose(result.min_margin, nearest - 0.02, atol=2e-6)
    assert bool(result.violated) == (nearest <= 0.02)


@pytest.mark.slow
def test_substeps_only_ever_find_a_smaller_margin_and_change_nothing_else(stacked, env, results):
    finer = _run_all(*stacked, env, STEPS, 3)
    assert np.all(finer.min_margin <= results.min_margin + 1e-6)
    assert np.any(finer.min_margin < results.min_margin - 1e-5)
    assert np.all(finer.violated | ~results.violated)
    for name in ("settling_time", "control_effort", "settled"):
        np.testing.assert_allclose(getattr(finer, name), getattr(results, name), rtol=1e-4, atol=1e-5)


# Compilation


def test_new_controller_weights_scenarios_and_parameters_need_no_new_compilation(env):
    traces = []

    def counted(controller: ProportionalDerivative, flown: Scenario, env: Reorientation) -> CaseResult:
        traces.append(1)
        return rollout.run_case(env.replace(episode_steps=5), controller, flown)

    run = jax.jit(counted)
    outcomes = {
        float(run(controller, flown, judged).control_accuracy)
        for controller in (IDLE, STEADY, OSCILLATING)
        for flown in (_scenario(_turned(0.5)), scenario.paper_test())
        for judged in (env, _principal(env, 0.3))
    }
    assert len(traces) == 1
    assert len(outcomes) > 6


def test_pointing_error_of_a_history_is_in_the_chosen_convention(env):
    half = env.replace(reward=reward.from_config(RewardConfig(), "half"))
    history = _fly(IDLE, _scenario(_turned(1.0)), half, 3)
    np.testing.assert_allclose(history.pointing_error, 0.5, rtol=1e-6)
    np.testing.assert_allclose(history.pointing_error, reward.pointing_error(history.state.angle, half.reward))


# Shield and uncertainty


def test_without_a_shield_nothing_is_changed(results):
    for name in ("intervention_rate", "mean_torque_change", "deadlocked"):
        np.testing.assert_array_equal(getattr(results, name), 0)


@pytest.mark.slow
def test_what_the_shield_changed_is_counted_in_newton_metres():
    """Against the history: the torque flown is not the one that the controller answers to its state."""
    task = TaskConfig.model_validate({"spacecraft": {"torque_limit": (0.5, 2.0, 1.2)}})
    env = under_shield(Reorientation.from_config(task), ShieldConfig())
    flown = _cases()["across the zone"][1]
    result, history = _run(STEADY, flown, env, STEPS), _fly(STEADY, flown, env, STEPS)
    actions = -(6.0 * history.attitude_error[:, 1:] + 25.0 * history.state.body.omega_BN_B)
    asked = np.array([0.5, 2.0, 1.2]) * np.clip(np.asarray(actions, float), -1.0, 1.0)
    changes = np.linalg.norm(np.asarray(history.torque_B, float) - asked, axis=1)[:-1]
    assert 0.0 < float(result.intervention_rate) < 1.0
    np.testing.assert_allclose(result.intervention_rate, np.mean(changes > 1e-4), atol=2.5 / STEPS)
    np.testing.assert_allclose(result.mean_torque_change, np.mean(changes), rtol=1e-3, atol=1e-6)
    assert not bool(result.violated)


@pytest.mark.slow
def test_a_maneuver_with_errors_is_that_of_its_key(env):
    """The truth and the noise are drawn by the key: the same flight again, measured or recorded, and another else."""
    errors = UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.02, attitude_noise_deg=0.1, rate_noise_deg=0.02)
    uncertain = env.replace(uncertainty=uncertainty.from_config(errors), episode_steps=100)
    flown, keys = _cases()["across the zone"][1], jax.random.split(jax.random.key(0), 2)
    run = jax.jit(lambda key: rollout.run_case(uncertain, STEADY, flown, key=key))
    fly = jax.jit(lambda key: rollout.fly(uncertain, STEADY, flown, key))
    first, again, other = run(keys[0]), run(keys[0]), run(keys[1])
    jax.tree.map(np.testing.assert_array_equal, first, again)
    np.testing.assert_allclose(fly(keys[0]).pointing_error[-1], first.control_accuracy, rtol=1e-3)
    free = _run(STEADY, flown, env, 100)
    assert len({float(one.control_accuracy) for one in (first, other, free)}) == 3


# What is not finite


class Broken(Memoryless):
    """Goes wrong after a while."""

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        return jnp.where(state.steps < 30, 0.0, jnp.nan) * jnp.ones(3), memory


NAN_AXIS = (float("nan"), 0.0, 0.0)


@pytest.mark.parametrize(
    ("controller", "flown"),
    [
        (IDLE, _scenario(IDENTITY, axis=NAN_AXIS, half_angle=0.4)),
        (IDLE, _scenario(IDENTITY, half_angle=float("nan"))),
        (IDLE, _scenario((float("nan"), 0.0, 0.0, 0.0), half_angle=0.4)),
        (IDLE, _scenario(IDENTITY, omega=(float("inf"), 0.0, 0.0), half_angle=0.4)),
        (Broken(), _scenario(IDENTITY, half_angle=0.4)),
    ],
    ids=["axis", "half angle", "attitude", "rate", "action"],
)
def test_what_is_not_finite_is_never_a_success(controller, flown, env):
    """At rest on the target, which would be settled from the start and never in the zone."""
    result = _run(controller, flown, env, 50)
    assert bool(result.violated) and not bool(result.settled) and not bool(result.success)
    assert np.isnan(result.settling_time)


@pytest.mark.slow
def test_a_start_inside_a_zone_is_named_an_unsafe_one_with_and_without_a_shield(results, env):
    inside = [name == "out of a zone at the start" for name in NAMES]
    np.testing.assert_array_equal(results.unsafe_start, inside)
    shielded = _run(IDLE, _cases()["out of a zone at the start"][1], under_shield(env, ShieldConfig()), 1)
    assert bool(shielded.unsafe_start)


@pytest.mark.slow
def test_agility_is_what_the_history_shows():
    """Largest rate, total variation of the torque, and the squared action at the end, from the history in float64."""
    agent = load_controller("pd")
    drawn = scenario.paper_test()
    short = TaskConfig(episode_seconds=5.0)
    history, result = cases.fly_scenario(agent, drawn, short)
    rates = np.linalg.norm(np.asarray(history.state.body.omega_BN_B, float), axis=1)
    torques = np.asarray(history.state.torque_B[1:], float)
    np.testing.assert_allclose(result.peak_rate, rates.max(), rtol=1e-5)
    np.testing.assert_allclose(result.torque_variation, np.abs(np.diff(torques, axis=0)).sum(), rtol=1e-4)
    np.testing.assert_allclose(result.unrest, np.mean((torques[-10:] / 2.0) ** 2), rtol=1e-4)
    assert float(result.torque_variation) > 0.0 and float(result.unrest) > 0.0
