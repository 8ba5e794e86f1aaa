"""Agents of Stable-Baselines3: they decide here as they do there, and what is no such agent is refused."""

import json
import pickle
import shutil
import zipfile
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from support import tiny

from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.agents.agent import load_agent
from koz_jax.config.task import TaskConfig
from koz_jax.errors import DamagedFileError, SettingsError
from koz_jax.task.observation_layout import SIZE, size


class Spaces(gymnasium.Env):
    """An environment of which only the spaces matter."""

    def __init__(self, observations: int = SIZE, actions: int = 3, bound: float = 1.0) -> None:
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (observations,), np.float32)
        self.action_space = gymnasium.spaces.Box(-bound, bound, (actions,), np.float32)


def sac(env: gymnasium.Env | None = None, **policy: object) -> SAC:
    sde = bool(policy.pop("use_sde", False))
    return SAC("MlpPolicy", env or Spaces(), policy_kwargs=policy, use_sde=sde, buffer_size=1, device="cpu", seed=0)


def saved(model: BaseAlgorithm, folder: Path) -> Path:
    model.save(folder / "model.zip")
    return folder / "model.zip"


def observations(count: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, SIZE)).astype(np.float32)


def rewritten(path: Path, name: str, content: bytes) -> None:
    """Replace a file in a zip."""
    with zipfile.ZipFile(path) as archive:
        files = {entry: archive.read(entry) for entry in archive.namelist()} | {name: content}
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in files.items():
            archive.writestr(entry, data)


@pytest.mark.parametrize("net_arch", [[256, 256], [7], [], [5, 6, 7]])
def test_it_decides_as_stable_baselines_does(net_arch, tmp_path):
    model = sac(net_arch=net_arch, activation_fn=torch.nn.ReLU)
    agent = load_agent(saved(model, tmp_path))
    batch = observations(1000)
    expected, _ = model.predict(batch, deterministic=True)
    assert np.std(expected, axis=0).min() > 0.01
    np.testing.assert_allclose(agent.predict(batch), expected, rtol=0, atol=1e-6)
    np.testing.assert_allclose(agent.to_numpy().predict(batch), expected, rtol=0, atol=1e-6)
    assert agent.controller.network.hidden_sizes == tuple(net_arch)


@pytest.mark.slow
def test_it_flies_and_saves_like_any_agent(tmp_path, capsys):
    agent = load_agent(saved(sac(net_arch=[8]), tmp_path))
    agent.save(tmp_path / "ours")
    np.testing.assert_array_equal(
        load_agent(tmp_path / "ours").predict(observations(9)), agent.predict(observations(9))
    )
    assert tiny.status("eval_mc", "--agent", tmp_path / "model.zip", "--cases", 2) == 0
    assert "model.zip" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("model", "reason"),
    [
        (lambda: sac(Spaces(observations=17)), "its observation must have 16 numbers, got 17"),
        (lambda: sac(Spaces(actions=2)), "its action must have 3 numbers, got 2"),
        (lambda: sac(Spaces(bound=2.0)), r"its actions must be from -1 to 1 .* got low \[-2.0, -2.0, -2.0\]"),
        (lambda: sac(activation_fn=torch.nn.Tanh), "its activation function must be ReLU, got .*Tanh"),
        (lambda: sac(use_sde=True), "is no SAC policy"),
        (lambda: PPO("MlpPolicy", Spaces(), device="cpu"), "is no SAC policy"),
    ],
)
def test_another_policy_is_refused(model, reason, tmp_path):
    path = saved(model(), tmp_path)
    with pytest.raises(SettingsError, match=reason) as caught:
        load_agent(path)
    assert str(path) in str(caught.value)


def test_weights_that_are_not_finite_are_refused(tmp_path):
    model = sac(net_arch=[4])
    next(model.actor.parameters()).data[0] = float("nan")
    with pytest.raises(SettingsError, match="its weights must be finite"):
        load_agent(saved(model, tmp_path))


class _Bomb:
    """Leaves a trace when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self):
        return Path.touch, (self.trace,)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    return saved(sac(net_arch=[4]), tmp_path_factory.mktemp("good"))


def test_nothing_in_a_zip_is_executed(good, tmp_path):
    path = Path(shutil.copy(good, tmp_path / "model.zip"))
    trace = tmp_path / "executed"
    torch.save({"actor.mu.weight": _Bomb(trace)}, tmp_path / "bomb.pth")
    rewritten(path, "policy.pth", (tmp_path / "bomb.pth").read_bytes())
    with pytest.raises(DamagedFileError, match=r"model\.zip: cannot be read as a zip of Stable-Baselines3"):
        load_agent(path)
    rewritten(path, "policy.pth", pickle.dumps(_Bomb(trace)))
    with pytest.raises(DamagedFileError, match="cannot be read"):
        load_agent(path)
    assert not trace.exists()


@pytest.mark.parametrize("content", [b"", b"no zip", b"PK\x03\x04"])
def test_what_is_no_zip_is_refused(content, tmp_path):
    (tmp_path / "model.zip").write_bytes(content)
    with pytest.raises(DamagedFileError, match=r"model\.zip: cannot be read as a zip of Stable-Baselines3"):
        load_agent(tmp_path / "model.zip")
    with pytest.raises(SettingsError, match=r"agent: .*nowhere\.zip: no such file"):
        load_agent(tmp_path / "nowhere.zip")


@pytest.mark.parametrize("data", [b"", b"[]", b"{", json.dumps({"action_space": {"low": "[?]"}}).encode()])
def test_settings_that_cannot_be_read_are_refused(data, good, tmp_path):
    path = Path(shutil.copy(good, tmp_path / "model.zip"))
    rewritten(path, "data", data)
    with pytest.raises(DamagedFileError, match="cannot be read"):
        load_agent(path)


def test_without_torch_it_says_what_to_install(good):
    code = (
        "import sys; sys.modules['torch'] = None\nfrom koz_jax.agents.agent import load_agent\n"
        f"try: load_agent({str(good)!r})\nexcept ImportError as error: print(error)"
    )
    done = tiny.run_python("-c", code)
    assert "torch: cannot be imported; install it with: pip install 'koz_jax[sb3]'" in done.stdout


def test_an_agent_of_another_task_is_flown_in_that_task_or_refused(tmp_path):
    weak = TaskConfig.model_validate({"spacecraft": {"torque_limit": 0.4}, "scenario": {"max_zones": 3}})
    model = SAC("MlpPolicy", ReorientationVecEnv(2, weak), policy_kwargs={"net_arch": [8]}, buffer_size=10)
    path = saved(model, tmp_path)
    with pytest.raises(SettingsError, match="its observation must have 16 numbers, got 26"):
        load_agent(path)
    stronger = weak.model_copy(update={"spacecraft": TaskConfig().spacecraft})
    with pytest.raises(SettingsError, match=r"its observations are not those of the task .* task=TaskConfig"):
        load_agent(path, stronger)
    agent = load_agent(path, weak)
    assert agent.task == weak and agent.controller.network.observed_zones == 3
    batch = np.random.default_rng(0).normal(size=(100, size(3))).astype(np.float32)
    # Stable-Baselines3 gives what it has clipped to its action space.
    np.testing.assert_allclose(agent.predict(batch), model.predict(batch, deterministic=True)[0], rtol=0, atol=1e-6)
    agent.save(tmp_path / "agent")
    assert load_agent(tmp_path / "agent").task == weak
    with pytest.raises(SettingsError, match=r"task: is told for zips of Stable-Baselines3 only"):
        load_agent(tmp_path / "agent", weak)
