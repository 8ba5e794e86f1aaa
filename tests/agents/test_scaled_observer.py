"""A policy for any spacecraft in NumPy alone: it sees, decides and asks for the torque that the core does."""

import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle, spacecraft, tiny

import koz_jax
from koz_jax.agents.agent import load_agent
from koz_jax.agents.numpy_observer import Observer, ScaledObserver, observer_of, scaled_observer_of
from koz_jax.agents.numpy_policy import load_policy
from koz_jax.config.task import SpacecraftConfig
from koz_jax.errors import DamagedFileError, SettingsError
from koz_jax.storage import archive
from koz_jax.task import state
from koz_jax.task.any_spacecraft import constants, nondimensional, units
from koz_jax.task.observation_layout import size, slices

AGENT = spacecraft.agent()
POLICY = AGENT.to_numpy()


@jax.jit
def flown(at, model, urgency):
    """What the core sees, decides and applies."""
    seen = nondimensional.observe(at, model, urgency)
    action = AGENT.controller.act(seen)
    command = nondimensional.command(action, at, model)
    torque_B, _ = model.actuators.apply(command, None, at.body.omega_BN_B, model.inertia_B, model.dt)
    return seen, action, torque_B


@pytest.mark.slow
def test_it_flies_any_spacecraft_as_the_core_does():
    actions, clipped = [], 0
    for told in spacecraft.situations(250, seed=0):
        seen, action, torque_B = map(np.asarray, flown(told.state, told.model, told.urgency))
        observer = ScaledObserver(told.spacecraft, told.step_seconds, told.urgency)
        observed = observer.observe(-told.q_BN, told.omega_BN_B, told.q_DN, told.zones)
        assert observed.dtype == np.float32 and observed.shape == (size(1, scaled=True),)
        # Towards an axis that the instrument nearly points at, the direction is a small difference divided by itself.
        closeness = max(1.0, 1.0 / (2.0 * np.sin(0.5 * seen[slices(1, scaled=True)["zone_angle"]][0])))
        np.testing.assert_allclose(observed, seen, rtol=0, atol=2e-6 * closeness)
        np.testing.assert_allclose(POLICY.predict(seen), action, rtol=0, atol=5e-6)
        limits = np.array(told.spacecraft.torque_limits)
        np.testing.assert_allclose(observer.torque(action) / limits, torque_B / limits, rtol=0, atol=5e-6)
        actions.append(action)
        clipped += int(np.any(np.abs(torque_B) > 0.999 * limits))
    assert np.std(actions, axis=0).min() > 0.3 and 25 < clipped < 225


@pytest.mark.slow
@pytest.mark.parametrize(("present", "observed"), [(0, 1), (1, 3), (3, 2)])
def test_it_sees_the_nearest_zones_and_absent_ones_as_the_core_does(present, observed):
    for told in spacecraft.situations(10, seed=3, zones=present):
        expected = nondimensional.observe(told.state, told.model, told.urgency, observed)
        observer = ScaledObserver(told.spacecraft, told.step_seconds, told.urgency, observed)
        seen = observer.observe(told.q_BN, told.omega_BN_B, told.q_DN, told.zones)
        np.testing.assert_allclose(seen, np.asarray(expected), rtol=0, atol=1e-5)


@pytest.mark.slow
def test_of_several_instruments_the_axes_are_those_of_the_nearest_zones():
    rng = np.random.default_rng(4)
    action = jnp.array([0.3, -0.2, 0.1])
    for told in spacecraft.situations(10, seed=5):
        around = [(*zone, spacecraft.direction(rng)) for zone in (*told.zones, (spacecraft.direction(rng), 20.0))]
        rate_deg = np.rad2deg(told.omega_BN_B)
        at = state.begin(koz_jax.maneuver(told.q_BN, told.q_DN, around, rate_deg=rate_deg), told.model)
        observer = ScaledObserver(told.spacecraft, told.step_seconds)
        seen = observer.observe(told.q_BN, told.omega_BN_B, told.q_DN, around)
        expected = nondimensional.observe(at, told.model, 0.5)
        np.testing.assert_allclose(seen, np.asarray(expected), rtol=0, atol=1e-5)
        share = np.clip(np.asarray(nondimensional.command(action, at, told.model)), -1.0, 1.0)
        limits = np.array(told.spacecraft.torque_limits)
        np.testing.assert_allclose(observer.torque(action), limits * share, rtol=1e-5, atol=1e-6 * limits.max())


