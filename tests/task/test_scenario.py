import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from support import oracle

from koz_jax.config.task import ScenarioConfig, SpacecraftConfig, TaskConfig
from koz_jax.task import scenario
from koz_jax.task.scenario import SamplingRule, Scenario, ScenarioRanges

COUNT = 3000
# A draw that follows its distribution falls below this once in a thousand seeds; the seed is fixed.
UNLIKELY = 1e-3

BORESIGHT = (1.0, 0.0, 0.0)
RESAMPLE, SHRINK = SamplingRule("resample"), SamplingRule("shrink")


def _ranges(
    low: float, high: float, config: ScenarioConfig | None = None, boresight: tuple[float, float, float] = BORESIGHT
) -> ScenarioRanges:
    task = TaskConfig(scenario=config or ScenarioConfig(), spacecraft=SpacecraftConfig(boresight=boresight))
    return scenario.from_config(task, low, high)


def _keys() -> jax.Array:
    return jax.random.split(jax.random.key(5), COUNT)


@functools.partial(jax.jit, static_argnames="rule")
def _sample_batch(ranges: ScenarioRanges, rule: SamplingRule) -> Scenario:
    return jax.vmap(lambda key: scenario.sample(key, ranges, rule))(_keys())


def _draw(ranges: ScenarioRanges, rule: SamplingRule) -> Scenario:
    return jax.tree.map(np.asarray, _sample_batch(ranges, rule))


def _angle_deg(drawn: Scenario) -> np.ndarray:
    return np.rad2deg(oracle.rotation_angle(drawn.initial.q_BN))


def _half_angle_deg(drawn: Scenario) -> np.ndarray:
    return np.rad2deg(drawn.constraints.half_angle[:, 0].astype(np.float64))


def _room_deg(drawn: Scenario, boresight: np.ndarray = oracle.BORESIGHT) -> np.ndarray:
    """Smaller of the angles from the zone's axis to the boresight at start and at target."""
    axis = drawn.constraints.axis_N[:, 0]
    start = oracle.rotation(drawn.initial.q_BN).apply(boresight)
    target = oracle.rotation(drawn.q_DN).apply(boresight)
    return np.rad2deg(np.minimum(oracle.angle_between(start, axis), oracle.angle_between(target, axis)))


@pytest.fixture(scope="module")
def resampled() -> Scenario:
    return _draw(_ranges(80.0, 180.0), RESAMPLE)


@pytest.fixture(scope="module")
def shrunk() -> Scenario:
    """Small deviations too, so that all three branches of the rule occur."""
    return _draw(_ranges(20.0, 180.0), SHRINK)


def test_deviation_is_uniform_in_its_range(shrunk):
    angle = _angle_deg(shrunk)
    assert angle.min() >= 20.0 - 1e-4
    assert angle.max() <= 180.0 + 1e-4
    assert stats.kstest(angle, stats.uniform(20.0, 160.0).cdf).pvalue > UNLIKELY


@pytest.mark.parametrize("component", [0, 1, 2])
def test_deviation_axis_is_uniform_on_the_sphere(shrunk, component):
    q_vec = shrunk.initial.q_BN[:, 1:]
    axis = q_vec / np.linalg.norm(q_vec, axis=1, keepdims=True)
    # Archimedes: each component of a uniform direction is uniform.
    assert stats.kstest(axis[:, component], stats.uniform(-1.0, 2.0).cdf).pvalue > UNLIKELY


@pytest.mark.slow
@pytest.mark.parametrize("rule", ["shrunk", "resampled"])
def test_attitude_is_a_unit_quaternion_with_non_negative_scalar_part(rule, request):
    q = request.getfixturevalue(rule).initial.q_BN
    assert np.all(q[:, 0] >= 0.0)
    np.testing.assert_allclose(np.linalg.norm(q.astype(np.float64), axis=1), 1.0, atol=3e-7)


