"""A training run of seconds, and the command lines run in this process; shared by the tests of the user's side."""

import functools
import importlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.agents.agent import Agent
from koz_jax.agents.record import Provenance
from koz_jax.config.presets.named import preset
from koz_jax.config.training import NetworkConfig, TrainConfig
from koz_jax.control.policy import PolicyController, policy_network
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.trainer import train
from koz_jax.task import observation_layout

ROOT = Path(__file__).resolve().parents[2]

# All maneuver files, by their names: those of the suite, and the examples.
MANEUVER_FILES = {
    path.stem: path
    for folder in (ROOT / "koz_jax" / "evaluation" / "suite", ROOT / "examples")
    for path in sorted(folder.glob("*.toml"))
}

# Two phases of 64 updates, each with an evaluation every second row of the log; then 8 iterations of refinement.
SETTINGS: dict[str, Any] = {
    "task": {"episode_seconds": 2.0},
    "network": {"hidden_sizes": (16, 16), "encoding": {"rate_scales": (0.003, 0.03)}},
    "sac": {"batch_size": 16, "buffer_size": 1024, "n_step": 3},
    "curriculum": {
        "phase1": {"updates": 64},
        "phase2": {"updates": 64},
    },
    "refine": {"iterations": 8, "scenarios": 4, "horizon_seconds": 1.0},
    "num_envs": 8,
    "updates_per_step": 2,
    "prefill_steps": 5,
    "training_episode_seconds": 1.0,
    "eval_every": 32,
    "log_every": 16,
    "refine_log_every": 2,
    "refine_eval_every": 4,
    "eval_cases": 12,
    "eval_min_angle_deg": 0.0,  # or there would be nothing to learn in so short an episode
}
LEARNED = 128  # updates
CASES = 12  # as many as in an evaluation: what is compiled for one serves the other


