"""A policy for any spacecraft exported for one with several instruments: every zone names the one that it is for."""

import functools
import re
import shutil

import jax
import numpy as np
import pytest
from support import spacecraft, tiny

from koz_jax.agents.agent import load_agent
from koz_jax.agents.numpy_observer import scaled_observer_of
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.control.shield import filter as shield
from koz_jax.errors import SettingsError
from koz_jax.export.files import export, made_for, write_files
from koz_jax.export.golden import Situation, golden, known, rows
from koz_jax.export.library import CLibrary
from koz_jax.export.metadata import describe
from koz_jax.export.shield_golden import shield_situations
from koz_jax.task.any_spacecraft import constants
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE, size, slices
from koz_jax.task.state import torque_limits

# The fixture compiles for long.
pytestmark = pytest.mark.slow

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

ZONES = 4
AGENT = spacecraft.agent(spacecraft.SCALED.model_copy(update={"observed_zones": ZONES}))
POLICY = AGENT.to_numpy()
BODY = spacecraft.spacecraft(np.random.default_rng(7), limited=True)
STEP = round(0.02 * BODY.time_unit, 6)
TASK = TaskConfig(spacecraft=BODY, step_seconds=STEP, episode_seconds=200 * STEP)
FURTHER = ((0.0, 0.0, -1.0), (-0.6, 0.8, 0.0))
LOOKS = np.array([BODY.boresight, *FURTHER])
SHIELD = ShieldConfig(cone_rate_deg=0.001, error_bounds=UncertaintyConfig(inertia_error=0.05, rate_noise_deg=0.001))
COUNT = 500


@pytest.fixture(scope="module")
def exported() -> dict[str, bytes]:
    return export(AGENT, "c", SHIELD, TASK, FURTHER)


@pytest.fixture(scope="module")
def vectors():
    return golden(made_for(AGENT, TASK), COUNT, seed=1, further_boresights=FURTHER)


def told_zones(row: np.ndarray) -> list[tuple[np.ndarray, float, np.ndarray]]:
    """Present zones of a row of numbers, as people give them."""
    _, axes, half_angles, numbers = np.split(row.astype(np.float64), (11, 11 + 3 * ZONES, 11 + 4 * ZONES))
    zones = zip(axes.reshape(-1, 3), np.rad2deg(half_angles), LOOKS[numbers.astype(int)], strict=True)
    return [zone for zone in zones if zone[1] > 0.0]


@needs_compiler
def test_c_flies_it_as_jax_and_numpy_do(library, vectors):
    observed, memories = library.observe(vectors.situation, vectors.memory)
    np.testing.assert_allclose(observed, vectors.observation, rtol=0, atol=2e-5)
    np.testing.assert_allclose(library.decide(vectors.observation), vectors.action, rtol=0, atol=5e-6)
    torque_B, limits = library.torque(vectors.observation, memories), np.array(BODY.torque_limits)
    np.testing.assert_allclose(torque_B / limits, vectors.torque / limits, rtol=0, atol=1e-5)
    assert {*memories[:, 5]} == {0.0, 1.0, 2.0}
    for row, memory, expected in zip(vectors.situation[:100], vectors.memory, observed, strict=False):
        observer = scaled_observer_of(POLICY, BODY, STEP, float(memory[4]))
        q_BN, omega_BN_B, q_DN = np.split(row[:11].astype(np.float64), (4, 7))
        seen = observer.observe(q_BN, omega_BN_B, q_DN, told_zones(row))
        # At a start the error is taken with q_e0 >= 0, in a maneuver as it was before.
        seen[:4] *= np.sign(seen[:4] @ expected[:4])
        np.testing.assert_allclose(seen, expected, rtol=0, atol=2e-5)


def test_golden_situations_are_of_mixed_instruments_and_absent_zones(vectors):
    half_angles, numbers = np.split(vectors.situation[:, 11 + 3 * ZONES :], 2, axis=1)
    present = half_angles != np.float32(ABSENT_HALF_ANGLE)
    assert {*np.sum(present, axis=1)} == {1, 2, 3, 4} and vectors.observation.shape == (COUNT, size(ZONES, scaled=True))
    assert np.mean([len({*row}) > 1 for row in numbers]) > 0.8
    # Of an absent zone nothing is seen, of another one of the nearest zone's own instrument (1, 0, 0).
    looks = np.stack([vectors.observation[:, slices(ZONES, True)[f"{n}_boresight_P"]] for n in range(2, ZONES + 1)], 1)
    lengths = np.linalg.norm(looks, axis=2)
    np.testing.assert_allclose(lengths, np.arange(2, ZONES + 1) <= np.sum(present, axis=1)[:, None], atol=1e-6)
    assert 0.1 < np.mean(looks[lengths > 0.5, 0] > 1.0 - 1e-6) < 0.6


