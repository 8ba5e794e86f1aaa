"""Agents: what they answer, and that they answer the same after a journey over the disk."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
from support import tiny

from koz_jax.agents import record
from koz_jax.agents.agent import Agent, load_agent
from koz_jax.agents.record import find_agent, shipped_agents
from koz_jax.errors import DamagedFileError, SettingsError, StorageError
from koz_jax.runs.folder import RunFolder
from koz_jax.storage import archive
from koz_jax.task import observation_layout


@pytest.fixture(scope="module")
def agent() -> Agent:
    return tiny.untrained_agent()


@pytest.fixture(scope="module")
def run() -> RunFolder:
    return tiny.finished_run()


@pytest.fixture
def saved(agent, tmp_path):
    """Folder of a saved agent."""
    agent.save(tmp_path / "agent")
    return tmp_path / "agent"


@pytest.fixture
def shipped(agent, tmp_path, monkeypatch):
    """A package with the agents ``alpha`` and ``beta``."""
    for number, name in enumerate(["beta", "alpha"]):
        tiny.untrained_agent(number).save(tmp_path / "shipped" / name)
    (tmp_path / "shipped" / "empty").mkdir()
    monkeypatch.setattr(record, "shipped_folder", lambda: tmp_path / "shipped")


def observations(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, observation_layout.SIZE)).astype(np.float32)


def tamper(folder, change) -> None:
    """Change the record of a saved folder."""
    record = json.loads((folder / "record.json").read_text())
    change(record)
    (folder / "record.json").write_text(json.dumps(archive._signed(record)))


def test_predict_takes_one_observation_or_a_batch(agent):
    batch = observations(5)
    actions = agent.predict(batch)
    assert isinstance(actions, np.ndarray)
    assert actions.shape == (5, 3) and actions.dtype == np.float32
    assert np.all(np.abs(actions) <= 1.0) and np.std(actions) > 1e-3
    for one, action in zip(batch, actions, strict=True):
        assert agent.predict(one).shape == (3,)
        np.testing.assert_allclose(agent.predict(one), action, atol=1e-6)
    np.testing.assert_array_equal(agent.predict(batch.astype(np.float64)), actions)
    np.testing.assert_array_equal(agent.predict(batch.tolist()), actions)


@pytest.mark.parametrize("shape", [(), (15,), (17,), (16, 1), (2, 15), (2, 3, 16), (0,)])
def test_predict_refuses_other_shapes(agent, shape):
    with pytest.raises(SettingsError, match=re.escape(f"must have shape (16,) or (batch, 16), got {shape}")):
        agent.predict(np.zeros(shape))


def test_an_agent_comes_back_as_it_was(agent, saved):
    loaded = load_agent(saved)
    np.testing.assert_array_equal(loaded.predict(observations(9)), agent.predict(observations(9)))
    assert (loaded.task, loaded.provenance) == (agent.task, agent.provenance)
    assert loaded.controller.network == agent.controller.network
    assert loaded.name == str(saved)
    assert sorted(path.name for path in saved.iterdir()) == ["arrays.npz", "record.json"]
    assert sum(path.stat().st_size for path in saved.iterdir()) < 20_000


def test_save_takes_text_and_does_not_destroy_other_folders(agent, tmp_path):
    agent.save(str(tmp_path / "agent"))
    assert load_agent(str(tmp_path / "agent")).task == agent.task
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(StorageError, match="holds something else"):
        agent.save(tmp_path)
    assert (tmp_path / "notes.txt").read_text() == "mine"


@pytest.mark.slow
def test_a_run_stands_for_its_latest_phase(run, tmp_path):
    assert find_agent(run.path) == run.agent("phase2")
    assert load_agent(run.path).provenance.phase == 2
    assert load_agent(run.agent("phase1")).provenance.phase == 1
    run_in_phase_1 = tmp_path / "run"
    load_agent(run.agent("phase1")).save(run_in_phase_1 / "agents" / "phase1")
    assert find_agent(run_in_phase_1) == run_in_phase_1 / "agents" / "phase1"


@pytest.mark.slow
def test_a_snapshot_is_no_agent(run):
    # It holds the learner and the buffer, to train on from; --start-from takes it.
    for folder in (run.snapshot("phase1"), run.checkpoints()[0]):
        with pytest.raises(SettingsError, match="neither a shipped agent"):
            load_agent(folder)


@pytest.mark.usefixtures("shipped")
def test_shipped_agents_are_found_by_name(monkeypatch, tmp_path):
    assert shipped_agents() == ("alpha", "beta")
    assert (load_agent("alpha").provenance.seed, load_agent("beta").provenance.seed) == (1, 0)
    assert load_agent("alpha").name == "alpha"
    with pytest.raises(SettingsError, match=r"agent: 'gamma' is neither a shipped agent \(alpha, beta\) nor a folder"):
        load_agent("gamma")


def test_a_package_without_agents_says_so(monkeypatch, tmp_path):
    monkeypatch.setattr(record, "shipped_folder", lambda: tmp_path / "nowhere")
    assert shipped_agents() == ()
    with pytest.raises(SettingsError, match=r"agent: 'phase2' is neither a shipped agent \(there is none\)"):
        load_agent()


@pytest.mark.parametrize("name", ["", "nowhere", ".", "x" * 300, "a/../b"])
def test_what_is_no_agent_is_refused(name, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SettingsError, match=re.escape(f"agent: {name!r} is neither")):
        load_agent(name)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda record: record.pop("task"), "task: Field required"),
        (lambda record: record.pop("provenance"), "provenance: Field required"),
        (lambda record: record["task"].update(colour="red"), "task.colour: Extra inputs"),
        (lambda record: record["task"]["spacecraft"].update(boresight=[1, 1, 0]), "boresight must be a unit vector"),
        (lambda record: record["network"].update(hidden_sizes=[0]), "network.hidden_sizes.0: Input should be greater"),
        (lambda record: record["network"].update(hidden_sizes=[16, 17]), "must be float32(17,), got float32(16,)"),
        (lambda record: record["network"].update(hidden_sizes=[16]), "holds other arrays than expected"),
        (lambda record: record.update(format=7), "format must be 2 (or 1, the older one), got 7"),
    ],
)
def test_a_tampered_agent_is_refused(saved, change, reason):
    tamper(saved, change)
    with pytest.raises(DamagedFileError) as caught:
        load_agent(saved)
    assert str(saved) in str(caught.value) and reason in str(caught.value)


def test_a_damaged_agent_is_refused(saved):
    content = bytearray((saved / "arrays.npz").read_bytes())
    content[300] ^= 4
    (saved / "arrays.npz").write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"arrays\.npz: damaged"):
        load_agent(saved)


@pytest.mark.slow
def test_the_public_names_come_without_jax_until_they_are_used():
    code = (
        "import sys, koz_jax; assert 'jax' not in sys.modules\n"
        "assert all(hasattr(koz_jax, name) for name in koz_jax.__all__)\n"
        "try: koz_jax.nothing\n"
        "except AttributeError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.stdout, done.stderr) == ("module 'koz_jax' has no attribute 'nothing'\n", "")
