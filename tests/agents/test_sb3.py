"""Agents of Stable-Baselines3: they decide here as they do there, and what is no such agent is refused."""

import base64
import json
import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize
from support import tiny

from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.agents.agent import Agent, load_agent
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


@pytest.mark.slow
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


@pytest.mark.slow
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


# Observations that VecNormalize has changed

SHORT = TaskConfig(episode_seconds=2.0)


@pytest.fixture(scope="module")
def normalized(tmp_path_factory) -> tuple[Path, SAC, VecNormalize]:
    """A zip that was trained under VecNormalize, for a few steps."""
    env = VecNormalize(ReorientationVecEnv(4, SHORT), clip_obs=5.0)
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16]}, buffer_size=500, device="cpu", seed=0)
    model.learn(200)
    return saved(model, tmp_path_factory.mktemp("normalized")), model, env


def statistics(env: VecNormalize) -> dict[str, Any]:
    moments: Any = env.obs_rms
    return {"mean": moments.mean, "var": moments.var, "epsilon": env.epsilon, "clip": env.clip_obs}


def seen_in_flight(count: int) -> np.ndarray:
    """Observations of maneuvers of the task."""
    env = ReorientationVecEnv(count, SHORT)
    env.seed(1)
    env.reset()
    return np.asarray(env.step(np.full((count, 3), 0.3, np.float32))[0])


def written(found: dict[str, Any], folder: Path, kind: str) -> Any:
    if kind == "mapping":
        return found
    path = folder / f"statistics.{kind}"
    if kind == "npz":
        np.savez(path, **found)
    else:
        path.write_text(json.dumps({name: np.asarray(value).tolist() for name, value in found.items()}))
    return path


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mapping", "npz", "json"])
def test_statistics_are_folded_into_the_first_layer(kind, normalized, tmp_path, caplog):
    path, model, env = normalized
    agent = load_agent(path, SHORT, written(statistics(env), tmp_path, kind))
    batch = seen_in_flight(300)
    inside = np.all(np.abs(env.normalize_obs(batch)) < 5.0, axis=1)
    assert inside.sum() > 100
    expected, _ = model.predict(np.asarray(env.normalize_obs(batch)), deterministic=True)
    np.testing.assert_allclose(agent.predict(batch[inside]), expected[inside], rtol=0, atol=2e-5)
    assert np.abs(load_agent_as_it_is(path).predict(batch) - expected).max() > 0.01
    agent.save(tmp_path / "ours")
    np.testing.assert_allclose(load_agent(tmp_path / "ours").predict(batch), agent.predict(batch), atol=1e-6)
    assert "with the statistics of its observations" in agent.provenance.command
    assert "clipping at 5 is left out" in caplog.text and "omega_BN_B below " in caplog.text
    assert "these are not the statistics" not in caplog.text


def load_agent_as_it_is(path: Path) -> Agent:
    """Without what tells of normalisation."""
    bare = path.with_name("bare.zip")
    shutil.copy(path, bare)
    with zipfile.ZipFile(path) as archive:
        settings = json.loads(archive.read("data"))
    rewritten(bare, "data", json.dumps({**settings, "_last_obs": None}).encode())
    return load_agent(bare, SHORT)


def test_a_zip_that_was_trained_under_normalisation_is_refused_without_its_statistics(normalized):
    with pytest.raises(SettingsError, match=r"changed by a wrapper such as VecNormalize.*normalization=\.\.\."):
        load_agent(normalized[0], SHORT)


def test_a_zip_that_does_not_tell_is_taken_with_a_caution(good, normalized, caplog):
    for load in (lambda: load_agent(good), lambda: load_agent_as_it_is(normalized[0])):
        caplog.clear()
        load()
        assert "does not tell whether its observations were normalised" in caplog.text


@pytest.mark.slow
def test_a_zip_that_was_trained_without_needs_no_statistics_and_takes_none(normalized, tmp_path, caplog):
    model = SAC("MlpPolicy", ReorientationVecEnv(2, SHORT), policy_kwargs={"net_arch": [8]}, buffer_size=50)
    model.learn(8)
    path = saved(model, tmp_path)
    load_agent(path, SHORT)
    assert not caplog.records
    with pytest.raises(SettingsError, match=r"normalization: .* was trained on observations that are not normalised"):
        load_agent(path, SHORT, statistics(normalized[2]))


@pytest.mark.slow
def test_rewards_alone_may_be_normalised(tmp_path, caplog):
    env = VecNormalize(ReorientationVecEnv(2, SHORT), norm_obs=False)
    model = SAC("MlpPolicy", env, policy_kwargs={"net_arch": [8]}, buffer_size=50)
    model.learn(8)
    load_agent(saved(model, tmp_path), SHORT)
    assert not caplog.records


def test_statistics_of_something_else_are_told(normalized, caplog):
    path, _, env = normalized
    load_agent(path, SHORT, {**statistics(env), "mean": statistics(env)["mean"] + 1.0})
    assert "these are not the statistics with which" in caplog.text


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"mean": np.zeros(15)}, r"normalization, mean: must have shape \(16,\), got \(15,\)"),
        ({"var": np.full(16, np.nan)}, "normalization, var: must be finite"),
        ({"var": np.full(16, -1.0)}, "normalization: var must be 0 or more.* got a smallest var of -1"),
        ({"epsilon": 0.0}, "epsilon and clip above 0"),
        ({"clip_obs": 10.0}, "normalization: must have mean and var, and may have epsilon and clip, got"),
    ],
)
def test_statistics_that_are_none_are_refused_by_name(change, reason, normalized):
    with pytest.raises(SettingsError, match=reason):
        load_agent(normalized[0], SHORT, {**statistics(normalized[2]), **change})


def test_files_that_hold_no_statistics_are_refused(normalized, tmp_path):
    path, _, env = normalized
    trace = tmp_path / "executed"
    bomb = tmp_path / "vecnormalize.pkl"
    bomb.write_bytes(pickle.dumps(_Bomb(trace)))
    with pytest.raises(SettingsError, match=r"got .*pkl \(a pickle is never opened\); numpy\.savez"):
        load_agent(path, SHORT, bomb)
    np.savez(tmp_path / "objects.npz", mean=np.array([_Bomb(trace)], dtype=object))
    (tmp_path / "broken.npz").write_bytes(b"PK")
    (tmp_path / "broken.json").write_text("{")
    for name in ("objects.npz", "broken.npz", "broken.json"):
        with pytest.raises(DamagedFileError, match="cannot be read as statistics"):
            load_agent(path, SHORT, tmp_path / name)
    assert not trace.exists()
    with pytest.raises(SettingsError, match="no such file"):
        load_agent(path, SHORT, tmp_path / "nowhere.npz")
    with pytest.raises(SettingsError, match=r"normalization: is told for zips of Stable-Baselines3 only"):
        load_agent("phase2", normalization=statistics(env))


def test_a_pickle_in_the_settings_is_not_executed(normalized, tmp_path):
    path = Path(shutil.copy(normalized[0], tmp_path / "model.zip"))
    with zipfile.ZipFile(path) as archive:
        settings = json.loads(archive.read("data"))
    trace = tmp_path / "executed"
    settings["_last_obs"] = {":serialized:": base64.b64encode(pickle.dumps(_Bomb(trace))).decode()}
    rewritten(path, "data", json.dumps(settings).encode())
    load_agent(path, SHORT)
    assert not trace.exists()
