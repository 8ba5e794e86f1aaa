"""A policy exported for a spacecraft on wheels: what it sees, asks for and has each wheel do in C, JAX and NumPy."""

import dataclasses
import re
import shutil
import subprocess

import jax
import numpy as np
import pytest
from support import blank, spacecraft, tiny

import koz_jax
from koz_jax.agents.numpy_observer import ScaledObserver, scaled_observer_of
from koz_jax.config.actuators.wheels import WheelConfig, allocation
from koz_jax.config.maneuvers.maneuver_file import load_spacecraft
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, maneuver
from koz_jax.export import files
from koz_jax.export.c_source.wheels import WHEEL_FILES
from koz_jax.export.files import export, made_for, write_files
from koz_jax.export.golden import golden
from koz_jax.export.library import CLibrary
from koz_jax.export.metadata import describe
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE, slices
from koz_jax.task.state import EnvState, torque_limits

# The fixture compiles for seconds.
pytestmark = pytest.mark.slow

needs_compiler = pytest.mark.skipif(shutil.which("cc") is None, reason="there is no C compiler")

AGENT = spacecraft.agent()
POLICY = AGENT.to_numpy()
COUNT = 300
INERTIA = ((0.05, 0.002, 0.0), (0.002, 0.06, 0.001), (0.0, 0.001, 0.03))
LOOK = (0.0, 0.6, 0.8)
TORQUE, MOMENTUM = (0.002, 0.003, 0.004), (0.03, 0.02, 0.04)


def three() -> tuple[WheelConfig, ...]:
    """Unequal ones on the body axes."""
    return tuple(
        WheelConfig(axis=axis, max_torque=torque, max_momentum=momentum, momentum=0.2 * momentum)
        for axis, torque, momentum in zip(((1, 0, 0), (0, 1, 0), (0, 0, -1)), TORQUE, MOMENTUM, strict=True)
    )


def pyramid() -> tuple[WheelConfig, ...]:
    """Four, at 54.7 deg from z."""
    side = float(1.0 / np.sqrt(3.0))
    return tuple(
        WheelConfig(axis=(x * side, y * side, side), max_torque=0.004, max_momentum=0.015, momentum=bias)
        for x, y, bias in ((1, 1, 0.003), (-1, 1, -0.002), (-1, -1, 0.002), (1, -1, -0.001))
    )


def task_on(wheels: tuple[WheelConfig, ...], **settings: float) -> TaskConfig:
    body = SpacecraftConfig.model_validate({"inertia": INERTIA, "boresight": LOOK, "wheels": wheels, **settings})
    return TaskConfig(spacecraft=body, step_seconds=0.1, episode_seconds=40.0)


# Where one shows what the other would.
one_task = pytest.mark.parametrize("task", ["pyramid"], indirect=True)

TASKS = {"three": task_on(three()), "pyramid": task_on(pyramid(), max_rate_deg=8.0)}


@pytest.fixture(scope="module", params=TASKS)
def task(request) -> TaskConfig:
    return TASKS[request.param]


@pytest.fixture(scope="module")
def exported(task) -> dict[str, bytes]:
    with pytest.MonkeyPatch.context() as patch:
        # Of the same shape as what is drawn below, and compiled once.
        patch.setattr(files, "GOLDEN_VECTORS", COUNT)
        return export(AGENT, "c", task=task)


@pytest.fixture(scope="module")
def vectors(task):
    return golden(made_for(AGENT, task), COUNT, seed=1)


def observed_by(observer: ScaledObserver, row: np.ndarray) -> np.ndarray:
    """What NumPy sees of a row of numbers."""
    q_BN, omega_BN_B, q_DN, axis, half_angle, momentum = np.split(row.astype(np.float64), (4, 7, 11, 14, 15))
    return observer.observe(q_BN, omega_BN_B, q_DN, [(axis, np.rad2deg(half_angle[0]))], momentum)


def limits_of(task: TaskConfig) -> tuple[np.ndarray, np.ndarray]:
    wheels = task.spacecraft.wheels
    return np.array([wheel.max_torque for wheel in wheels]), np.array([wheel.max_momentum for wheel in wheels])