@pytest.mark.slow
@pytest.mark.parametrize("present", [1, 2, 3, 4])
def test_of_four_zones_of_three_instruments_it_sees_what_the_core_does(present):
    rng = np.random.default_rng(present)
    where, mixed = slices(4, scaled=True), 0
    for told in spacecraft.situations(50, seed=10 + present, zones=present):
        looks = [told.spacecraft.boresight, spacecraft.direction(rng), spacecraft.direction(rng)]
        around = [(*zone, looks[rng.integers(3)]) for zone in told.zones]
        rate_deg = np.rad2deg(told.omega_BN_B)
        at = state.begin(koz_jax.maneuver(told.q_BN, told.q_DN, around, rate_deg=rate_deg), told.model)
        observer = ScaledObserver(told.spacecraft, told.step_seconds, told.urgency, observed_zones=4)
        seen = observer.observe(told.q_BN, told.omega_BN_B, told.q_DN, around)
        expected = np.asarray(nondimensional.observe(at, told.model, told.urgency, zones=4))
        assert seen.shape == (size(4, scaled=True),)
        np.testing.assert_allclose(seen, expected, rtol=0, atol=2e-5)
        # Its own instrument is a unit vector, at an angle to the nearest zone's that no axes change.
        seen_looks = np.array([seen[where[f"{number}_boresight_P"]] for number in (2, 3, 4)])
        np.testing.assert_allclose(np.linalg.norm(seen_looks, axis=1), np.arange(2, 5) <= present, atol=1e-6)
        mixed += int(np.any(np.abs(seen_looks[: present - 1, 0] - 1.0) > 1e-3))
    assert present == 1 or 20 < mixed < 50


def test_axes_of_the_core_are_exact_also_near_the_half_turn():
    """1 + x cancels there in single precision: axes were off by 1e-2."""
    for away in (1e-2, 3e-3, 2e-3):
        look = np.array([-np.cos(away), 0.8 * np.sin(away), -0.6 * np.sin(away)])
        found = np.asarray(units.policy_axes(jnp.asarray(look, jnp.float32)))
        np.testing.assert_allclose(found, constants.policy_axes(look), rtol=0, atol=1e-6 / away * 0.1)
        np.testing.assert_allclose(found @ found.T, np.eye(3), rtol=0, atol=1e-6)


@pytest.mark.parametrize("sign", [lambda q, k: -q, lambda q, k: np.copysign(q, q * q[0])])
def test_the_sign_of_what_is_measured_does_not_matter(sign):
    """A turn of 700 deg about one axis."""
    told = spacecraft.situations(1, seed=6)[0]
    one, other = (ScaledObserver(told.spacecraft, told.step_seconds) for _ in range(2))
    for k, half in enumerate(np.linspace(0.0, np.deg2rad(350.0), 100)):
        q_BN = np.array([np.cos(half), 0.0, 0.0, np.sin(half)])
        expected = one.observe(q_BN, np.zeros(3), (1.0, 0.0, 0.0, 0.0), told.zones)
        seen = other.observe(sign(q_BN, k), np.zeros(3), (-1.0, 0.0, 0.0, 0.0), told.zones)
        np.testing.assert_allclose(seen, expected, rtol=0, atol=1e-6)


def test_an_observer_is_of_a_policy_of_its_kind_and_flies_its_own_spacecraft_by_default(tmp_path):
    spacecraft_of_task, step = AGENT.task.spacecraft, AGENT.task.step_seconds
    args = (oracle.random_attitude(np.random.default_rng(0)), np.zeros(3), (1.0, 0.0, 0.0, 0.0))
    default = scaled_observer_of(POLICY, urgency=0.2).observe(*args)
    np.testing.assert_array_equal(default, ScaledObserver(spacecraft_of_task, step, 0.2).observe(*args))
    with pytest.raises(SettingsError, match="untrained is for any spacecraft; scaled_observer_of"):
        observer_of(POLICY)
    of_one = tiny.untrained_agent().to_numpy()
    assert type(observer_of(of_one)) is Observer
    with pytest.raises(SettingsError, match="untrained was trained for one spacecraft; observer_of"):
        scaled_observer_of(of_one)
    with pytest.raises(SettingsError, match="step_seconds: must be told"):
        scaled_observer_of(POLICY, SpacecraftConfig())


