"""Closing the loop in NumPy: the observer sees what the core sees, whatever the sign of a measured quaternion."""

import subprocess
import sys

import numpy as np
import pytest
from support import oracle

import koz_jax
from koz_jax.agents.numpy_observer import Observer, observer_of
from koz_jax.agents.numpy_policy import load_policy
from koz_jax.errors import SettingsError
from koz_jax.task import observation, state
from koz_jax.task.environment import model_from_config
from koz_jax.task.observation_layout import SLICES, size

RNG = np.random.default_rng(0)
MODEL = model_from_config(koz_jax.TaskConfig())


def zones(count: int) -> list[tuple[np.ndarray, float]]:
    return [(oracle.random_direction(RNG), RNG.uniform(5.0, 60.0)) for _ in range(count)]


@pytest.mark.parametrize(("present", "observed"), [(1, 1), (3, 1), (3, 3), (1, 3), (0, 1), (0, 2), (2, 4)])
def test_it_sees_what_the_core_sees(present, observed):
    for _ in range(10):
        q_BN, q_DN, boresight = oracle.random_attitude(RNG), oracle.random_attitude(RNG), oracle.random_direction(RNG)
        around, rate_deg = zones(present), RNG.normal(size=3)
        at = state.begin(koz_jax.maneuver(q_BN, q_DN, around, boresight=boresight, rate_deg=rate_deg), MODEL)
        expected = np.asarray(observation.observe(at, observed))
        observer = Observer(boresight, observed)
        seen = observer.observe(q_BN, np.deg2rad(rate_deg), -q_DN, around)
        assert seen.dtype == np.float32 and seen.shape == (size(observed),)
        np.testing.assert_allclose(seen, expected, atol=3e-6)


def test_with_several_instruments_it_sees_what_the_core_sees():
    q_BN, q_DN = oracle.random_attitude(RNG), oracle.random_attitude(RNG)
    around = [(*zone, oracle.random_direction(RNG)) for zone in zones(3)]
    at = state.begin(koz_jax.maneuver(q_BN, q_DN, around), MODEL)
    seen = Observer(observed_zones=2).observe(q_BN, np.zeros(3), q_DN, around)
    np.testing.assert_allclose(seen, np.asarray(observation.observe(at, 2)), atol=3e-6)


def test_at_the_axis_of_a_zone_the_direction_is_zero():
    seen = Observer().observe((1, 0, 0, 0), np.zeros(3), (1, 0, 0, 0), [((1, 0, 0), 20)])
    np.testing.assert_array_equal(seen[SLICES["zone_direction_B"]], 0.0)


@pytest.mark.parametrize("sign", [lambda q, k: q, lambda q, k: -q, lambda q, k: np.copysign(q, q * q[0])])
def test_the_sign_of_what_is_measured_does_not_matter(sign):
    """A turn of 700 deg about one axis: q_e passes all signs, and goes on as it began."""
    observer, told = Observer(), []
    for k, half in enumerate(np.linspace(0.0, np.deg2rad(350.0), 200)):
        q_BN = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        told.append(observer.observe(sign(q_BN, k), np.zeros(3), (-1.0, 0.0, 0.0, 0.0), []))
    told = np.array(told)
    np.testing.assert_allclose(told[:, 0], np.cos(np.linspace(0.0, np.deg2rad(350.0), 200)), atol=1e-6)
    np.testing.assert_allclose(told[1:, SLICES["q_e0_previous"]][:, 0], told[:-1, 0])
    assert told[0, SLICES["q_e0_previous"]] == told[0, 0]


def test_a_new_maneuver_begins_with_the_nearer_sign():
    observer = Observer()
    for half in np.linspace(0.0, np.deg2rad(170.0), 50):
        last = observer.observe((np.cos(half), 0.0, 0.0, np.sin(half)), np.zeros(3), (1, 0, 0, 0))
    assert last[0] < -0.9
    observer.reset()
    again = observer.observe((np.cos(half), 0.0, 0.0, np.sin(half)), np.zeros(3), (1, 0, 0, 0))
    assert again[0] > 0.9 and again[SLICES["q_e0_previous"]] == again[0]


def attitude(half_deg: float, axis: tuple[float, float, float]) -> np.ndarray:
    half = np.deg2rad(half_deg)
    return np.array([np.cos(half), *(np.sin(half) * np.array(axis))])


MANEUVERS = [
    (attitude(85, (0, 0, 1)), attitude(145, (0, 0, 1)), [((0.0, 0.0, -1.0), 20.0)], 18.2),
    (attitude(88, (0, 1, 0)), attitude(138, (0, 1, 0)), [((0.0, 1.0, 0.0), 20.0)], 17.6),
]


@pytest.mark.slow
@pytest.mark.parametrize(("start", "target", "around", "settling_time"), MANEUVERS)
def test_a_measured_quaternion_with_q0_above_0_flies_as_any_other(start, target, around, settling_time):
    """The plant is the oracle's, in float64; its q0 changes sign in mid-slew, that of the measurement never does."""
    policy = load_policy("phase2")
    observer = observer_of(policy)
    q_BN, omega_BN_B, phi, flips = start, np.zeros(3), [], 0
    for _ in range(400):
        measured = q_BN if q_BN[0] >= 0.0 else -q_BN
        flips += q_BN[0] < 0.0
        q_e = oracle.product(oracle.conjugate(target), q_BN)
        phi.append(oracle.rotation_angle(q_e if q_e[0] >= 0.0 else -q_e))
        torque = oracle.TORQUE_LIMIT * policy.predict(observer.observe(measured, omega_BN_B, target, around))
        after = oracle.propagate_many(q_BN[None], omega_BN_B[None], torque[None], oracle.DT)
        q_BN, omega_BN_B = after[0][0], after[1][0]
    assert flips > 100
    # The core flies it the same, to a step.
    _, result = koz_jax.fly_scenario(koz_jax.load_agent("phase2"), koz_jax.maneuver(start, -target, around))
    np.testing.assert_allclose(result.settling_time, settling_time, atol=1e-4)
    np.testing.assert_allclose(oracle.settling_time(np.array(phi)), settling_time, atol=0.11)


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        (((0, 0, 0, 0), (0, 0, 0), (1, 0, 0, 0)), "q_BN: must have length 1"),
        (((1, 0, 0, 0), (0, 0, np.nan), (1, 0, 0, 0)), "omega_BN_B: must be finite"),
        (((1, 0, 0, 0), (0, 0, 0), (1, 1, 0, 0)), "q_DN: must have length 1"),
        (((1, 0, 0, 0), (0, 0, 0), (1, 0, 0, 0), [((0, 0, 3), 20)]), r"zones\[0\], axis: must have length 1"),
        (((1, 0, 0, 0), (0, 0, 0), (1, 0, 0, 0), [((0, 0, 1), 200)]), r"zones\[0\], half angle: must be above 0"),
    ],
)
def test_what_cannot_be_measured_is_refused_by_name(given, reason):
    with pytest.raises(SettingsError, match=reason):
        Observer().observe(*given)
    with pytest.raises(SettingsError, match="boresight: must have length 1"):
        Observer((0, 0, 0))


@pytest.mark.slow
def test_the_observer_needs_no_jax():
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('jax', 'flax', 'brax', 'optax')))\n"
        "from koz_jax.agents.numpy_observer import Observer\n"
        "print(Observer().observe((1, 0, 0, 0), (0, 0, 0), (1, 0, 0, 0)).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("(16,)\n", "")
