"""What people give: normalised, or refused by name; a false "safe" is never made of it."""

import logging
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

import koz_jax
from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.task import maneuver, scenario
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.scenario import Scenario

NAN, INF = float("nan"), float("inf")


def turned(degrees: float, axis=(0.0, 0.0, 1.0)) -> np.ndarray:
    half = np.deg2rad(degrees) / 2
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


GOOD: dict[str, Any] = {"start": turned(120.0), "target": (1.0, 0.0, 0.0, 0.0), "zones": [((0.0, 0.0, 1.0), 20.0)]}


def test_a_maneuver_holds_what_was_said():
    drawn = koz_jax.maneuver(
        turned(120.0), turned(10.0), [((0.6, 0.8, 0.0), 20.0), ((0.0, 0.0, 1.0), 15.0, (0.0, 1.0, 0.0))],
        boresight=(0.0, 0.0, 1.0), rate_deg=(0.0, 1.0, -2.0),
    )  # fmt: skip
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(drawn))
    np.testing.assert_allclose(drawn.initial.q_BN, turned(120.0), atol=1e-7)
    np.testing.assert_allclose(drawn.initial.omega_BN_B, np.deg2rad([0.0, 1.0, -2.0]), rtol=1e-6)
    np.testing.assert_allclose(drawn.q_DN, turned(10.0), atol=1e-7)
    np.testing.assert_allclose(drawn.constraints.boresight_B, [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    np.testing.assert_allclose(drawn.constraints.axis_N, [[0.6, 0.8, 0.0], [0.0, 0.0, 1.0]], rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(drawn.constraints.half_angle), [20.0, 15.0], rtol=1e-6)


def test_without_zones_there_is_a_stand_in_for_none():
    drawn = koz_jax.maneuver(turned(120.0))
    assert drawn.constraints.count == 1 and not bool(drawn.constraints.is_present[0])


def test_a_length_that_is_off_by_rounding_is_made_one():
    drawn = koz_jax.maneuver(1.005 * turned(120.0), 0.995 * turned(3.0), [((0.5, 0.866, 0.0), 20.0)])
    for leaf in (drawn.initial.q_BN, drawn.q_DN, drawn.constraints.axis_N[0]):
        np.testing.assert_allclose(np.linalg.norm(np.asarray(leaf, np.float64)), 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"start": (0, 0, 0, 0)}, r"start: must have length 1 .*, got \[0.0, 0.0, 0.0, 0.0\] of length 0"),
        ({"start": (2, 0, 0, 0)}, "start: must have length 1 .* of length 2"),
        ({"start": (NAN, 0, 0, 1)}, "start: must be finite"),
        ({"start": (1, 0, 0)}, r"start: must have shape \(4,\), got \(3,\)"),
        ({"start": "up"}, "start: must be an array of real numbers"),
        ({"target": (0.5, 0.5, 0.5, 0.4)}, "target: must have length 1 .* of length 0.953939"),
        ({"target": (INF, 0, 0, 0)}, "target: must be finite"),
        ({"boresight": (1, 1, 0)}, "boresight: must have length 1 .* of length 1.41421"),
        ({"rate_deg": (NAN, 0, 0)}, "rate_deg: must be finite"),
        ({"rate_deg": 3.0}, r"rate_deg: must have shape \(3,\)"),
        ({"zones": [((500, 866.0254, 0), 20)]}, r"zones\[0\], axis: must have length 1 .* of length 1000"),
        ({"zones": [((8, 6, 1), 30)]}, r"zones\[0\], axis: must have length 1 .* of length 10.0499"),
        ({"zones": [((0, 0, 1), 20), ((0, 0, 0), 20)]}, r"zones\[1\], axis: must have length 1 .* of length 0"),
        ({"zones": [((0, 0, NAN), 20)]}, r"zones\[0\], axis: must be finite"),
        ({"zones": [((0, 0, 1), 0)]}, r"zones\[0\], half angle: must be above 0 and below 180 deg, got 0"),
        ({"zones": [((0, 0, 1), -20)]}, "must be above 0 and below 180 deg, got -20"),
        ({"zones": [((0, 0, 1), 180)]}, "must be above 0 and below 180 deg, got 180"),
        ({"zones": [((0, 0, 1), NAN)]}, r"zones\[0\], half angle: must be finite"),
        ({"zones": [((0, 0, 1), 20, (0, 0, 2))]}, r"zones\[0\], boresight: must have length 1"),
        ({"zones": [(0, 0, 1)]}, r"zones\[0\], half angle: |zones\[0\], axis: must have shape"),
        ({"zones": [20.0]}, r"zones\[0\]: must be \(axis, half angle \[deg\]\)"),
    ],
)
def test_what_is_no_maneuver_is_refused_by_name(changes, reason):
    with pytest.raises(SettingsError, match=reason):
        koz_jax.maneuver(**{**GOOD, **changes})


