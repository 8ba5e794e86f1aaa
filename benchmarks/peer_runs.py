"""How each peer is trained: its own defaults, the paper's network and batch sizes, many environments in step."""

import csv
import dataclasses
import functools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch
from flax import linen
from mlp import MlpController
from peer_record import OutOfTimeError, Point, Recorder, rate

from koz_jax import load_agent
from koz_jax.adapters.sb3_env import ReorientationVecEnv
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.presets.named import preset
from koz_jax.config.training import NetworkConfig
from koz_jax.control.base import Controller
from koz_jax.evaluation.cases import fly_cases
from koz_jax.evaluation.summary import Summary, summarise
from koz_jax.learning import train_step
from koz_jax.runs import provenance
from koz_jax.task import observation_layout

ENVS, UPDATES = 64, 8  # environments, and updates per step of all of them, for the off-policy peers
_FOREVER = 10**9  # environment steps


@dataclasses.dataclass(frozen=True)
class Run:
    """What a training gives."""

    points: list[Point]
    updates_per_second: float | None  # at the paper's sizes
    controller: Controller  # the best one
    recipe: str
    version: str


def _plain_mlp(weights: list[Any], biases: list[Any]) -> MlpController:
    zeros = jnp.zeros(observation_layout.SIZE)
    arrays = [tuple(jnp.asarray(leaf) for leaf in leaves) for leaves in (weights, biases)]
    return MlpController(zeros, zeros + 1.0, arrays[0], arrays[1], linen.relu)


def _torch_policy(model: Any) -> MlpController:
    actor = model.policy.actor
    parts = [*actor.latent_pi, actor.mu] if hasattr(actor, "latent_pi") else list(actor.mu)
    layers = [part for part in parts if isinstance(part, torch.nn.Linear)]
    weights = [np.array(layer.weight.detach().numpy().T) for layer in layers]
    return _plain_mlp(weights, [np.array(layer.bias.detach().numpy()) for layer in layers])


def _sbx_policy(model: Any) -> MlpController:
    layers = [model.policy.actor_state.params["params"][f"Dense_{i}"] for i in range(3)]
    return _plain_mlp([layer["kernel"] for layer in layers], [layer["bias"] for layer in layers])


def _learn(recorder: Recorder, model: Any, policy: Callable[[Any], MlpController], recipe: str, version: str) -> Run:
    """Let an algorithm of Stable-Baselines3 or SBX learn until the time is up."""
    from stable_baselines3.common.callbacks import BaseCallback

    class Watch(BaseCallback):
        def _on_step(self) -> bool:
            if recorder.due:
                recorder.record(self.num_timesteps, self.model._n_updates, policy(self.model))  # pyright: ignore
            return True

    try:
        model.learn(_FOREVER, callback=Watch())
    except OutOfTimeError:
        pass
    assert recorder.best is not None
    return Run(recorder.points, rate(recorder.points), recorder.best, recipe, version)


def _off_policy(library: str, algorithm: str, minutes: float) -> Run:
    """SAC, TD3 or DDPG with the defaults of the library."""
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    torch.manual_seed(0)
    modules = {"stable-baselines3": "stable_baselines3", "sbx-rl": "sbx"}
    make = getattr(__import__(modules[library]), algorithm)
    settings: dict[str, Any] = {"policy_kwargs": {"net_arch": [256, 256]}, "batch_size": 256}
    noise = ""
    if algorithm != "SAC":
        from stable_baselines3.common.noise import NormalActionNoise

        settings["action_noise"] = NormalActionNoise(np.zeros(3), np.full(3, 0.1))
        settings["learning_rate"] = 3e-4
        noise = ", learning rate 3e-4, action noise 0.1"
    env = ReorientationVecEnv(ENVS)
    recorder = Recorder(minutes)
    model = make("MlpPolicy", env, seed=0, learning_starts=8192, gradient_steps=UPDATES, **settings)
    policy = _sbx_policy if library == "sbx-rl" else _torch_policy
    recipe = (
        f"library defaults{noise}, learning_starts 8192; {ENVS} environments, {UPDATES} updates per step of all of them"
    )
    return _learn(recorder, model, policy, recipe, f"{library} {metadata.version(library)}")