@pytest.mark.slow
def test_half_a_turn_has_no_scalar_part():
    drawn = _draw(_ranges(180.0, 180.0), RESAMPLE)
    # float32(pi) is above pi, so the rounded value may be one ulp of 1 below zero.
    np.testing.assert_allclose(drawn.initial.q_BN[:, 0], 0.0, atol=1e-7)


def test_bias_raises_the_uniform_draw_to_a_power():
    ranges = _ranges(10.0, 170.0).replace(angle_bias=jnp.float32(2.0))
    angle = _angle_deg(_draw(ranges, SHRINK))
    share = np.clip((angle - 10.0) / 160.0, 0.0, 1.0)
    assert stats.kstest(np.sqrt(share), stats.uniform().cdf).pvalue > UNLIKELY


@pytest.mark.parametrize("component", [0, 1, 2])
def test_initial_rate_is_uniform_per_axis(resampled, component):
    rate = np.rad2deg(resampled.initial.omega_BN_B[:, component].astype(np.float64))
    assert np.abs(rate).max() <= 0.001 * (1 + 1e-6)
    assert stats.kstest(rate, stats.uniform(-0.001, 0.002).cdf).pvalue > UNLIKELY


def test_rate_deviation_axis_and_zone_are_drawn_independently(shrunk):
    q_vec = shrunk.initial.q_BN[:, 1:]
    columns = np.concatenate(
        [
            shrunk.initial.omega_BN_B,
            q_vec / np.linalg.norm(q_vec, axis=1, keepdims=True),
            _angle_deg(shrunk)[:, None],
        ],
        axis=1,
    )
    correlation = np.corrcoef(columns.astype(np.float64).T)
    assert np.abs(correlation - np.eye(7)).max() < 4.5 / np.sqrt(COUNT)


def test_target_attitude_is_the_identity(resampled):
    np.testing.assert_array_equal(resampled.q_DN, np.tile([1.0, 0.0, 0.0, 0.0], (COUNT, 1)))


@pytest.mark.parametrize("boresight", [(1.0, 0.0, 0.0), (0.48, -0.6, 0.64)])
def test_zone_axis_is_the_boresight_half_way_along_the_shortest_rotation(boresight):
    drawn = _draw(_ranges(80.0, 179.0, boresight=boresight), RESAMPLE)
    cases = zip(drawn.initial.q_BN, drawn.q_DN, drawn.constraints.axis_N, strict=True)
    for q, q_target, axis in itertools.islice(cases, 200):
        middle = oracle.half_way(q, q_target).apply(boresight)
        # Near half a turn the shortest rotation is ill-conditioned in float32.
        assert oracle.angle_between(middle, axis[0]) < 2e-5


def test_there_is_one_zone_per_scenario(resampled):
    assert resampled.constraints.axis_N.shape == (COUNT, 1, 3)
    assert resampled.constraints.half_angle.shape == (COUNT, 1)
    np.testing.assert_array_equal(resampled.constraints.boresight_B, np.tile(oracle.BORESIGHT, (COUNT, 1, 1)))
    np.testing.assert_allclose(np.linalg.norm(resampled.constraints.axis_N[:, 0], axis=1), 1.0, atol=1e-6)


def test_resample_leaves_start_and_target_outside_by_the_separation(resampled):
    assert np.all(_room_deg(resampled) >= _half_angle_deg(resampled) + 2.0 - 1e-4)


def test_resample_always_gives_a_zone_of_full_range(resampled):
    half_angle = _half_angle_deg(resampled)
    assert half_angle.min() >= 15.0 - 1e-4
    assert half_angle.max() <= 30.0 + 1e-4


