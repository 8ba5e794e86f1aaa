import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.config.task import RewardConfig
from koz_jax.task import reward, scenario
from koz_jax.task.actuators import TorqueLimits
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.reward import PAPER_WEIGHTS, Outcome, RewardParams, RewardTerms

LIMITS = TorqueLimits(jnp.full(3, 2.0))
NAMES = [field.name for field in dataclasses.fields(RewardTerms)]

_terms = jax.jit(reward.terms)
_terms_batch = jax.jit(jax.vmap(reward.terms, in_axes=(0, None, None)))


@pytest.fixture(scope="module")
def full() -> RewardParams:
    return reward.from_config(RewardConfig(), "full")


@pytest.fixture(scope="module")
def half() -> RewardParams:
    return reward.from_config(RewardConfig(), "half")


def _outcome(**measured: float | np.floating) -> Outcome:
    defaults = {"angle": 1.0, "angle_previous": 1.1, "torque": 0.0, "torque_change": 0.0, "zone_margin": 1.0}
    defaults["intervention"] = 0.0
    return Outcome(**{name: jnp.float32(value) for name, value in (defaults | measured).items()})


def _terms_of(params: RewardParams, **measured: float | np.floating) -> dict[str, float]:
    found = _terms(_outcome(**measured), params, LIMITS)
    return {name: float(getattr(found, name)) for name in NAMES}


@pytest.mark.slow
@pytest.mark.parametrize(("convention", "factor"), [("full", 1.0), ("half", 0.5)])
def test_every_term_agrees_with_the_oracle(convention, factor, request):
    params = request.getfixturevalue(convention)
    rng = np.random.default_rng(0)
    count = 300
    # Half of the cases close to the target and to the zone's edge, where the terms bend.
    scale = np.where(rng.random(count) < 0.5, 1.0, 0.003)
    angle = rng.uniform(0.0, 2 * np.pi, count) * scale
    angle_previous = np.abs(angle + rng.normal(scale=0.05, size=count) * scale)
    torque = rng.uniform(-2.0, 2.0, (count, 3))
    torque_previous = rng.uniform(-2.0, 2.0, (count, 3))
    margin = rng.uniform(-0.5, 2.0, count) * np.where(rng.random(count) < 0.5, 1.0, 0.05)
    outcome = Outcome(
        angle=jnp.array(angle, jnp.float32),
        angle_previous=jnp.array(angle_previous, jnp.float32),
        torque=jnp.array(np.linalg.norm(torque, axis=1), jnp.float32),
        torque_change=jnp.array(np.linalg.norm(torque - torque_previous, axis=1), jnp.float32),
        zone_margin=jnp.array(margin, jnp.float32),
        intervention=jnp.zeros(count),
    )
    found = _terms_batch(outcome, params, LIMITS)
    total = jax.vmap(reward.total, in_axes=(0, None))(found, PAPER_WEIGHTS)
    seen = set()
    for i in range(count):
        expected = oracle.reward_terms(
            factor * angle[i], factor * angle_previous[i], torque[i], torque_previous[i], margin[i]
        )
        for name, value in expected.items():
            np.testing.assert_allclose(getattr(found, name)[i], value, rtol=1e-5, atol=1e-5, err_msg=f"{name} of {i}")
        np.testing.assert_allclose(total[i], sum(expected.values()), rtol=1e-5, atol=1e-5)
        seen.add((expected["settled"] > 0, expected["no_progress"] < 0, expected["zone"] == -10.0))
    assert len(seen) == 8, "the draw must reach every branch of the reward"


def test_half_convention_is_the_full_one_of_half_the_angle(full, half):
    for angle in (0.0, 0.006, 1.0, 2 * np.pi):
        assert reward.pointing_error(jnp.float32(angle), half) == np.float32(angle) / 2
        assert _terms_of(half, angle=angle, angle_previous=7.0) == _terms_of(full, angle=angle / 2, angle_previous=7.0)


@pytest.mark.parametrize(("convention", "factor"), [("full", 1.0), ("half", 0.5)])
def test_settled_bonus_is_paid_exactly_at_the_threshold_and_not_beyond(convention, factor, request):
    params = request.getfixturevalue(convention)
    threshold = np.float32(params.settled_angle) / np.float32(factor)
    np.testing.assert_allclose(factor * threshold, np.deg2rad(0.25), rtol=1e-6)
    assert _terms_of(params, angle=threshold)["settled"] == 9.0
    assert _terms_of(params, angle=0.0)["settled"] == 9.0
    assert _terms_of(params, angle=np.nextafter(threshold, np.float32(1.0)))["settled"] == 0.0
    assert bool(reward.is_settled(jnp.float32(threshold), params))


def test_a_tie_is_no_progress_by_default(full):
    assert _terms_of(full, angle=1.0, angle_previous=1.0)["no_progress"] == -1.0
    assert _terms_of(full, angle=np.nextafter(np.float32(1.0), np.float32(0.0)), angle_previous=1.0)["no_progress"] == 0


def test_with_a_tolerance_a_tie_is_progress_and_growth_beyond_it_is_not():
    params = reward.from_config(RewardConfig(progress_tolerance_deg=0.01), "full")
    tolerance = np.deg2rad(0.01)
    assert _terms_of(params, angle=1.0, angle_previous=1.0)["no_progress"] == 0.0
    assert _terms_of(params, angle=1.0 + 0.9 * tolerance, angle_previous=1.0)["no_progress"] == 0.0
    assert _terms_of(params, angle=1.0 + 1.1 * tolerance, angle_previous=1.0)["no_progress"] == -1.0