@needs_compiler
def test_c_flies_it_as_jax_and_numpy_do(task, library, vectors):
    limits, max_torque = np.array(task.spacecraft.torque_limits), limits_of(task)[0]
    observed, memories = library.observe(vectors.situation, vectors.memory)
    torque_B = library.torque(vectors.observation, memories)
    each = library.wheel_torques(vectors.situation, vectors.torque)
    np.testing.assert_allclose(observed, vectors.observation, rtol=0, atol=2e-5)
    np.testing.assert_allclose(torque_B / limits, vectors.torque / limits, rtol=0, atol=1e-5)
    np.testing.assert_allclose(each / max_torque, vectors.wheel_torque / max_torque, rtol=0, atol=2e-5)
    for row, memory, seen, asked, shared in zip(vectors.situation, memories, observed, torque_B, each, strict=True):
        observer = scaled_observer_of(POLICY, task.spacecraft, task.step_seconds, float(memory[4]))
        found = observed_by(observer, row)
        # At a start the error is taken with q_e0 >= 0, in a maneuver as it was before.
        found[:4] *= np.sign(found[:4] @ seen[:4])
        np.testing.assert_allclose(found, seen, rtol=0, atol=2e-5)
        applied = observer.torque(POLICY.predict(found))
        np.testing.assert_allclose(applied / limits, asked / limits, rtol=0, atol=1e-4)
        np.testing.assert_allclose(observer.wheel_torques(asked) / max_torque, shared / max_torque, rtol=0, atol=5e-5)


def test_golden_situations_are_all_over_what_wheels_do(task, vectors):
    limits, (max_torque, max_momentum) = np.array(task.spacecraft.torque_limits), limits_of(task)
    fill = np.max(np.abs(vectors.situation[:, 15:]) / max_momentum, axis=1)
    assert 0.2 < np.mean(fill > 0.99) < 0.5 and np.min(fill) < 0.05
    where = slices(1, scaled=True)
    rate_limit, reach = vectors.observation[:, where["rate_limit"]], vectors.observation[:, where["reach"]]
    assert 0.2 < np.mean(rate_limit > np.log(2e-3)) < 0.9 and np.ptp(rate_limit) > 4.0 and np.max(rate_limit) <= 0.0
    share = reach[:, 0] / np.max(reach[:, 0])
    assert np.mean(share > 0.99) > 0.2 and np.mean(share < 0.9) > 0.1 and np.min(share) < 0.1
    assert np.mean(np.max(np.abs(vectors.torque) / limits / share[:, None], axis=1) > 1.0 - 1e-4) > 0.02
    used = np.max(np.abs(vectors.wheel_torque) / max_torque, axis=1)
    assert 0.02 < np.mean(used > 0.999) < 0.98


@needs_compiler
def test_wheels_give_the_torque_and_what_their_momentum_takes_or_less_of_both(task, library, vectors):
    """In the middle of the step; no wheel passes its limits."""
    axes, inertia_B = np.array([wheel.axis for wheel in task.spacecraft.wheels]), np.array(task.spacecraft.inertia)
    max_torque, max_momentum = limits_of(task)
    each = library.wheel_torques(vectors.situation, vectors.torque).astype(np.float64)
    momentum, omega_B = vectors.situation[:, 15:].astype(np.float64), vectors.situation[:, 4:7].astype(np.float64)
    held_B, torque_B, half = momentum @ axes, vectors.torque.astype(np.float64), 0.5 * task.step_seconds
    turn_B = torque_B - np.cross(omega_B, omega_B @ inertia_B)
    omega_middle_B = omega_B + half * turn_B @ np.linalg.inv(inertia_B)
    held_middle_B = held_B - half * (torque_B + np.cross(omega_B, held_B))
    needed_B = torque_B + np.cross(omega_middle_B, held_middle_B)
    given_B = each @ axes
    sizes = np.linalg.norm(needed_B, axis=1)
    share = np.sum(given_B * needed_B, axis=1) / sizes**2
    np.testing.assert_allclose(given_B, share[:, None] * needed_B, rtol=0, atol=1e-5 * np.max(max_torque))
    assert np.all(share < 1.0 + 1e-4) and np.all(share >= 0.0) and np.mean(share > 1.0 - 1e-4) > 0.3
    np.testing.assert_allclose(each, share[:, None] * (needed_B @ allocation(task.spacecraft.wheels).T), atol=1e-7)
    after = momentum - task.step_seconds * each
    assert np.all(np.abs(each) <= max_torque * (1 + 1e-5)) and np.all(np.abs(after) <= max_momentum * (1 + 1e-5))
    at_an_end = (np.abs(each) > 0.999 * max_torque) | (np.abs(after) > 0.999 * max_momentum)
    assert np.all(np.any(at_an_end, axis=1)[share < 0.99])


