"""Maneuvers of one's own: the scenario that is flown, who flies it, and what is reported."""

import functools
import json
import tomllib
from typing import Any

import jax
import numpy as np
import pytest
from support.tiny import MANEUVER_FILES, merged, untrained_agent

import koz_jax
from koz_jax.agents.flight import load_for
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.registry import load_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, maneuver, rollout
from koz_jax.evaluation.maneuver import FlownManeuver
from koz_jax.task import scenario
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import propagate

EXAMPLES = {name: load_maneuver(path) for name, path in MANEUVER_FILES.items()}
PAPER = EXAMPLES["paper"]


def changed(name: str, **changes: Any) -> ManeuverConfig:
    given = tomllib.loads(MANEUVER_FILES[name].read_text())
    return ManeuverConfig.model_validate(merged({"errors": {}} | given, changes))


# Two seconds of it, with two instruments and three cones.
SHORT = changed(
    "calaon2",
    duration_seconds=2.0,
    published=None,
    instruments=[{"name": "camera", "boresight": (1, 0, 0)}, {"name": "tracker", "boresight": (0, 0, 1)}],
    constraints=[
        {"instrument": "camera", "direction": (-1, 0, 0), "half_angle_deg": 20.0},
        {"instrument": "tracker", "direction": (0, 1, 0), "half_angle_deg": 40.0},
        {"instrument": "camera", "direction": (0.958, 0, 0.287), "half_angle_deg": 20.0},
    ],
)


@functools.cache
def short() -> FlownManeuver:
    return koz_jax.fly(SHORT, "pd")


def test_the_papers_file_is_the_papers_scenario():
    ours, papers = maneuver.scenario(PAPER), scenario.paper_test()
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-6, atol=1e-7), ours, papers)
    assert PAPER.task == koz_jax.TaskConfig()


def test_every_constraint_has_its_own_boresight():
    drawn = maneuver.scenario(SHORT)
    np.testing.assert_array_equal(drawn.constraints.boresight_B, [[1, 0, 0], [0, 0, 1], [1, 0, 0]])
    np.testing.assert_allclose(np.rad2deg(drawn.constraints.half_angle), [20, 40, 20], rtol=1e-6)


@pytest.mark.slow
def test_without_constraints_there_is_one_that_is_absent():
    free = changed("calaon1", constraints=[], duration_seconds=1.0)
    assert not np.any(maneuver.scenario(free).constraints.is_present)
    report = koz_jax.fly(free, "pd").report()
    assert report["margins_deg"] == [] and report["min_margin_deg"] is None and not report["violated"]


@pytest.mark.slow
def test_the_report_has_these_keys_and_is_json():
    report = short().report()
    assert json.loads(json.dumps(report, allow_nan=False)) == report
    assert list(report) == [
        "settled",
        "violated",
        "settling_time_s",
        "control_effort",
        "end_error_deg",
        "min_margin_deg",
        "peak_rate_deg",
        "peak_wheel_momentum_share",
        "intervention_rate",
        "deadlocked",
        "margins_deg",
    ]
    assert report["settled"] is False and report["settling_time_s"] is None
    assert report["peak_wheel_momentum_share"] is None


@pytest.mark.slow
def test_margins_are_of_each_constraint_in_the_order_of_the_file():
    """Against a float64 count over the history's own attitudes: between the steps they can only be smaller."""
    flown = short()
    at_steps = SHORT.margins_deg(np.asarray(flown.history.state.body.q_BN, np.float64)).min(axis=0)
    found = np.array(flown.report()["margins_deg"])
    assert found.shape == (3,) and np.all(found <= at_steps + 1e-3)
    np.testing.assert_allclose(found, at_steps, atol=0.5)  # a step of 0.2 s moves it by no more
    assert flown.report()["min_margin_deg"] == found.min()
    np.testing.assert_allclose(found.min(), np.rad2deg(flown.result.min_margin), atol=1e-3)