def _brax(algorithm: str, minutes: float) -> Run:
    """brax's own trainer."""
    import brax_training

    per_report = {"ppo": 163_840 * 3, "sac": 10_000}[algorithm]  # environment steps
    recorder = Recorder(minutes)

    def watch(step: int, updates: int, policy: MlpController) -> None:
        recorder.record(step, updates, policy)

    reports = 2000
    try:
        brax_training.TRAINERS[algorithm](reports * per_report, reports, 0, watch)
    except OutOfTimeError:
        pass
    assert recorder.best is not None
    recipe = {
        "ppo": "normalised observations, 2048 environments, unrolls of 20, 4 epochs of 16 minibatches of 512 unrolls",
        "sac": f"normalised observations, learning rate 3e-4; {ENVS} environments, {UPDATES} updates per step of all",
    }[algorithm]
    version = f"brax {metadata.version('brax')}"
    return Run(recorder.points, rate(recorder.points), recorder.best, recipe, version)


def _ours(minutes: float) -> Run:
    """``train.py`` as a user starts it; the clock runs from the start of the process to its own evaluations."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder, "run")
        command = [sys.executable, "train.py", "--preset", "fast", "--run", str(run), "--cases", "1"]
        start = time.perf_counter()
        points: list[Point] = []
        with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
            while process.poll() is None and time.perf_counter() - start < 60.0 * minutes:
                time.sleep(0.1)
                points += _evaluations(run / "metrics.csv", time.perf_counter() - start)[len(points) :]
                if points and points[-1].seconds >= 60.0 * minutes:
                    break
            if process.poll() is None:
                process.send_signal(signal.SIGTERM)
        for point in points:
            print(f"  {point.seconds:5.0f} s, {point.updates} updates: {point.success_rate:.1%}", flush=True)
        controller = load_agent(run).controller
    fast = preset("fast")
    updates = fast.curriculum.phase1.updates + fast.curriculum.phase2.updates
    recipe = (
        f"--preset fast at commit {provenance.commit()[:7] or 'unknown'}: {updates:,} updates of {fast.sac.batch_size},"
        f" {fast.refine.iterations} iterations of refinement, curriculum, {fast.sac.n_step}-step returns, encoding,"
        f" {'-'.join(map(str, fast.network.hidden_sizes))} networks, {fast.num_envs} environments"
    )
    version = f"koz_jax {metadata.version('koz_jax')}"
    return Run(points, _our_update_rate(), controller, recipe, version)


def _evaluations(log: Path, seconds: float) -> list[Point]:
    """All evaluations in a run's log, as if the newest had been written just now."""
    if not log.exists():
        return []
    with open(log, newline="") as file:
        found = [row for row in csv.DictReader(file) if row.get("eval/success_rate") and row.get("eval/mean_reward")]
    return [
        Point(
            seconds=seconds,
            env_steps=int(float(row["env_steps"] or 0)),
            updates=int(row["updates"]),
            success_rate=float(row["eval/success_rate"]),
            mean_reward=float(row["eval/mean_reward"]),
        )
        for row in found
    ]


def _our_update_rate(steps: int = 100, stretches: int = 10) -> float:
    """Updates per second of our training loop with the paper's networks and batch, in the best stretch."""
    fast = preset("fast")
    sizes = {
        "network": NetworkConfig(hidden_sizes=(256, 256)),
        "sac": fast.sac.model_copy(update={"batch_size": 256}),
    }
    config = fast.model_copy(update=sizes)
    state = train_step.init(config, jax.random.key(0))
    rates = []
    for _ in range(stretches):
        start = time.perf_counter()
        state, _ = jax.block_until_ready(train_step.train_chunk(config, state, jnp.int32(steps)))
        rates.append(steps * config.updates_per_step / (time.perf_counter() - start))
    return max(rates)


RUNS: dict[str, Callable[[float], Run]] = {
    "koz_jax": _ours,
    "SB3 SAC": functools.partial(_off_policy, "stable-baselines3", "SAC"),
    "SB3 TD3": functools.partial(_off_policy, "stable-baselines3", "TD3"),
    "SB3 DDPG": functools.partial(_off_policy, "stable-baselines3", "DDPG"),
    "SBX SAC": functools.partial(_off_policy, "sbx-rl", "SAC"),
    "brax SAC": functools.partial(_brax, "sac"),
    "brax PPO": functools.partial(_brax, "ppo"),
}


def final_table(controller: Controller, cases: int) -> Summary:
    """The Monte Carlo of the paper, seed 0."""
    return summarise(fly_cases(controller, preset("fast").task, MonteCarloConfig(cases=cases)))