def test_resample_is_the_plain_distribution_given_that_the_zone_fits(resampled):
    """Rejection sampling with NumPy as the reference, for deviation, half angle and room."""
    rng = np.random.default_rng(0)
    count = 40_000
    angle = rng.uniform(80.0, 180.0, count)
    axis = rng.normal(size=(count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half_angle = rng.uniform(15.0, 30.0, count)
    middle = oracle.Rotation.from_rotvec(np.deg2rad(angle / 2)[:, None] * axis).apply(oracle.BORESIGHT)
    room = np.rad2deg(oracle.angle_between(middle, oracle.BORESIGHT))
    fits = room >= half_angle + 2.0
    assert 0.5 < fits.mean() < 0.99, "the condition must bite"
    for found, expected in (
        (_angle_deg(resampled), angle),
        (_half_angle_deg(resampled), half_angle),
        (_room_deg(resampled), room),
    ):
        _, pvalue = np.asarray(stats.ks_2samp(found, expected[fits]))
        assert pvalue > UNLIKELY


@pytest.mark.slow
def test_resample_that_gives_up_still_keeps_the_separation_or_leaves_the_zone_out():
    drawn = _draw(_ranges(20.0, 60.0), SamplingRule("resample", max_draws=2))
    half_angle, room = _half_angle_deg(drawn), _room_deg(drawn)
    zone = half_angle > 0
    assert np.any(zone)
    assert np.any(~zone)
    assert np.all(room[zone] >= half_angle[zone] + 2.0 - 1e-4)
    assert np.all(half_angle[zone] >= 15.0 - 1e-4)
    assert np.all(room[~zone] < 17.0 + 1e-4)


@pytest.mark.slow
def test_resample_that_keeps_the_angle_leaves_the_deviations_as_the_range_says():
    """Drawing them again favours large ones, also where no zone fits at all."""
    drawn = _draw(_ranges(20.0, 180.0), SamplingRule("resample", max_draws=8, keep_angle=True))
    angle, half_angle, room = _angle_deg(drawn), _half_angle_deg(drawn), _room_deg(drawn)
    assert stats.kstest(angle, stats.uniform(20.0, 160.0).cdf).pvalue > UNLIKELY
    zone = half_angle > 0
    assert np.all(room[zone] >= half_angle[zone] + 2.0 - 1e-4)
    assert np.all(half_angle[zone] >= 15.0 - 1e-4)
    # The boresight is at most half the deviation away from the axis half-way.
    assert not np.any(zone[angle < 2 * 17.0 - 1e-3])
    assert np.mean(zone[angle > 80.0]) > 0.99


def test_shrink_leaves_the_zone_out_exactly_where_the_smallest_does_not_fit(shrunk):
    half_angle, room = _half_angle_deg(shrunk), _room_deg(shrunk)
    clear = np.abs(room - 17.0) > 1e-3
    np.testing.assert_array_equal((half_angle < 0)[clear], (room < 17.0)[clear])
    assert 0 < np.sum(half_angle < 0) < COUNT


def test_shrink_without_a_zone_keeps_a_margin_everywhere(shrunk):
    # theta is never negative, so a margin above pi at theta = 0 is one everywhere.
    half_angle = _half_angle_deg(shrunk)
    assert np.all(half_angle[half_angle < 0] <= -180.0 + 1e-4)


def test_shrink_draws_the_half_angle_uniformly_up_to_what_fits(shrunk):
    half_angle, room = _half_angle_deg(shrunk), _room_deg(shrunk)
    largest = np.minimum(30.0, room - 2.0)
    assert np.any(largest[half_angle > 0] < 30.0)
    wide = largest - 15.0 > 0.5  # elsewhere rounding dominates the share
    share = (half_angle[wide] - 15.0) / (largest[wide] - 15.0)
    assert share.min() >= -1e-4
    assert share.max() <= 1.0 + 1e-4
    assert stats.kstest(share, stats.uniform().cdf).pvalue > UNLIKELY


@pytest.mark.slow
@pytest.mark.parametrize(("batch", "rule", "low"), [("resampled", RESAMPLE, 80.0), ("shrunk", SHRINK, 20.0)])
def test_a_key_gives_the_same_scenario_alone_and_among_others(batch, rule, low, request):
    together = jax.tree.map(lambda leaf: leaf[:32], request.getfixturevalue(batch))
    sample_one = jax.jit(functools.partial(scenario.sample, ranges=_ranges(low, 180.0), rule=rule))
    alone = jax.tree.map(lambda *leaves: np.stack(leaves), *(sample_one(key) for key in _keys()[:32]))
    # Vectorised sine and cosine may differ from scalar ones in the last bits.
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6, atol=3e-7), together, alone)


