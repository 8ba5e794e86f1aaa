import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from koz_jax.config.curriculum import CurriculumConfig, PhaseConfig
from koz_jax.config.presets.named import PRESETS, preset
from koz_jax.learning import curriculum
from koz_jax.learning.curriculum import Difficulty
from koz_jax.task.reward import PAPER_WEIGHTS

pytestmark = pytest.mark.usefixtures("strict_shapes")

PAPER = preset("paper").curriculum
RAMPED = CurriculumConfig(
    phase1=PhaseConfig(updates=100, max_angle_deg=((0.2, 10.0), (0.6, 90.0), (0.8, 100.0))),
    phase2=PhaseConfig(
        updates=300,
        min_angle_deg=((0.0, 0.0), (1.0, 40.0)),
        max_angle_deg=((0.0, 100.0), (0.5, 180.0)),
        angle_bias=((0.0, 2.0), (1.0, 1.0)),
        zone_weight=((0.0, 0.0), (0.1, 2.0)),
        zone_tightening_deg=((0.0, 0.0), (0.5, 1.0)),
        zone_steepness=((0.0, 1.0), (1.0, 3.0)),
        discount=((0.5, 0.99), (1.0, 0.995)),
        effort_weight=((0.5, 0.0), (1.0, 1.0)),
        learning_rate=((0.5, 5e-4), (1.0, 5e-5)),
    ),
)
POINTS = 400
ANGLES = {"min_angle", "max_angle", "zone_tightening"}


@functools.partial(jax.jit, static_argnums=0)
def _at(config: CurriculumConfig, updates: jax.Array) -> Difficulty:
    return jax.vmap(functools.partial(curriculum.difficulty, config))(updates)


def _along(config: CurriculumConfig, updates: list[int] | np.ndarray) -> dict[str, np.ndarray]:
    """Every field at many training steps, angles in degrees."""
    # One length, so that each curriculum is compiled once.
    found = _at(config, jnp.array(np.pad(updates, (0, POINTS - len(updates)), mode="edge"), jnp.int32))
    values = {f.name: np.asarray(getattr(found, f.name))[: len(updates)] for f in dataclasses.fields(Difficulty)}
    return values | {name: np.rad2deg(values[name]) for name in ANGLES}


def _of_phase(config: CurriculumConfig, phase: int, points: int = 200) -> np.ndarray:
    """Training steps from the first to the last of a phase."""
    first = 0 if phase == 1 else config.phase1.updates
    last = (config.phase1.updates if phase == 1 else config.updates) - 1
    return np.linspace(first, last, points).astype(np.int32)


@pytest.mark.slow
def test_many_steps_at_once_equal_one_by_one():
    steps = np.concatenate([_of_phase(RAMPED, 1, 9), _of_phase(RAMPED, 2, 9), [99, 100, 400, 5000]])
    together = _at(RAMPED, jnp.array(steps))
    one = jax.jit(functools.partial(curriculum.difficulty, RAMPED))
    for i, step in enumerate(steps):
        alone = one(jnp.int32(step))
        jax.tree.map(lambda a, b, i=i: np.testing.assert_allclose(a[i], b, rtol=1e-6, atol=1e-8), together, alone)


def test_it_is_a_pure_function_of_the_step():
    """Neither the order nor the number of earlier questions matters, compiled or not."""
    steps = [250, 3, 399, 100, 3, 250]
    compiled = jax.jit(functools.partial(curriculum.difficulty, RAMPED))
    asked = [compiled(jnp.int32(step)) for step in steps]
    for i, j in ((0, 5), (1, 4)):
        jax.tree.map(np.testing.assert_array_equal, asked[i], asked[j])
    plain = curriculum.difficulty(RAMPED, jnp.int32(250))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-6), plain, asked[0])


def test_one_trace_serves_every_step():
    traces = []

    def counted(step: jax.Array) -> Difficulty:
        traces.append(1)
        return curriculum.difficulty(PAPER, step)

    compiled = jax.jit(counted)
    for step in (0, 1, 2_000_000, 3_999_999):
        compiled(jnp.int32(step))
    assert len(traces) == 1


