"""A training run of seconds, and the two command lines as modules; shared by the tests of the user's side."""

import functools
import importlib.util
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp

from koz_jax import observation
from koz_jax.agent import Agent, PolicyController, Provenance, policy_network
from koz_jax.config import TrainConfig
from koz_jax.run_folder import RunFolder
from koz_jax.trainer import train

ROOT = Path(__file__).resolve().parent.parent

# One phase each of 64 updates, with two logged chunks and two evaluations each.
SETTINGS: dict[str, Any] = {
    "task": {"episode_seconds": 2.0},
    "network": {"hidden_sizes": (16, 16)},
    "sac": {"batch_size": 16, "buffer_size": 1024, "n_step": 3},
    "curriculum": {
        "phase1": {"updates": 64, "max_angle_deg": ((0.0, 10.0), (0.75, 180.0))},
        "phase2": {"updates": 64, "zone_weight": ((0.0, 1.0),)},
    },
    "num_envs": 8,
    "updates_per_step": 2,
    "prefill_steps": 5,
    "training_episode_seconds": 1.0,
    "eval_every": 32,
    "log_every": 16,
    "eval_cases": 8,
}
CONFIG = TrainConfig.model_validate(SETTINGS)


def flags(settings: dict[str, Any] = SETTINGS, prefix: str = "--") -> list[str]:
    """The settings as arguments of ``train.py``."""
    found = []
    for name, value in settings.items():
        flag = prefix + name.replace("_", "-")
        if isinstance(value, dict):
            found += flags(value, f"{flag}.")
        else:
            numbers = [value] if not isinstance(value, tuple) else [x for row in value for x in _row(row)]
            found += [flag, *map(str, numbers)]
    return found


def _row(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


_FOLDER = tempfile.TemporaryDirectory(prefix="koz_jax-tests-")


@functools.cache
def finished_run() -> RunFolder:
    """The undisturbed run of ``CONFIG``, trained once per session.  Read it, do not change it."""
    folder = RunFolder(Path(_FOLDER.name) / "undisturbed")
    assert train(CONFIG, folder.path, progress=False) is not None
    return folder


@functools.cache
def script(name: str) -> ModuleType:
    """A command line of the repository as a module."""
    spec = importlib.util.spec_from_file_location(f"script_{name}", ROOT / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def status(name: str, *argv: object) -> int:
    """Run a command line in this process.  Returns its exit status."""
    try:
        return script(name).main([str(arg) for arg in argv])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


def environment(cache: Path) -> dict[str, str]:
    """Environment of a subprocess that keeps its compiled programs to the tests."""
    return {
        **os.environ,
        "JAX_COMPILATION_CACHE_DIR": str(cache),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        "JAX_PLATFORMS": "cpu",
        "COLUMNS": "100",
    }


def run_python(*argv: object, cache: Path, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run Python in a subprocess."""
    command = [sys.executable, *map(str, argv)]
    return subprocess.run(command, env=environment(cache), cwd=cwd, capture_output=True, text=True, check=False)


def untrained_agent(seed: int = 0) -> Agent:
    """An agent with random weights, for the task of ``CONFIG``."""
    network = CONFIG.network
    policy = policy_network(network).init(jax.random.key(seed), jnp.zeros(observation.SIZE))
    provenance = Provenance(command="python train.py", seed=seed, phase=2, updates=128, table={"cases": 8, "name": "x"})
    return Agent(PolicyController(policy, network), CONFIG.task, provenance, "untrained")