def merged(settings: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Settings with some changed, section by section."""
    inner = {name: merged(settings[name], value) for name, value in changes.items() if isinstance(value, dict)}
    return settings | changes | inner


CONFIG = TrainConfig.model_validate(merged(preset("paper").model_dump(), SETTINGS))


def changed(changes: dict[str, Any]) -> TrainConfig:
    """``CONFIG`` with some settings changed."""
    return TrainConfig.model_validate(merged(CONFIG.model_dump(), changes))


UNREFINED = changed({"refine": {"iterations": 0}})


def flags(settings: dict[str, Any], prefix: str = "--") -> list[str]:
    """Settings as arguments of ``koz train``."""
    found = []
    for name, value in settings.items():
        flag = prefix + name.replace("_", "-")
        if isinstance(value, dict):
            found += flags(value, f"{flag}.")
        elif isinstance(value, bool):
            found.append(flag if value else f"{prefix}no-{name.replace('_', '-')}")
        else:
            numbers = [value] if not isinstance(value, tuple) else [x for row in value for x in _row(row)]
            found += [flag, *map(str, numbers)]
    return found


def _row(value: Any) -> tuple[Any, ...]:
    return value if isinstance(value, tuple) else (value,)


FLAGS = ["--preset", "paper", *flags(SETTINGS)]

_FOLDER = tempfile.TemporaryDirectory(prefix="koz_jax-tests-")


@functools.cache
def finished_run() -> RunFolder:
    """The undisturbed run of ``CONFIG``, trained once per session.  Read it, do not change it."""
    folder = RunFolder(Path(_FOLDER.name) / "undisturbed")
    assert train(CONFIG, folder.path, progress=False) is not None
    return folder


# Sub-commands by the names of the scripts at the top of the repository.
_COMMANDS = {"eval_mc": "evaluate"}


def script(name: str) -> ModuleType:
    """The module of a command line."""
    return importlib.import_module(f"koz_jax.cli.{_COMMANDS.get(name, name)}")


def status(name: str, *argv: object) -> int:
    """Run a command line in this process, on the devices that it has.  Returns the exit status."""
    from koz_jax.cli.main import main

    try:
        with mock.patch("koz_jax.storage.runtime.configure"):
            return main([_COMMANDS.get(name, name), *map(str, argv)])
    except SystemExit as end:
        assert isinstance(end.code, int)
        return end.code


def run_python(
    *argv: object, cwd: Path = ROOT, variables: Mapping[str, str] = MappingProxyType({})
) -> subprocess.CompletedProcess[str]:
    """Run Python in a subprocess, with further variables of its environment."""
    return subprocess.run(
        [sys.executable, *map(str, argv)],
        env={**environment(), **variables},
        cwd=cwd,
        capture_output=True,
        text=True,
        check=False,
    )


def environment() -> dict[str, str]:
    """Variables of a subprocess."""
    return {**os.environ, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT)}


def devices(count: int) -> dict[str, str]:
    """Variables of a subprocess that sees this many devices."""
    return {"XLA_FLAGS": f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count={count}"}


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as server:
        server.bind(("127.0.0.1", 0))
        return server.getsockname()[1]


def begin_two(*command: object) -> list[subprocess.Popen[str]]:
    """Begin a Python command in two processes of two devices each, which find each other by its last arguments."""
    several = ["--coordinator", f"127.0.0.1:{free_port()}", "--processes", 2, "--process"]
    return [
        subprocess.Popen(
            [sys.executable, *map(str, [*command, *several, number])],
            env={**environment(), **devices(2), "PYTHONFAULTHANDLER": "1"},
            cwd=ROOT,
            stderr=subprocess.PIPE,
            text=True,
        )
        for number in range(2)
    ]


def ended(workers: list[subprocess.Popen[str]], *status: int) -> list[str]:
    """Wait for processes to end, each with its status.  Returns what each printed on stderr."""
    errors = []
    for worker in workers:
        try:
            errors.append(worker.communicate(timeout=200)[1])
        except subprocess.TimeoutExpired:
            for late in workers:
                late.send_signal(signal.SIGABRT)  # says where it waits
            errors.append(worker.communicate()[1])
    assert [worker.returncode for worker in workers] == list(status), "\n".join(errors)
    return errors


def make_test(folder: Path) -> subprocess.CompletedProcess[str]:
    """Compile and run the self-tests of an export to C."""
    return subprocess.run(["make", "-C", folder, "test"], capture_output=True, text=True, check=False)


def contents(folder: Path) -> dict[Path, bytes | None]:
    """Everything in a folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@functools.partial(jax.jit, static_argnums=0)  # once for all modules of tests that begin with an agent
def _initial_policy(network: NetworkConfig, key: jax.Array) -> Any:
    observed = jnp.zeros(observation_layout.size(network.observed_zones, network.scaled))
    return policy_network(network).init(key, observed)


def untrained_agent(seed: int = 0, network: NetworkConfig = CONFIG.network) -> Agent:
    """An agent with random weights, for the task of ``CONFIG``; gains of dials, which begin as zero, are random too."""
    policy = _initial_policy(network, jax.random.key(seed))
    gains = np.random.default_rng(seed)
    policy = jax.tree_util.tree_map_with_path(
        lambda path, leaf: jnp.float32(gains.normal(0.0, 0.5, leaf.shape)) if "Gain" in str(path) else leaf, policy
    )
    provenance = Provenance(command="koz train", seed=seed, phase=2, updates=128, table={"cases": 8, "name": "x"})
    return Agent(PolicyController(policy, network), CONFIG.task, provenance, "untrained")


def unshielded(cases: int) -> dict[str, Any]:
    """What the outcomes of so many cases say of a shield where there was none, and of agility where nothing moved."""
    return {
        "peak_rate": np.zeros(cases, np.float32),
        "torque_variation": np.zeros(cases, np.float32),
        "unrest": np.zeros(cases, np.float32),
        "intervention_rate": np.zeros(cases, np.float32),
        "mean_torque_change": np.zeros(cases, np.float32),
        "deadlocked": np.zeros(cases, bool),
        "unsafe_start": np.zeros(cases, bool),
        "infeasible_steps": np.zeros(cases, np.int32),
    }