def test_progress_is_what_growth_of_the_scalar_part_means_beyond_half_a_turn(full):
    """q_e0 falls on the way from 180 to 360 deg: the far side counts as further away, as in the paper."""
    for angle in np.linspace(0.1, 6.2, 40):
        grows = np.cos((angle - 0.01) / 2) > np.cos(angle / 2)
        found = _terms_of(full, angle=angle - 0.01, angle_previous=angle)["no_progress"]
        assert (found == 0.0) == grows


def test_largest_torque_costs_five_hundredths(full):
    assert _terms_of(full, torque=2.0 * np.sqrt(3.0))["torque"] == pytest.approx(-0.05, rel=1e-6)


def test_torque_is_judged_relative_to_the_limit_of_the_spacecraft(full):
    found = _terms(_outcome(torque=3.0), full, TorqueLimits(jnp.full(3, 6.0)))
    assert float(found.torque) == pytest.approx(_terms_of(full, torque=1.0)["torque"], rel=1e-6)
    assert float(found.effort) == pytest.approx(_terms_of(full, torque=1.0)["effort"], rel=1e-6)


def test_zone_penalty_is_ten_inside_and_falls_continuously_from_the_edge(full):
    penalty = jax.jit(reward.zone_penalty)
    assert [float(penalty(np.float32(m), full)) for m in (-np.pi, -0.1, -1e-6, 0.0)] == [10.0] * 4
    assert float(penalty(np.float32(1e-6), full)) == pytest.approx(10.0, abs=1e-3)
    outside = [float(penalty(np.float32(m), full)) for m in np.linspace(0.0, 0.5, 50)]
    assert np.all(np.diff(outside) < 0)
    assert outside[-1] == pytest.approx(10.0 * np.exp(-33.0), rel=1e-4)
    assert float(penalty(np.float32(-ABSENT_HALF_ANGLE), full)) < 1e-30


def test_tightening_moves_the_edge_of_the_penalty_outwards(full):
    tightened = full.replace(zone_tightening=jnp.float32(0.02))
    for margin in (-0.1, 0.0, 0.01, 0.03, 0.2):
        assert _terms_of(tightened, zone_margin=margin + 0.02)["zone"] == pytest.approx(
            _terms_of(full, zone_margin=margin)["zone"], rel=1e-4
        )
    assert _terms_of(tightened, zone_margin=0.0199)["zone"] == -10.0
    elsewhere = set(NAMES) - {"zone"}
    found, plain = _terms_of(tightened, zone_margin=0.01), _terms_of(full, zone_margin=0.01)
    assert {name: found[name] for name in elsewhere} == {name: plain[name] for name in elsewhere}


def test_only_being_on_target_is_rewarded(full):
    found = _terms_of(
        full, angle=0.0, angle_previous=0.0, torque=1.0, torque_change=1.0, zone_margin=0.0, intervention=1.0
    )
    assert {name for name, value in found.items() if value > 0} == {"attitude", "settled"}
    assert {name for name, value in found.items() if value < 0} == set(NAMES) - {"attitude", "settled"}


def test_paper_reward_leaves_out_effort_and_intervention_and_nothing_else(full):
    found = _terms(_outcome(torque=1.0, torque_change=1.0, zone_margin=0.01, intervention=1.0), full, LIMITS)
    expected = sum(float(getattr(found, name)) for name in NAMES if name not in ("effort", "intervention"))
    assert float(reward.total(found, PAPER_WEIGHTS)) == pytest.approx(expected, rel=1e-6)


def test_total_is_the_weighted_sum():
    rng = np.random.default_rng(1)
    values, weights = rng.normal(size=(2, len(NAMES)))
    found = reward.total(RewardTerms(*jnp.array(values, jnp.float32)), RewardTerms(*jnp.array(weights, jnp.float32)))
    assert float(found) == pytest.approx(values @ weights, rel=1e-5)


def test_effort_is_minus_the_squared_norm_of_the_action(full):
    action = np.array([0.3, -0.4, 1.0])
    found = _terms_of(full, torque=float(np.linalg.norm(2.0 * action)))
    assert found["effort"] == pytest.approx(-np.sum(action**2), rel=1e-6)


@pytest.mark.slow
def test_largest_torque_of_unequal_limits_costs_five_hundredths(full):
    """|tau_max| is the norm of the box's corner, and effort counts shares of the limits' mean square."""
    limits = np.array([0.5, 1.0, 3.0])
    found = _terms(_outcome(torque=np.linalg.norm(limits)), full, TorqueLimits(jnp.array(limits, jnp.float32)))
    assert float(found.torque) == pytest.approx(-0.05, rel=1e-6)
    assert float(found.effort) == pytest.approx(-3.0, rel=1e-6)


@pytest.mark.parametrize("limit", [0.3, 2.0, 7.0])
def test_for_equal_limits_effort_is_minus_the_squared_norm_of_the_action(full, limit):
    action = np.array([0.3, -0.4, 1.0])
    limits = TorqueLimits(jnp.full(3, limit))
    found = _terms(_outcome(torque=float(np.linalg.norm(limit * action))), full, limits)
    assert float(found.effort) == pytest.approx(-np.sum(action**2), rel=1e-6)
    assert float(found.torque) == pytest.approx(-0.05 * np.linalg.norm(action) / np.sqrt(3.0), rel=1e-6)


def test_torque_change_counts_from_the_second_step_on(env: Reorientation):
    state, costs = env.reset(scenario.paper_test()), []
    step = jax.jit(env.step)
    for action in ([1.0, -1.0, 0.5], [-1.0, -1.0, 0.5], [-1.0, -1.0, 0.5]):
        stepped = step(state, jnp.array(action))
        state = stepped.state
        costs.append(float(stepped.terms.torque_change))
    assert costs == [0.0, pytest.approx(-0.005 * 4.0), 0.0]