@needs_compiler
def test_a_torque_beyond_what_is_left_is_clipped(library, vectors):
    memories = library.observe(vectors.situation, vectors.memory)[1]
    left = memories[:, 5:8]
    huge = np.where(vectors.torque >= 0.0, 1.0, -1.0).astype(np.float32)
    expected = library.wheel_torques(vectors.situation, huge * left)
    np.testing.assert_array_equal(library.wheel_torques(vectors.situation, huge * 1e6), expected)
    np.testing.assert_array_equal(library.wheel_torques(vectors.situation, huge * np.inf), expected)


@needs_compiler
def test_what_is_no_momentum_is_refused_by_name_and_moves_no_wheel(library, vectors):
    good, column = vectors.situation[:1], np.arange(vectors.situation.shape[1])
    wrong = np.concatenate([np.where(column == place, value, good) for place in (15, 17) for value in (np.nan, np.inf)])
    assert library.faults(good) == [None]
    assert library.faults(wrong) == ["wheel_momentum: must be finite"] * 4
    none = np.zeros((4, library.wheels))
    np.testing.assert_array_equal(library.wheel_torques(wrong, np.ones((4, 3))), none)
    half_told, nothing = np.array([[np.nan, 1e-4, np.nan]]), np.array([[0.0, 1e-4, 0.0]])
    np.testing.assert_array_equal(library.wheel_torques(good, half_told), library.wheel_torques(good, nothing))
    # What cannot be observed makes no torque.
    observed, memories = library.observe(wrong, library.start(wrong))
    np.testing.assert_array_equal(library.torque(observed, memories), np.zeros((4, 3)))
    with pytest.raises(SettingsError, match="memories: must be those of the observations where there are wheels"):
        library.torque(observed)


@needs_compiler
def test_at_the_start_of_a_maneuver_all_of_the_torque_is_left(task, library):
    momenta = [wheel.momentum for wheel in task.spacecraft.wheels]
    at_rest = np.array([[1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0.3, *momenta]])
    np.testing.assert_allclose(library.start(at_rest)[:, 5:8], [task.spacecraft.torque_limits], rtol=1e-6)
    observed, _ = library.observe(at_rest, library.start(at_rest))
    observer = scaled_observer_of(POLICY, task.spacecraft, task.step_seconds)
    seen = observer.observe(at_rest[0, :4], at_rest[0, 4:7], at_rest[0, 7:11])
    where = slices(1, scaled=True)
    scaling = describe(POLICY, made_for(AGENT, task).task).scaling
    assert scaling is not None
    for name in ("inertia", "reach", "step", "rate_limit"):
        np.testing.assert_allclose(observed[0, where[name]], scaling.seen[name], rtol=0, atol=2e-6)
        np.testing.assert_allclose(seen[where[name]], scaling.seen[name], rtol=0, atol=2e-6)


@needs_compiler
@one_task
def test_its_self_test_passes_and_notices_other_wheels(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "c")
    done = tiny.make_test(copied)
    assert done.returncode == 0 and "passed" in done.stdout, done.stdout + done.stderr
    original = (copied / "koz_wheels.h").read_text()
    for name in ("koz_wheel_allocation", "koz_wheel_max_momentum", "koz_wheel_reserve"):
        changed = re.sub(rf"({name}.* = \{{*)([^,;]*f)", r"\g<1>0.6f * \g<2>", original, count=1)
        assert changed != original
        (copied / "koz_wheels.h").write_text(changed)
        done = tiny.make_test(copied)
        assert done.returncode != 0 and "FAILED" in done.stdout, name