def test_different_keys_give_different_scenarios(resampled):
    q = resampled.initial.q_BN
    assert len(np.unique(q, axis=0)) == COUNT


def test_no_random_key_is_used_twice():
    with jax.debug_key_reuse(True):
        jax.jit(functools.partial(scenario.sample, ranges=_ranges(80.0, 180.0)))(jax.random.key(1))


def test_paper_scenario_has_its_zone_half_way_along_the_shortest_rotation():
    drawn = scenario.paper_test()
    middle = oracle.half_way(np.asarray(drawn.initial.q_BN), np.asarray(drawn.q_DN)).apply(oracle.BORESIGHT)
    assert np.rad2deg(oracle.angle_between(middle, np.array([0.703, 0.263, 0.661]))) < 0.02
    assert np.rad2deg(oracle.angle_between(middle, drawn.constraints.axis_N[0])) < 0.02


def test_paper_scenario_is_that_of_its_table():
    drawn = scenario.paper_test()
    assert np.rad2deg(oracle.rotation_angle(drawn.initial.q_BN)) == pytest.approx(100.0, abs=0.01)
    np.testing.assert_allclose(drawn.initial.q_BN, [0.6428, 0.3138, -0.5892, 0.3757], atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(drawn.initial.q_BN), 1.0, atol=1e-6)
    np.testing.assert_array_equal(drawn.q_DN, [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(np.rad2deg(drawn.initial.omega_BN_B), [-5.7e-4, -1.1e-4, -9.9e-4], rtol=1e-5)
    np.testing.assert_allclose(drawn.constraints.axis_N, [[0.703, 0.263, 0.661]], atol=1e-3)
    np.testing.assert_allclose(np.rad2deg(drawn.constraints.half_angle), [15.2], rtol=1e-6)


SEVERAL = ScenarioConfig(min_zones=1, max_zones=4)


def test_zones_turn_at_the_rate_that_is_set_and_begin_as_those_that_stand_still(resampled):
    turning = _draw(_ranges(80.0, 180.0, ScenarioConfig(cone_rate_deg=0.5)), RESAMPLE)
    rates = turning.constraints.axis_rate_N
    assert rates is not None
    np.testing.assert_allclose(np.rad2deg(np.linalg.norm(rates, axis=-1)), 0.5, rtol=1e-6)
    # Uniform over the sphere: each component of a direction is uniform in [-1, 1].
    along = rates[:, 0] / np.linalg.norm(rates[:, 0], axis=-1, keepdims=True)
    for component in range(3):
        assert stats.kstest(along[:, component], stats.uniform(-1.0, 2.0).cdf).pvalue > UNLIKELY
    for one, other in zip(
        jax.tree.leaves(turning.replace(constraints=turning.constraints.replace(axis_rate_N=None))),
        jax.tree.leaves(resampled),
        strict=True,
    ):
        np.testing.assert_allclose(one, other, rtol=5e-7, atol=1e-7)  # two programs


@pytest.fixture(scope="module")
def crowded() -> Scenario:
    """Cases with one to four zones."""
    return _draw(_ranges(80.0, 180.0, SEVERAL), RESAMPLE)


@pytest.mark.slow
def test_every_zone_leaves_start_and_target_free_and_a_gap_to_the_others(crowded):
    present = np.asarray(crowded.constraints.half_angle) > 0.0
    axes, half_angles = np.asarray(crowded.constraints.axis_N), np.asarray(crowded.constraints.half_angle)
    for q, zone_axes, sizes, here in list(zip(crowded.initial.q_BN, axes, half_angles, present, strict=True))[:400]:
        for look in (np.asarray(BORESIGHT), oracle.rotation(q).apply(BORESIGHT)):
            assert np.all((oracle.angle_between(look, zone_axes) - sizes)[here] >= np.deg2rad(2.0) - 1e-5)
        for i, j in itertools.combinations(np.flatnonzero(here), 2):
            between = oracle.angle_between(zone_axes[i], zone_axes[j]) - sizes[i] - sizes[j]
            assert between >= np.deg2rad(10.0) - 1e-5
    sizes_deg = np.rad2deg(half_angles[present])
    assert sizes_deg.min() >= 15.0 - 1e-4 and sizes_deg.max() <= 30.0 + 1e-4


def test_the_number_of_zones_is_uniform_up_to_those_that_find_no_place(crowded):
    count = np.sum(np.asarray(crowded.constraints.half_angle) > 0.0, axis=1)
    assert np.all(count >= 1)
    shares = np.bincount(count, minlength=5)[1:] / len(count)
    # Few draws of four zones find no place for the last: the standard deviation of a share is 0.008.
    np.testing.assert_allclose(shares, 0.25, atol=0.04)


def test_the_first_zone_and_all_else_do_not_depend_on_how_many_zones_there_are(crowded):
    single = _draw(_ranges(80.0, 180.0), RESAMPLE)
    first = jax.tree.map(lambda leaf: leaf[:, :1], crowded.constraints)
    for one, many in zip(jax.tree.leaves(single), jax.tree.leaves(crowded.replace(constraints=first)), strict=True):
        np.testing.assert_allclose(one, many, rtol=5e-7, atol=1e-7)  # two programs


@pytest.mark.slow
def test_zones_of_several_instruments_leave_start_and_target_clear_and_a_gap_to_those_of_the_same_instrument():
    others_B = jnp.array([[0.0, 1.0, 0.0], [0.0, -0.6, 0.8]])
    many = ScenarioConfig(min_zones=1, max_zones=4)
    ranges = _ranges(80.0, 180.0, many).replace(others_B=others_B, keep_in=jnp.float32(0.3))
    drawn = _draw(ranges, RESAMPLE)
    zones = drawn.constraints
    present = np.asarray(zones.half_angle) > 0.0
    assert np.bincount(present.sum(axis=1), minlength=5)[1:].min() > COUNT / 10
    for attitude in (drawn.initial.q_BN, drawn.q_DN):
        looks = np.stack([oracle.rotation(attitude).apply(zones.boresight_B[:, i]) for i in range(4)], axis=1)
        margin = oracle.angle_between(looks, zones.axis_N) - zones.half_angle
        assert np.rad2deg(margin[present].min()) > 2.0 - 1e-3
    gaps = []
    for i, j in itertools.combinations(range(4), 2):
        same = present[:, i] & present[:, j] & np.all(zones.boresight_B[:, i] == zones.boresight_B[:, j], axis=1)
        apart = oracle.angle_between(zones.axis_N[same, i], zones.axis_N[same, j])
        gaps.append(np.rad2deg(apart - zones.half_angle[same, i] - zones.half_angle[same, j]))
    assert min(gap.min() for gap in gaps) > 10.0 - 1e-3
    of = [np.all(zones.boresight_B[present] == other, axis=1) for other in np.vstack([[BORESIGHT], others_B])]
    assert np.sum(of) == present.sum() and min(each.sum() for each in of) > COUNT / 5
    # A cone that an instrument is kept in is wider outside than any that it is kept out of.
    wide = np.asarray(zones.half_angle)[present] > np.deg2rad(30.0 + 1e-3)
    assert not wide[of[0]].any() and 0.02 < wide[~of[0]].mean() < 0.3
    assert np.rad2deg(np.asarray(zones.half_angle)[present][wide].min()) > 80.0 - 1e-3