@pytest.mark.slow
def test_margins_of_cones_that_turn_and_of_cones_to_be_kept_in_are_those_of_their_time():
    moving = changed(
        "calaon2",
        duration_seconds=2.0,
        published=None,
        constraints=[
            {"instrument": "camera", "direction": (-1, 0, 0), "half_angle_deg": 20.0, "rotation_deg": (0.0, 3.0, 0.0)},
            {"instrument": "camera", "kind": "keep_in", "direction": (1, 0, 0), "half_angle_deg": 170.0},
        ],
        instruments=[{"name": "camera", "boresight": (1, 0, 0)}],
    )
    flown = koz_jax.fly(moving, "pd")
    attitudes = np.asarray(flown.history.state.body.q_BN, np.float64)
    at_steps = [moving.margins_deg(q, moving.step_seconds * i) for i, q in enumerate(attitudes)]
    found = np.array(flown.report()["margins_deg"])
    assert np.all(found <= np.min(at_steps, axis=0) + 1e-3)
    np.testing.assert_allclose(found, np.min(at_steps, axis=0), atol=0.5)


def test_the_largest_rate_is_that_of_the_history():
    rates = np.linalg.norm(np.rad2deg(short().history.state.body.omega_BN_B), axis=1)
    np.testing.assert_allclose(short().report()["peak_rate_deg"], rates.max(), rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("errors", [{}, {"inertia": 0.2, "disturbance_torque": 1e-4}])
def test_between_the_steps_the_body_is_where_the_truth_takes_it(errors):
    """The last instant of a step, flown on by what is left of it, is the next step."""
    flying = changed("calaon1", duration_seconds=2.0, errors=errors)
    config = maneuver.config_of(flying, MonteCarloConfig(seed=3))
    assert config.substeps == 5 and (config.uncertainty is not None) == bool(errors)
    history = maneuver.fly_closely(load_controller("pd"), maneuver.scenario(flying), flying.task, config).history
    bodies = cases.within_steps(history, flying.task, config)
    q_BN = np.asarray(bodies.q_BN)
    assert q_BN.shape == (10 * 5 + 1, 4)
    np.testing.assert_allclose(q_BN[::5], history.state.body.q_BN, atol=1e-6)
    env = cases.environment(flying.task, config)
    key = cases._flight_key(cases._key(config), 0)
    truth = env.sample_truth(rollout._split(key)[1])
    assert (np.abs(np.asarray(truth.inertia_B) - env.model.inertia_B).max() > 1e-4) == bool(errors)
    last = jax.tree.map(lambda leaf: leaf[4::5], bodies)
    reached = jax.vmap(propagate, in_axes=(0, 0, None, None))(last, history.torque_B[:-1], truth, env.model.dt / 5)
    np.testing.assert_allclose(reached.q_BN, history.state.body.q_BN[1:], atol=1e-6)
    np.testing.assert_allclose(reached.omega_BN_B, history.state.body.omega_BN_B[1:], atol=1e-6)


def test_a_rate_at_the_start_is_flown():
    begun = Reorientation.from_config(SHORT.task).reset(
        maneuver.scenario(changed("swift", start={"rate_deg": (0, 90, 0)}))
    )
    np.testing.assert_allclose(begun.body.omega_BN_B, [0.0, 0.5 * np.pi, 0.0], rtol=1e-6)


# --- who flies ---


def test_by_default_an_agent_flies_that_was_made_for_the_spacecraft():
    cubesat = EXAMPLES["cubesat_6u"]
    assert load_for(PAPER).name == "phase2"
    assert load_for(cubesat).name == "universal"
    assert load_for(PAPER, urgency=0.2).name == "universal"  # which listens to it
    with pytest.raises(SettingsError, match=r"urgency: is of agents, and pd has none; got 0\.5"):
        load_for(cubesat, "pd", urgency=0.5)


@pytest.mark.slow
def test_the_agent_for_any_spacecraft_flies_the_examples_with_one_instrument():
    flown = koz_jax.fly(EXAMPLES["cubesat_6u"])
    assert flown.result.success


@pytest.mark.parametrize(
    "change, word",
    [
        ({"step_seconds": 0.2}, "a time step of 0.2 s"),
        ({"spacecraft": {"torque_limit": (2.0, 2.0, 1.0)}}, "torque limits"),
        ({"instruments": [{"name": "telescope", "boresight": (0.0, 0.6, 0.8)}]}, "the boresight"),
    ],
)
def test_what_an_agent_was_not_made_for_is_named(change, word):
    assert maneuver.unfamiliar(load_for(PAPER), PAPER) == []
    found = maneuver.unfamiliar(load_for(PAPER), changed("paper", **change))
    assert len(found) == 1 and word in found[0]


def test_several_instruments_are_more_than_an_agent_was_made_for():
    both = changed(
        "paper",
        instruments=[
            {"name": "telescope", "boresight": (1.0, 0.0, 0.0)},
            {"name": "tracker", "boresight": (0.0, 0.0, 1.0)},
        ],
        constraints=[
            {"instrument": "telescope", "direction": (0.703, 0.263, 0.661), "half_angle_deg": 15.2},
            {"instrument": "tracker", "direction": (0.0, -1.0, 0.0), "half_angle_deg": 15.2},
        ],
    )
    assert maneuver.unfamiliar(load_for(PAPER), both) == ["2 instruments in place of one"]
    assert maneuver.unfamiliar(load_controller("planner"), both) == []
    (camera,) = PAPER.instruments
    other = changed("paper", instruments=[camera.model_dump(), {"name": "tracker", "boresight": (0, 1, 0)}])
    assert maneuver.unfamiliar(load_for(PAPER), other) == []  # it has no constraint


def test_names_and_objects_can_fly():
    assert load_for(SHORT, "pd").task == SHORT.task
    mine = untrained_agent()
    assert load_for(SHORT, mine) is mine
    with pytest.raises(SettingsError, match="agent: 'nobody' is neither"):
        koz_jax.fly(SHORT, "nobody")


def test_errors_of_the_file_are_met():
    with_errors = changed("calaon1", errors={"inertia": 0.1}, duration_seconds=1.0)
    config = maneuver.config_of(with_errors, MonteCarloConfig(substeps=7))
    assert config.uncertainty == UncertaintyConfig(inertia_error=0.1) and config.substeps == 7


# --- what is printed ---


def test_what_was_chosen_and_what_is_published_is_told():
    flying = changed("calaon2", duration_seconds=2.0, published={"settling_seconds": 207.0, "by": "PD + CBF"})
    flown = koz_jax.fly(flying, "pd")
    text = maneuver.describe(flying, flown)
    row = next(line for line in text.splitlines() if line.startswith("settling time"))
    assert row.split()[-2:] == ["-", "207"] and text.endswith("published: PD + CBF")
    assert "flown for" not in text and text.count("camera") == 3
    free = maneuver.describe(SHORT.model_copy(update={"duration_seconds": None}), short())
    assert "pictures show where camera looks and its cones, not tracker" in free and "pictures" not in text
    assert "flown for 120 s: 5 times the fastest half turn, 22.9 s" in free and "published" not in free


@pytest.mark.parametrize("roll", ["as is", "rolled by"])
def test_the_roll_that_was_chosen_is_told(roll):
    half_angle_deg = 5.0 if roll == "as is" else 60.0
    target = {"attitude": None, "instrument": "camera", "direction": (0.0, 0.0, -1.0)}
    aimed = SHORT.model_dump() | {
        "target": target,
        "constraints": [{"instrument": "tracker", "direction": (0.8, 0.6, 0.0), "half_angle_deg": half_angle_deg}],
    }
    told = maneuver.describe(ManeuverConfig.model_validate(aimed), _with_margins(short(), 1))
    assert f"target: the roll that the smallest rotation gives, {roll}" in told


def _with_margins(flown: FlownManeuver, count: int) -> FlownManeuver:
    return FlownManeuver(flown.history, flown.result, flown.margins_deg[:count], flown.peak_rate_deg)


# --- the law ---


@pytest.mark.slow
@pytest.mark.parametrize("name", ["asteria_6u", "leo_6u", "swift", "yang2021"])
def test_the_shield_keeps_examples_of_every_kind(name):
    """Quaternion feedback knows no cone; under the shield none is entered: one cone, cones that turn with wheels and
    three instruments, several, and some to be kept in."""
    # Of each as many steps, so that those with equally many cones are one program.
    flying = changed(name, duration_seconds=1000 * EXAMPLES[name].task.step_seconds)
    report = koz_jax.fly(flying, "pd", shield=ShieldConfig()).report()
    assert not report["violated"] and report["min_margin_deg"] > 0.0
    assert len(report["margins_deg"]) == len(EXAMPLES[name].constraints)
    assert min(report["margins_deg"]) > 0.0