@needs_compiler
@one_task
def test_wheels_of_another_export_are_not_compiled_in_and_not_left_behind(folder, task, tmp_path, monkeypatch):
    monkeypatch.setattr(files, "golden", blank.golden)
    (other,) = (each for each in TASKS.values() if each != task)
    write_files(tmp_path, export(AGENT, "c", task=other))
    shutil.copy(folder / "koz_wheels.h", tmp_path)
    with pytest.raises(SettingsError, match="different exports"):
        CLibrary(tmp_path)
    write_files(tmp_path, export(AGENT, "c"))
    assert not any((tmp_path / name).exists() for name in WHEEL_FILES)
    without = CLibrary(tmp_path)
    assert without.wheels == 0
    with pytest.raises(SettingsError, match="wheel_torques: this controller is of a spacecraft without wheels"):
        without.wheel_torques(np.zeros((1, 15)), np.zeros((1, 3)))


def test_metadata_tell_what_depends_on_the_momentum(task, exported):
    metadata = describe(POLICY, made_for(AGENT, task).task)
    assert type(metadata).model_validate_json(metadata.to_json()) == metadata
    head = " ".join(re.sub(r"\n \*? *", " ", exported["koz_policy.h"].decode()).split())
    assert metadata.wheels in head and f"{task.spacecraft.wheels[1].max_torque:g} N m" in metadata.wheels
    assert "wheels" not in describe(POLICY).to_json().split('"task"')[0]


def test_onnx_asks_for_what_wheels_leave(task, vectors):
    import onnxruntime

    session = onnxruntime.InferenceSession(export(AGENT, "onnx", task=task)["koz_policy.onnx"])
    _, torque_B = map(np.asarray, session.run(None, {"observation": vectors.observation}))
    limits = np.array(task.spacecraft.torque_limits)
    np.testing.assert_allclose(torque_B / limits, vectors.torque / limits, rtol=0, atol=1e-5)


def row_of(at: EnvState, looks_B: np.ndarray) -> np.ndarray:
    """A state with moving zones of several instruments as C is told of it, one zone absent: (1, 35)."""
    zones = at.scenario.constraints
    which = [int(np.argmin(np.linalg.norm(looks_B - look_B, axis=1))) for look_B in np.asarray(zones.boresight_B)]
    axes = np.concatenate([np.asarray(zones.axis_N), [[1.0, 0.0, 0.0]]])
    parts = [at.body.q_BN, at.body.omega_BN_B, at.scenario.q_DN, axes.ravel(), zones.half_angle, [ABSENT_HALF_ANGLE]]
    return np.concatenate([*parts, at.actuators, which, [0]])[None]


@needs_compiler
def test_c_in_the_loop_flies_a_satellite_on_wheels_as_the_core_does(tmp_path, monkeypatch):
    """With moving cones and two instruments; the momentum of the wheels is measured at every step."""
    # The self-test is not run, so nothing need be drawn for it.
    monkeypatch.setattr(files, "golden", blank.golden)
    own, agent = koz_jax.load_maneuver(tiny.ROOT / "examples" / "leo_6u.toml"), koz_jax.load_agent("universal")
    task = own.task.model_copy(update={"episode_seconds": 30.0})
    further = tuple(instrument.boresight for instrument in own.instruments[1:])
    looks_B = np.array([task.spacecraft.boresight, *further])
    write_files(tmp_path, export(agent, "c", task=task, further_boresights=further))
    library, start = CLibrary(tmp_path), maneuver.scenario(own)
    expected, result = cases.fly_scenario(agent, start, task, MonteCarloConfig())

    env = Reorientation.from_config(task, observed_zones=4)
    at, step = env.reset(start), jax.jit(env.step)
    limits = jax.jit(lambda at: torque_limits(at, env.model).box_B)
    memory, margins, worst = library.start(row_of(at, looks_B)), [float(env.margin(at))], 0.0
    for _ in range(task.episode_steps):
        told = row_of(at, looks_B)
        observed, memory = library.observe(told, memory)
        torque_B = library.torque(observed, memory)
        each, before = library.wheel_torques(told, torque_B)[0], np.asarray(at.actuators)
        at = step(at, torque_B[0] / limits(at)).state
        worst = max(worst, float(np.max(np.abs(before - task.step_seconds * each - np.asarray(at.actuators)))))
        margins.append(float(env.margin(at)))
    assert worst < 1e-7 and np.abs(np.asarray(at.actuators)).max() < 0.015
    assert result.success and float(at.angle) < np.deg2rad(0.25) and min(margins) > 0.0
    np.testing.assert_allclose(margins, expected.zone_margin, rtol=0, atol=1e-5)
    np.testing.assert_allclose(at.actuators, expected.state.actuators[-1], rtol=0, atol=1e-6)
    np.testing.assert_allclose(float(at.angle), float(expected.pointing_error[-1]), rtol=0, atol=1e-5)