def bad_scenarios() -> dict[str, tuple[Scenario, str]]:
    good = koz_jax.maneuver(**GOOD)
    zones, body = good.constraints, good.initial

    def axis(*values: float) -> Scenario:
        return good.replace(constraints=zones.replace(axis_N=jnp.array([values], jnp.float32)))

    def half_angle(value: float) -> Scenario:
        return good.replace(constraints=zones.replace(half_angle=jnp.array([value])))

    length = r"must have length 1 .* of length"
    return {
        "axis in km": (axis(500.0, 866.0254, 0.0), rf"constraints\.axis_N\[0\]: {length} 1000"),
        "axis halved": (axis(0.25, 0.433, 0.0), rf"constraints\.axis_N\[0\]: {length} 0.49998"),
        "axis zero": (axis(0.0, 0.0, 0.0), rf"constraints\.axis_N\[0\]: {length} 0$"),
        "axis nan": (axis(NAN, 0.0, 0.0), r"constraints\.axis_N\[0\]: must be finite"),
        "half angle in degrees": (half_angle(20.0), r"half_angle\[0\]: must be above 0 .*, got 20 .*like degrees"),
        "half angle negative": (half_angle(-0.3), r"half_angle\[0\]: must be above 0 and below pi rad, got -0.3"),
        "half angle nan": (half_angle(NAN), r"half_angle\[0\]: must be finite"),
        "start zero": (good.replace(initial=body.replace(q_BN=jnp.zeros(4))), rf"initial\.q_BN: {length} 0"),
        "start nan": (good.replace(initial=body.replace(q_BN=jnp.full(4, NAN))), r"initial\.q_BN: must be finite"),
        "rate inf": (good.replace(initial=body.replace(omega_BN_B=jnp.full(3, INF))), "omega_BN_B: must be finite"),
        "target long": (good.replace(q_DN=jnp.ones(4)), rf"q_DN: {length} 2"),
        "boresight": (
            good.replace(constraints=zones.replace(boresight_B=jnp.array([[0.0, 2.0, 0.0]]))),
            rf"constraints\.boresight_B\[0\]: {length} 2",
        ),
        "no stack": (good.replace(constraints=jax.tree.map(lambda leaf: leaf[0], zones)), "constraints: must be a st"),
    }  # fmt: skip


@pytest.mark.parametrize("name", bad_scenarios())
def test_a_scenario_is_refused_by_name_where_one_is_given(name):
    bad, reason = bad_scenarios()[name]
    with pytest.raises(SettingsError, match=reason):
        maneuver.checked(bad)
    with pytest.raises(SettingsError, match=reason):
        Reorientation.from_config().reset(bad)
    with pytest.raises(SettingsError, match=reason):
        koz_jax.fly_scenario(koz_jax.load_controller("pd"), bad)


def test_what_is_no_scenario_is_refused():
    anything: Any = {"start": 3}
    with pytest.raises(SettingsError, match="scenario: must be a Scenario, which"):
        maneuver.checked(anything)