@pytest.mark.parametrize("urgency", [-0.1, 1.1, float("nan")])
def test_what_is_out_of_range_is_refused_by_name(urgency):
    observer = ScaledObserver(SpacecraftConfig(), 0.1)
    with pytest.raises(SettingsError, match=r"urgency: must be in \[0, 1\]"):
        observer.set_urgency(urgency)
    with pytest.raises(SettingsError, match="step_seconds: must be above 0"):
        ScaledObserver(SpacecraftConfig(), 0.0)
    with pytest.raises(SettingsError, match="action: must be finite"):
        observer.torque([0.0, 0.0, np.nan])


def test_an_agent_of_before_stopping_and_turning_were_seen_decides_as_it_did(tmp_path):
    AGENT.save(tmp_path / "agent")
    arrays, record = archive.read_arrays(tmp_path / "agent"), archive.read_record(tmp_path / "agent")
    where, name = slices(1, scaled=True), "params/Mlp_0/Dense_0/kernel"
    first, last = where["stopping"].start, where["turning"].stop
    old = np.delete(arrays[name], np.s_[first:last], axis=0)
    kept = {part: value for part, value in record.items() if "sha256" not in part and part != "format"}
    archive.save_tree(tmp_path / "old", arrays | {name: old}, kept)
    unseen = arrays[name].copy()
    unseen[first:last] = 0.0
    archive.save_tree(tmp_path / "unseen", arrays | {name: unseen}, kept)
    observed = np.random.default_rng(0).normal(size=(20, size(1, scaled=True))).astype(np.float32)
    for load in (load_policy, load_agent):
        expected = load(tmp_path / "unseen").predict(observed)
        np.testing.assert_array_equal(load(tmp_path / "old").predict(observed), expected)


def test_a_missing_or_foreign_gain_is_refused(tmp_path):
    AGENT.save(tmp_path / "agent")
    policy = load_policy(tmp_path / "agent")
    observed = np.random.default_rng(0).normal(size=(100, size(1, scaled=True))).astype(np.float32)
    np.testing.assert_allclose(policy.predict(observed), AGENT.predict(observed), rtol=0, atol=2e-6)
    arrays = archive.read_arrays(tmp_path / "agent")
    name = "params/Mlp_0/Gain_1/kernel"
    record = {part: value for part, value in archive.read_record(tmp_path / "agent").items() if "sha256" not in part}
    record.pop("format")
    for changed, message in (
        ({key: value for key, value in arrays.items() if key != name}, f"the array {name} is missing"),
        (arrays | {name: arrays[name][:5]}, r"Gain_1/kernel must be float32\(10, 16\), got float32\(5, 16\)"),
        (arrays | {"params/Mlp_0/Gain_2/kernel": arrays[name]}, "9 arrays, but the network of the record has 8"),
    ):
        archive.save_tree(tmp_path / "agent", changed, record)
        with pytest.raises(DamagedFileError, match=message):
            load_policy(tmp_path / "agent")


@pytest.mark.slow
def test_it_needs_no_jax(tmp_path):
    AGENT.save(tmp_path / "agent")
    code = (
        "import sys; sys.modules.update(dict.fromkeys(('jax', 'flax', 'brax', 'optax')))\n"
        "from koz_jax.agents.numpy_observer import scaled_observer_of\n"
        "from koz_jax.agents.numpy_policy import load_policy\n"
        f"policy = load_policy({str(tmp_path / 'agent')!r})\n"
        "observer = scaled_observer_of(policy)\n"
        "seen = observer.observe((1, 0, 0, 0), (0, 0, 0), (1, 0, 0, 0))\n"
        "print(observer.torque(policy.predict(seen)).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("(3,)\n", "")