@pytest.mark.parametrize("phase", [1, 2])
def test_every_field_is_its_ramp_over_the_fraction_of_the_phase(phase):
    config = RAMPED.phase1 if phase == 1 else RAMPED.phase2
    steps = _of_phase(RAMPED, phase, 50)
    fraction = (steps - (0 if phase == 1 else 100)) / config.updates
    found = _along(RAMPED, steps)
    for name in set(found) - {"phase"}:
        ramp = getattr(config, f"{name}_deg" if name in ANGLES else name)
        np.testing.assert_allclose(found[name], np.interp(fraction, *np.array(ramp).T), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("config", [PAPER, RAMPED, preset("fast").curriculum])
def test_phase_two_begins_with_the_update_after_phase_one(config):
    end = config.phase1.updates
    found = _along(config, [0, end - 1, end, config.updates - 1])
    np.testing.assert_array_equal(found["phase"], [1, 1, 2, 2])


@pytest.mark.slow
def test_after_the_end_the_last_difficulty_stays():
    end = RAMPED.updates
    found = _at(RAMPED, jnp.array([end, end + 1, 10 * end]))
    jax.tree.map(lambda leaf: np.testing.assert_array_equal(leaf, leaf[0]), found)
    assert found.max_angle[0] == np.deg2rad(np.float32(180.0))


def test_a_phase_without_updates_is_skipped():
    only_second = RAMPED.model_copy(update={"phase1": RAMPED.phase1.model_copy(update={"updates": 0})})
    found = _along(only_second, [0, 150, 299])
    np.testing.assert_array_equal(found["phase"], 2)
    np.testing.assert_allclose(found["max_angle"][0], 100.0, rtol=1e-6)
    assert all(np.all(np.isfinite(values)) for values in found.values())


def test_paper_phase_one_widens_from_25_to_180_deg_without_the_zone():
    found = _along(PAPER, _of_phase(PAPER, 1))
    assert found["max_angle"][0] == pytest.approx(25.0, rel=1e-6)
    assert found["max_angle"][-1] == pytest.approx(180.0, rel=1e-6)
    assert np.all(np.diff(found["max_angle"]) >= 0)
    np.testing.assert_array_equal(found["min_angle"], 0.0)
    np.testing.assert_array_equal(found["zone_weight"], 0.0)


def test_paper_phase_two_widens_from_80_to_180_deg_with_the_zone():
    found = _along(PAPER, _of_phase(PAPER, 2))
    np.testing.assert_allclose(found["min_angle"], 80.0, rtol=1e-6)
    assert found["max_angle"][0] == pytest.approx(80.0, rel=1e-6)
    assert found["max_angle"][-1] == pytest.approx(180.0, rel=1e-6)
    assert np.all(np.diff(found["max_angle"]) >= 0)
    np.testing.assert_array_equal(found["zone_weight"], 1.0)


def test_paper_training_uses_the_paper_reward_and_learning_rate_throughout():
    found = _along(PAPER, np.concatenate([_of_phase(PAPER, 1), _of_phase(PAPER, 2)]))
    np.testing.assert_array_equal(found["effort_weight"], 0.0)
    np.testing.assert_array_equal(found["zone_tightening"], 0.0)
    np.testing.assert_array_equal(found["zone_steepness"], 1.0)
    np.testing.assert_array_equal(found["angle_bias"], 1.0)
    np.testing.assert_allclose(found["discount"], 0.99, rtol=1e-6)
    np.testing.assert_allclose(found["learning_rate"], 1e-4, rtol=1e-6)


@pytest.mark.parametrize("name", list(PRESETS))
def test_every_preset_keeps_its_range_of_angles_in_order(name):
    config = preset(name).curriculum
    for phase in (1, 2):
        found = _along(config, _of_phase(config, phase))
        assert np.all((found["min_angle"] >= 0) & (found["min_angle"] <= found["max_angle"]))
        assert np.all(found["max_angle"] <= 180.0 + 1e-4)
        assert np.all(np.diff(found["max_angle"]) >= 0)


@pytest.mark.parametrize("step", [0, 50, 100, 130, 399])
def test_reward_weights_are_the_papers_but_for_zone_and_effort(step):
    at = curriculum.difficulty(RAMPED, jnp.int32(step))
    weights = vars(curriculum.reward_weights(at))
    assert weights["zone"] == at.zone_weight
    assert weights["effort"] == at.effort_weight
    elsewhere = set(weights) - {"zone", "effort"}
    assert {name: weights[name] for name in elsewhere} == {name: vars(PAPER_WEIGHTS)[name] for name in elsewhere}


@pytest.mark.parametrize("step", [0, 100, 130, 399])
def test_reward_constants_are_the_given_ones_but_for_the_edge_and_slope_of_the_zone(step, env):
    at = curriculum.difficulty(RAMPED, jnp.int32(step))
    given, found = vars(env.reward), vars(curriculum.reward_params(at, env.reward))
    assert found["zone_tightening"] == at.zone_tightening
    assert float(found["zone_decay"]) == pytest.approx(66.0 * float(at.zone_steepness), rel=1e-6)
    elsewhere = set(given) - {"zone_tightening", "zone_decay"}
    assert {name: found[name] for name in elsewhere} == {name: given[name] for name in elsewhere}


def test_paper_training_sees_the_zone_as_it_is(env):
    at = curriculum.difficulty(PAPER, jnp.int32(PAPER.updates - 1))
    found = curriculum.reward_params(at, env.reward)
    jax.tree.map(np.testing.assert_array_equal, found, env.reward)