@needs_compiler
@pytest.mark.slow
def test_the_shield_decides_as_the_core_does(library):
    agent, limits = made_for(AGENT, TASK), BODY.torque_limits
    model, looks_B = known(agent, FURTHER)
    made = shield.from_config(SHIELD, model)
    drawn, kind = shield_situations(agent, SHIELD, 2000, seed=4, further_boresights=FURTHER)
    box = np.random.default_rng(0).uniform(np.negative(limits), limits, (2000, 3)).astype(np.float32)

    @jax.jit
    @functools.partial(jax.vmap, in_axes=(0, 0))
    def expect(situation: Situation, torque_B: jax.Array) -> jax.Array:
        at = situation.state(model, looks_B)
        return made.filter(at.body, torque_B, at.scenario.constraints, torque_limits(at, model), model)

    expected = np.asarray(expect(drawn, box))
    found, largest = library.shield(rows(drawn), box), np.array(limits)
    passed = np.all(expected == box, axis=1)
    # The same candidate, but for situations within rounding of a threshold.
    same = np.all(np.abs(found - expected) < 1e-3 * largest, axis=1)
    for each in np.unique(kind):
        there = kind == each
        assert np.sum(~passed & there) > 20
        assert np.mean(same[there]) > 0.985 and np.mean(same[there & ~passed]) > 0.95
    assert np.sum(passed) > 200
    # With all zones for the first instrument it would decide otherwise.
    other = rows(drawn).copy()
    other[:, -ZONES:] = 0.0
    assert np.mean(np.any(np.abs(library.shield(other, box) - expected) > 1e-3 * largest, axis=1)) > 0.2


@needs_compiler
def test_zones_that_name_no_instrument_are_for_the_first(vectors, library, tmp_path):
    write_files(tmp_path, export(AGENT, "c", task=TASK))
    one = CLibrary(tmp_path)
    rows_of_one = vectors.situation[:, : 11 + 4 * ZONES]
    expected, kept = one.observe(rows_of_one, vectors.memory[:, :5])
    observed, memories = library.observe(np.pad(rows_of_one, ((0, 0), (0, ZONES))), vectors.memory)
    np.testing.assert_array_equal(observed, expected)
    np.testing.assert_array_equal(memories, np.pad(kept, ((0, 0), (0, 1))))
    np.testing.assert_array_equal(library.torque(observed, memories), one.torque(expected))
    assert "instrument" not in (tmp_path / "koz_math.h").read_text().split("*/", 1)[1]


@needs_compiler
def test_an_instrument_that_there_is_not_is_refused_by_name(library, vectors):
    wrong = vectors.situation[:2].copy()
    wrong[0, -1], wrong[1, -ZONES] = len(LOOKS), -1
    message = "zone_instrument: must be at least 0 and below KOZ_INSTRUMENTS"
    assert library.faults(np.concatenate([wrong, vectors.situation[:1]])) == [message, message, None]
    torque_B = np.ones((2, 3))
    np.testing.assert_array_equal(library.shield(wrong, torque_B), np.zeros((2, 3)))
    # Nothing is read beyond the constants: it is taken for the first one.
    observed, memories = library.observe(wrong, vectors.memory[:2])
    first = np.where((wrong < 0) | (wrong >= len(LOOKS)), 0, wrong)
    wrong[:, -ZONES:] = first[:, -ZONES:]
    np.testing.assert_array_equal(observed, library.observe(wrong, vectors.memory[:2])[0])
    memories[:, 5] = 7.0
    at_first = np.where(np.arange(6) == 5, 0.0, memories)
    np.testing.assert_array_equal(library.torque(observed, memories), library.torque(observed, at_first))
    with pytest.raises(SettingsError, match="memories: must be those of the observations"):
        library.torque(observed)
    with pytest.raises(SettingsError, match="memories: must be one for each of 2 observations, got 1"):
        library.torque(observed, memories[:1])


@needs_compiler
@pytest.mark.slow
def test_its_self_tests_and_its_example_run_and_notice_another_instrument(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "c")
    done = tiny.make_test(copied)
    assert done.returncode == 0 and done.stdout.count("passed") == 2, done.stdout + done.stderr
    original = (copied / "koz_math.h").read_text()
    changed = original.replace("{-0.6f, 0.8f, 0.0f}", "{-0.8f, 0.6f, 0.0f}")
    assert changed != original
    (copied / "koz_math.h").write_text(changed)
    done = tiny.make_test(copied)
    assert done.returncode != 0 and "FAILED" in done.stdout


def test_metadata_tell_of_every_instrument(exported):
    metadata = describe(POLICY, made_for(AGENT, TASK).task, further_boresights=FURTHER)
    assert metadata.boresights_B == (BODY.boresight, *FURTHER)
    assert type(metadata).model_validate_json(metadata.to_json()) == metadata
    for instrument in metadata.further_instruments:
        own = constants.of(BODY, STEP, instrument.boresight_B)
        np.testing.assert_array_equal(instrument.scaling.axes, own.axes)
        np.testing.assert_array_equal(instrument.scaling.torque_per_action, own.torque_per_action)
    head = " ".join(re.sub(r"\n \*? *", " ", exported["koz_policy.h"].decode()).split())
    assert "Instrument 1: boresight [0, 0, -1] in body axes" in head
    assert "Instrument 2: boresight [-0.6, 0.8, 0] in body axes" in head


def test_others_than_exports_to_c_of_agents_for_any_spacecraft_refuse_several():
    with pytest.raises(SettingsError, match=r"further_boresights: .* to C only so far, got 2 for onnx"):
        export(AGENT, "onnx", None, TASK, FURTHER)
    with pytest.raises(SettingsError, match=r"further_boresights: must be none for phase2, .* got 1"):
        export(load_agent("phase2"), "c", further_boresights=FURTHER[:1])
    with pytest.raises(SettingsError, match=r"further_boresights\[0\]: must have length 1"):
        export(AGENT, "c", None, TASK, [(1.0, 1.0, 0.0)])
