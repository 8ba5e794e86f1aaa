"""Flying without jax: the same actions, from the same files, with the same care."""

import json
import subprocess
import sys

import numpy as np
import pytest
from support import tiny

from koz_jax.agents.agent import load_agent
from koz_jax.agents.numpy_policy import load_policy
from koz_jax.config.training import NO_ENCODING, NetworkConfig
from koz_jax.errors import DamagedFileError, SettingsError
from koz_jax.storage import archive
from koz_jax.task.observation_layout import SIZE


@pytest.fixture
def saved(tmp_path):
    """Folder of a saved agent."""
    tiny.untrained_agent().save(tmp_path / "agent")
    return tmp_path / "agent"


def observations(count: int) -> np.ndarray:
    """Of all sizes, so that every view of the encoding is in and out of its linear range."""
    rng = np.random.default_rng(0)
    return (rng.normal(size=(count, SIZE)) * 10 ** rng.uniform(-4, 0.5, size=(count, 1))).astype(np.float32)


@pytest.mark.parametrize("name", ["phase1", "phase2"])
def test_the_shipped_agents_act_alike(name):
    agent, policy = load_agent(name), load_policy(name)
    batch = observations(10_000)
    np.testing.assert_allclose(policy.predict(batch), agent.predict(batch), rtol=0, atol=1e-5)
    assert policy.record.task == agent.task and policy.record.provenance == agent.provenance
    assert np.std(policy.predict(batch), axis=0).min() > 0.1, "the comparison is of actions that differ"


def test_any_network_of_ours_acts_alike(saved):
    assert load_agent(saved).controller.network != NetworkConfig(encoding=NO_ENCODING)
    batch = observations(1000)
    actions = load_policy(saved).predict(batch)
    assert actions.shape == (1000, 3) and actions.dtype == np.float32
    np.testing.assert_allclose(actions, load_agent(saved).predict(batch), rtol=0, atol=1e-6)
    np.testing.assert_allclose(load_policy(saved).predict(batch[7]), actions[7], rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (np.full(16, np.nan), r"observations: must be finite in float32, got nan at \[0\]"),
        (np.full((2, 16), 1e300), r"observations: must be finite in float32, got 1e\+300 at \[0, 0\]"),
        (np.zeros(16, complex), "observations: must be an array of real numbers, got type complex128"),
        (["a"] * 16, "observations: must be an array of real numbers"),
        ([[0.0] * 16, [0.0]], "observations: must be an array of real numbers"),
    ],
)
def test_what_is_no_observation_is_refused(saved, given, message):
    for policy in (load_policy(saved), load_agent(saved)):
        with pytest.raises(SettingsError, match=message):
            policy.predict(given)


def test_a_damaged_or_foreign_agent_is_refused(saved, tmp_path):
    with pytest.raises(SettingsError, match="agent: 'nowhere' is neither"):
        load_policy("nowhere")
    with pytest.raises(SettingsError, match=r"must have shape \(16,\) or \(batch, 16\), got \(15,\)"):
        load_policy(saved).predict(np.zeros(15))
    record = json.loads((saved / "record.json").read_text())
    arrays = archive.read_arrays(saved)
    other = {**record, "network": {**record["network"], "hidden_sizes": [16]}}
    archive.save_tree(saved, arrays, {name: other[name] for name in ("network", "task", "provenance")})
    with pytest.raises(DamagedFileError, match=r"Dense_1/kernel must be float32\(16, 6\), got float32\(16, 16\)"):
        load_policy(saved)
    for change in ({**arrays, "extra": np.zeros(1)}, {name: arrays[name] for name in list(arrays)[1:]}):
        archive.save_tree(saved, change, {name: record[name] for name in ("network", "task", "provenance")})
        with pytest.raises(DamagedFileError, match=r"arrays, but the network|is missing"):
            load_policy(saved)
    content = bytearray((saved / "arrays.npz").read_bytes())
    content[300] ^= 4
    (saved / "arrays.npz").write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"arrays\.npz: damaged"):
        load_policy(saved)


@pytest.mark.slow
def test_flying_costs_no_jax():
    code = (
        "import sys, numpy; sys.modules.update(dict.fromkeys(('jax', 'flax', 'brax', 'optax')))\n"
        "from koz_jax.agents.numpy_policy import load_policy\n"
        "print(load_policy('phase2').predict(numpy.zeros(16)).shape)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("(3,)\n", "")