@pytest.mark.slow
def test_a_drawn_scenario_stays_bit_for_bit_as_it_is():
    env = Reorientation.from_config(TaskConfig.model_validate({"scenario": {"max_zones": 3}}))
    draws = jax.jit(jax.vmap(env.sample))(jax.random.split(jax.random.key(0), 50))
    for i in range(50):
        drawn = jax.tree.map(lambda leaf, i=i: leaf[i], draws)
        jax.tree.map(np.testing.assert_array_equal, maneuver.checked(drawn), drawn)
    paper = scenario.paper_test()
    jax.tree.map(np.testing.assert_array_equal, maneuver.checked(paper), paper)


def test_lists_and_numpy_arrays_become_arrays_of_jax():
    drawn = koz_jax.maneuver(**GOOD)
    loose = jax.tree.map(lambda leaf: np.asarray(leaf, np.float64), drawn).replace(q_DN=np.array([1, 0, 0, 0]))
    right = maneuver.checked(loose)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(right))
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, atol=1e-7), right, drawn)


@pytest.mark.parametrize(("start", "target"), [(85.0, 145.0), (88.0, 138.0)])
def test_the_nearer_sign_of_the_target_is_flown_to(start, target):
    q_BN = turned(2 * start)
    for sign_start in (1, -1):
        for sign_target in (1, -1):
            drawn = koz_jax.maneuver(sign_start * q_BN, sign_target * turned(2 * target))
            q_e = oracle.product(oracle.conjugate(np.asarray(drawn.q_DN)), np.asarray(drawn.initial.q_BN))
            assert q_e[0] > 0.0
            np.testing.assert_allclose(np.rad2deg(oracle.rotation_angle(q_e)), 2 * (target - start), rtol=1e-5)


def test_a_scenario_under_jit_is_left_alone():
    env = Reorientation.from_config()
    paper = scenario.paper_test()
    flipped = paper.replace(q_DN=-paper.q_DN)
    traced = jax.jit(env.reset)(flipped)
    np.testing.assert_array_equal(traced.scenario.q_DN, flipped.q_DN)
    np.testing.assert_array_equal(env.reset(flipped).scenario.q_DN, paper.q_DN)


@pytest.mark.parametrize(("start", "target", "told"), [(120.0, 0.0, "start"), (0.0, 120.0, "target"), (0.0, 60.0, "")])
def test_a_start_or_a_target_inside_a_zone_is_told(start, target, told, caplog):
    """The telescope looks 1 deg into a zone of 20 deg."""
    axis = np.array([np.cos(np.deg2rad(101.0)), np.sin(np.deg2rad(101.0)), 0.0])
    with caplog.at_level(logging.WARNING, "koz_jax"):
        maneuver.checked(koz_jax.maneuver(turned(start), turned(target), [(axis, 20.0)]))
    expected = [f"{told}: looks 1 deg into zone 1, of half angle 20 deg"] if told else []
    assert [record.getMessage() for record in caplog.records] == expected


def test_half_angles_that_look_like_radians_are_told(caplog):
    with caplog.at_level(logging.WARNING, "koz_jax"):
        koz_jax.maneuver((1.0, 0.0, 0.0, 0.0), zones=[((0, 1, 0), 20.0), ((0, 0, 1), 0.5236)])
    expected = "zones[1], half angle: 0.5236 deg is small; is it 0.5236 rad = 30.0 deg?"
    assert [record.getMessage() for record in caplog.records] == [expected]


def test_zones_for_another_instrument_only_are_told(caplog):
    own = (0.0, 0.0, 1.0)
    other = koz_jax.maneuver(**GOOD)
    right = koz_jax.maneuver(**GOOD, boresight=own)
    without = other.replace(constraints=other.constraints.replace(half_angle=jnp.array([ABSENT_HALF_ANGLE])))
    with caplog.at_level(logging.WARNING, "koz_jax"):
        for drawn in (right, without):
            maneuver.tell_of_another_boresight(drawn, own)
        assert not caplog.records
        maneuver.tell_of_another_boresight(other, own)
    assert "boresight: no zone is for that of the spacecraft, [0.0, 0.0, 1.0]" in caplog.text