@needs_compiler
def test_a_policy_of_one_spacecraft_commands_shares_of_what_wheels_leave(tmp_path):
    agent = dataclasses.replace(tiny.untrained_agent(), task=TASKS["three"])
    write_files(tmp_path, export(agent, "c"))
    library, drawn = CLibrary(tmp_path), golden(agent, files.GOLDEN_VECTORS, seed=3)
    observed, memories = library.observe(drawn.situation, drawn.memory)
    np.testing.assert_allclose(observed, drawn.observation, rtol=0, atol=2e-5)
    limits, left = np.array(TASKS["three"].spacecraft.torque_limits), memories[:, 4:7]
    np.testing.assert_allclose(drawn.torque / limits, left * drawn.action / limits, rtol=0, atol=1e-6)
    assert np.mean(left[:, 0] < 0.9 * limits[0]) > 0.1
    np.testing.assert_allclose(library.torque(observed, memories) / limits, drawn.torque / limits, rtol=0, atol=1e-5)
    max_torque = limits_of(TASKS["three"])[0]
    each = library.wheel_torques(drawn.situation, drawn.torque)
    np.testing.assert_allclose(each / max_torque, drawn.wheel_torque / max_torque, rtol=0, atol=2e-5)
    done = tiny.make_test(tmp_path)
    assert done.returncode == 0 and "passed" in done.stdout, done.stdout + done.stderr
    with pytest.raises(SettingsError, match=r"spacecraft.wheels: must be none for .* to onnx"):
        export(agent, "onnx")


@needs_compiler
@one_task
def test_the_example_exchanges_momentum_and_makes_none(folder, tmp_path):
    copied = shutil.copytree(folder, tmp_path / "c")
    done = subprocess.run(["make", "-s", "-C", copied, "example"], capture_output=True, text=True, check=False)
    found = re.findall(r"at most (.*) % full; total angular momentum changed by (.*) N", done.stdout)
    fill, changed = map(float, found[0])
    assert 5.0 < fill < 100.001 and changed < 1e-10


def test_what_cannot_be_is_refused_by_name():
    without = ScaledObserver(SpacecraftConfig(), 0.1)
    told = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    with pytest.raises(SettingsError, match="wheel_momentum: must be None, for the spacecraft has no wheels"):
        without.observe(*told, wheel_momentum=np.zeros(3))
    with pytest.raises(SettingsError, match="wheel_torques: the spacecraft has no wheels"):
        without.wheel_torques(np.zeros(3))
    on_four = ScaledObserver(TASKS["pyramid"].spacecraft, 0.1)
    with pytest.raises(SettingsError, match=r"wheel_momentum: must have shape \(4,\), got \(3,\)"):
        on_four.observe(*told, wheel_momentum=np.zeros(3))
    gyros = load_spacecraft(tiny.ROOT / "examples" / "cmg_smallsat.toml").task
    with pytest.raises(SettingsError, match=r"spacecraft.gyros: are flown by jax only so far"):
        ScaledObserver(gyros.spacecraft, gyros.step_seconds)
    with pytest.raises(SettingsError, match=r"spacecraft.gyros: are not exported yet; allowed are .* and wheels"):
        export(AGENT, "c", task=gyros)
