"""Cases: each is its index, whatever flies beside it."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import tiny

from koz_jax.config import task
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.registry import load_controller
from koz_jax.control.shield.filter import Shield
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.storage import archive
from koz_jax.task import maneuver
from koz_jax.task.scenario import Scenario

AGENT = tiny.untrained_agent()
CASES = tiny.CASES
SEED = 3
CONFIG = MonteCarloConfig(cases=CASES, seed=SEED)


@pytest.fixture(scope="module")
def flown() -> CaseResult:
    """All cases in one call."""
    return cases.fly_cases(AGENT.controller, AGENT.task, CONFIG)


def assert_same_cases(found: CaseResult, expected: CaseResult) -> None:
    """Equal to the rounding of float32, the scenarios and the judgements exactly."""
    for name in ("initial_angle", "settled", "violated"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    jax.tree.map(lambda one, other: np.testing.assert_allclose(one, other, rtol=2e-4, atol=2e-5), found, expected)


def first(results: CaseResult, count: int) -> CaseResult:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[:count], results)


@functools.partial(jax.jit, static_argnums=0)
def together(config: MonteCarloConfig, indices: jax.Array) -> Scenario:
    return jax.vmap(lambda case: cases.draw_case(AGENT.task, config, case))(indices)


@functools.partial(jax.jit, static_argnums=0)
def alone(config: MonteCarloConfig, case: jax.Array) -> Scenario:
    return cases.draw_case(AGENT.task, config, case)


def draws(*indices: int, **options: Any) -> Scenario:
    """Four scenarios."""
    return together(MonteCarloConfig(cases=CASES, **options), jnp.array(indices))


@pytest.mark.slow
def test_a_scenario_is_its_index_and_its_seed():
    indices = (0, 7, 11, 123_456)
    found = draws(*indices, seed=SEED)
    more = MonteCarloConfig(cases=200_000, seed=SEED, substeps=3)
    for row, case in enumerate(indices):
        one = alone(more, jnp.int32(case))
        jax.tree.map(lambda x, y, row=row: np.testing.assert_array_equal(np.asarray(x)[row], y), found, one)
    other_neighbours = draws(11, 11, 5, 0, seed=SEED)
    np.testing.assert_array_equal(other_neighbours.initial.q_BN[0], found.initial.q_BN[2])
    np.testing.assert_array_equal(other_neighbours.initial.q_BN[3], found.initial.q_BN[0])


@pytest.mark.slow
def test_cases_differ_and_seeds_differ():
    found = draws(0, 1, 2, 3, seed=0).initial.q_BN
    others = draws(0, 1, 2, 3, seed=1).initial.q_BN
    far = draws(0, 1, 2, 3, seed=2**32 - 1).initial.q_BN
    assert len(np.unique(np.concatenate([found, others, far])[:, 0])) == 12


@pytest.mark.slow
def test_neither_the_number_of_cases_nor_the_chunk_size_matters(flown, monkeypatch):
    monkeypatch.setattr(cases, "_CHUNK", 4)
    # No other test flies 11 cases here, so this compiles with the new size: 11 = 4 + 4 + 3.
    fewer = cases.fly_cases(AGENT.controller, AGENT.task, MonteCarloConfig(cases=11, seed=SEED))
    assert_same_cases(fewer, first(flown, 11))


@pytest.mark.slow
def test_the_number_of_devices_does_not_matter(flown, tmp_path):
    code = (
        "import sys, numpy as np, jax\n"
        "jax.config.update('jax_num_cpu_devices', 2)\n"
        "sys.path.insert(0, 'tests')\n"
        "from pathlib import Path\n"
        "from support import tiny\n"
        "from koz_jax.evaluation.monte_carlo import monte_carlo\n"
        "from koz_jax.storage import archive\n"
        "assert jax.local_device_count() == 2\n"
        f"results = monte_carlo(tiny.untrained_agent(), {CASES - 1}, {SEED}).results\n"
        f"archive.save_tree(Path({str(tmp_path / 'results')!r}), results, {{}})\n"
    )
    done = tiny.run_python("-c", code)
    assert done.returncode == 0, done.stderr
    # An odd number of cases: the second device flies one that is dropped.
    expected = first(flown, CASES - 1)
    assert_same_cases(archive.load_tree(tmp_path / "results", expected), expected)


def test_one_case_flown_again_ends_like_its_row(flown):
    for case in (0, 9):
        history, result = cases.fly_case(AGENT, case, CONFIG)
        row = jax.tree.map(lambda leaf, case=case: np.asarray(leaf)[case], flown)
        assert_same_cases(result, row)
        steps = AGENT.task.episode_steps
        assert history.torque_B.shape == (steps + 1, 3)
        np.testing.assert_allclose(history.pointing_error[-1], row.control_accuracy, rtol=1e-4)
        np.testing.assert_allclose(np.min(history.zone_margin), row.min_margin, rtol=1e-4, atol=1e-6)
        effort = np.sum(np.asarray(history.torque_B[:-1], np.float64) ** 2) * AGENT.task.step_seconds
        np.testing.assert_allclose(effort, row.control_effort, rtol=1e-4)


def test_the_angle_convention_reaches_the_judgement(flown):
    halved = cases.fly_cases(AGENT.controller, AGENT.task.with_rules("half", None), CONFIG)
    np.testing.assert_allclose(halved.control_accuracy, 0.5 * np.asarray(flown.control_accuracy), rtol=1e-6)
    np.testing.assert_array_equal(halved.initial_angle, flown.initial_angle)  # the full angle, always


def test_substeps_reach_the_flight(monkeypatch):
    def seen(*arguments: Any) -> None:
        raise InterruptedError((arguments[0].episode_steps, arguments[3]))

    for name in ("run_case", "fly_and_judge"):
        monkeypatch.setattr(cases.rollout, name, seen)
    with pytest.raises(InterruptedError, match=r"\(20, 3\)"):
        cases.fly_cases(AGENT.controller, AGENT.task, MonteCarloConfig(cases=CASES, seed=SEED, substeps=3))
    with pytest.raises(InterruptedError, match=r"\(20, 4\)"):
        cases.fly_case(AGENT, 0, MonteCarloConfig(cases=CASES, seed=SEED, substeps=4))


def test_other_seeds_ranges_and_weights_do_not_compile_again(flown, monkeypatch):
    monkeypatch.setattr(cases.rollout, "run_case", lambda *_: pytest.fail("was traced again"))
    again = [
        cases.fly_cases(controller, AGENT.task, CONFIG.model_copy(update=changes))
        for controller, changes in (
            (AGENT.controller, {"seed": SEED}),
            (AGENT.controller, {"seed": SEED + 1}),
            (AGENT.controller, {"seed": SEED, "min_angle_deg": 100.0}),
            (tiny.untrained_agent(1).controller, {"seed": SEED}),
        )
    ]
    assert len({float(run.initial_angle[0]) for run in again}) == 3


@pytest.mark.slow
def test_the_range_of_deviations_is_kept(flown):
    degrees = np.rad2deg(flown.initial_angle)
    assert np.all((degrees > 80) & (degrees < 180))
    q_e0 = np.asarray(draws(0, 1, 2, 3, min_angle_deg=100.0, max_angle_deg=101.0).initial.q_BN)[:, 0]
    assert np.all(np.abs(2 * np.rad2deg(np.arccos(np.abs(q_e0))) - 100.5) < 0.51)


@pytest.mark.parametrize("case", [-1, CASES])
def test_a_case_outside_the_draw_is_refused(case):
    with pytest.raises(SettingsError, match=f"case: must be from 0 to cases - 1 = 11, got {case}"):
        cases.fly_case(AGENT, case, CONFIG)


def test_a_range_without_room_for_a_zone_is_refused():
    narrow = MonteCarloConfig(cases=3, min_angle_deg=10.0, max_angle_deg=34.0)
    for refused in (
        lambda: cases.fly_cases(AGENT.controller, AGENT.task, narrow),
        lambda: cases.draw_case(AGENT.task, narrow, 0),
        lambda: cases.fly_case(AGENT, 0, narrow),
    ):
        with pytest.raises(SettingsError, match=r"max_angle_deg: must be above 34 deg.*got 34"):
            refused()
    task.check_feasible(TaskConfig(), 34.1)
    task.check_feasible(TaskConfig().with_rules(None, "shrink"), 10.0)


def test_flights_are_timed_apart_from_their_compilation(flown):
    timed = cases.fly_timed(AGENT.controller, AGENT.task, CONFIG)
    assert timed.compile_s > 0 and timed.wall_s > 0
    assert_same_cases(timed.results, flown)


def test_the_shapes_of_results_are_known_without_flying(flown):
    shapes = cases.result_shapes(AGENT.controller, AGENT.task, CONFIG)
    found = jax.tree.map(lambda leaf: (leaf.shape, np.dtype(leaf.dtype)), flown)
    assert jax.tree.map(lambda leaf: (leaf.shape, np.dtype(leaf.dtype)), shapes) == found


def test_a_scenario_of_ones_own_is_flown_like_the_same_case(flown):
    drawn = cases.draw_case(AGENT.task, CONFIG, 5)
    for task_of_flight in (None, AGENT.task):
        _, result = cases.fly_scenario(AGENT, drawn, task_of_flight)
        assert_same_cases(result, jax.tree.map(lambda leaf: np.asarray(leaf)[5], flown))


def test_the_environment_is_under_the_conditions_that_the_settings_ask_for():
    plain = cases.environment(AGENT.task, CONFIG)
    assert plain.action_filter is None and plain.uncertainty is None
    assert plain.episode_steps == AGENT.task.episode_steps
    errors = UncertaintyConfig(disturbance_torque=0.1)
    hard = CONFIG.model_copy(update={"shield": ShieldConfig(error_bounds=errors), "uncertainty": errors})
    env = cases.environment(AGENT.task, hard)
    assert isinstance(env.action_filter, Shield)
    np.testing.assert_allclose(np.linalg.norm(env.sample_truth(jax.random.key(0)).disturbance_B), 0.1, rtol=1e-5)


def test_a_shield_against_more_than_there_is_torque_for_is_refused():
    strong = ShieldConfig(error_bounds=UncertaintyConfig(disturbance_torque=2.0))
    with pytest.raises(
        SettingsError, match=r"disturbance_torque: must be below 0.5 times the torque limit of 2.0 N m .*, got 2.0"
    ):
        cases.environment(AGENT.task, MonteCarloConfig(shield=strong))
    weak_axis = TaskConfig.model_validate({"spacecraft": {"torque_limit": (3.0, 0.5, 3.0)}})
    with pytest.raises(SettingsError, match=r"below 0.5 times the torque limit of 0.5 N m"):
        cases.environment(weak_axis, MonteCarloConfig(shield=strong))


def test_attitude_is_what_counts_not_its_sign():
    """q and -q, of start and of target, are one maneuver."""
    drawn = cases.draw_case(AGENT.task, CONFIG, 5)
    flown = [
        cases.fly_scenario(
            AGENT, drawn.replace(initial=drawn.initial.replace(q_BN=s * drawn.initial.q_BN), q_DN=t * drawn.q_DN)
        )
        for s in (1.0, -1.0)
        for t in (1.0, -1.0)
    ]
    for history, result in flown[1:]:
        assert_same_cases(result, flown[0][1])
        np.testing.assert_allclose(history.attitude_error, flown[0][0].attitude_error, atol=1e-6)


@pytest.mark.slow
def test_a_direction_that_is_not_of_unit_length_is_never_a_false_safe():
    """The path crosses this zone: 19.9 deg inside, which an axis in km or zero used to hide."""
    crossing = maneuver.maneuver((0.5, 0.0, 0.0, 0.75**0.5), zones=[((0.5, 0.866, 0.0), 20.0)])
    pd = load_controller("pd")
    _, result = cases.fly_scenario(pd, crossing)
    assert bool(result.violated) and not bool(result.success)
    np.testing.assert_allclose(np.rad2deg(result.min_margin), -19.9, atol=0.1)
    for axis in ((500.0, 866.0254, 0.0), (0.25, 0.433, 0.0), (0.0, 0.0, 0.0), (float("nan"), 0.0, 0.0)):
        other = crossing.replace(constraints=crossing.constraints.replace(axis_N=jnp.array([axis])))
        with pytest.raises(SettingsError, match=r"constraints\.axis_N\[0\]: must"):
            cases.fly_scenario(pd, other)


ANY_SPACECRAFT = TaskConfig(episode_seconds=2.0, spread=SpreadConfig(spacecraft=True, step_shares=(0.02, 0.04)))


@pytest.mark.slow
def test_a_case_of_another_spacecraft_is_flown_again_with_that_spacecraft_and_its_shield():
    config = MonteCarloConfig(cases=3, seed=SEED, shield=ShieldConfig())
    agent = load_controller("pd", ANY_SPACECRAFT)
    all_of_them = cases.fly_cases(agent.controller, ANY_SPACECRAFT, config)
    history, again = cases.fly_case(agent, 1, config)
    assert_same_cases(jax.tree.map(lambda leaf: leaf[None], again), jax.tree.map(lambda leaf: leaf[1:2], all_of_them))
    boresights_B = history.state.scenario.constraints.boresight_B
    assert not np.allclose(boresights_B[0, 0], ANY_SPACECRAFT.spacecraft.boresight)


def test_every_case_has_a_spacecraft_of_its_own_the_same_for_every_controller():
    config = MonteCarloConfig(cases=4, seed=SEED)
    drawn = [cases.draw_case(ANY_SPACECRAFT, config, case) for case in range(4)]
    looks = {tuple(np.asarray(one.constraints.boresight_B[0]).tolist()) for one in drawn}
    assert len(looks) == 4
