"""Policies of Stable-Baselines3: read the weights of a SAC zip without executing anything in it.

Of a zip, only the weights are read (by torch, which refuses anything else) and the plain text of its settings, never
the pickles in them.  What cannot be seen there is taken for granted: the observation is ours, in our order
(``observation_layout.LAYOUT``), not normalised by a wrapper such as VecNormalize.  The task is told by the caller;
where bounds of observations in the zip are finite, as those of our environments are, they must be those of the task.
"""

import json
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from koz_jax.agents.numpy_policy import layer_names
from koz_jax.agents.record import Provenance, Record
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import NO_ENCODING, NetworkConfig
from koz_jax.errors import DamagedFileError, SettingsError, missing_extra
from koz_jax.task.observation_layout import ACTION_SIZE, observation_bounds, size

_LAYER = re.compile(r"actor\.latent_pi\.(\d+)\.weight")


def is_sb3(name: str | Path) -> bool:
    """Whether a name is that of a zip of Stable-Baselines3, and not of an agent of ours."""
    return Path(name).suffix == ".zip"


def read_sb3(path: str | Path, task: TaskConfig) -> tuple[Record, dict[str, np.ndarray]]:
    """Record and arrays as those of an agent's folder.  task: what it was trained for.

    Raises:
        SettingsError: it is no SAC policy for the task's observation and for our action, or torch is not installed.

    """
    weights = _read(Path(path), task)
    # Layers are numbered together with the activations between them.
    numbers = sorted(int(found[1]) for name in weights if (found := _LAYER.fullmatch(name)))
    names = [f"actor.latent_pi.{number}" for number in numbers]
    heads = ["actor.mu", "actor.log_std"]
    expected = {f"{name}.{part}" for name in (*names, *heads) for part in ("weight", "bias")}
    if weights.keys() != expected or numbers != list(range(0, 2 * len(numbers), 2)):
        missing, extra = sorted(expected - weights.keys()), sorted(weights.keys() - expected)
        raise SettingsError(
            f"{path}: is no SAC policy of linear layers and ReLU: of its actor, {missing[:2] or 'nothing'} is missing"
            f" and {extra[:2] or 'nothing'} is not known (gSDE, CNNs and other algorithms are not supported)"
        )
    kernels = [weights[f"{name}.weight"].T for name in names]
    biases = [weights[f"{name}.bias"] for name in names]
    kernels.append(np.concatenate([weights[f"{head}.weight"].T for head in heads], axis=1))
    biases.append(np.concatenate([weights[f"{head}.bias"] for head in heads]))
    zones = task.scenario.max_zones
    _check_sizes(path, kernels, zones)
    arrays = {}
    for number, (kernel, bias) in enumerate(zip(kernels, biases, strict=True)):
        kernel_name, bias_name = layer_names(number)
        arrays |= {kernel_name: np.ascontiguousarray(kernel, np.float32), bias_name: np.asarray(bias, np.float32)}
    hidden_sizes = tuple(len(bias) for bias in biases[:-1])
    network = NetworkConfig(hidden_sizes=hidden_sizes, encoding=NO_ENCODING, observed_zones=zones)
    provenance = Provenance(command=f"Stable-Baselines3, read from {Path(path).name}")
    return Record(network=network, task=task, provenance=provenance), arrays


def _check_sizes(path: str | Path, kernels: list[np.ndarray], zones: int) -> None:
    if kernels[0].shape[0] != size(zones):
        of_zones = f" for the {zones} zones of the task" if zones > 1 else ""
        raise SettingsError(
            f"{path}: its observation must have {size(zones)} numbers{of_zones}, got {kernels[0].shape[0]}"
        )
    if kernels[-1].shape[1] != 2 * ACTION_SIZE:
        raise SettingsError(f"{path}: its action must have {ACTION_SIZE} numbers, got {kernels[-1].shape[1] // 2}")
    if not all(np.all(np.isfinite(kernel)) for kernel in kernels):
        raise SettingsError(f"{path}: its weights must be finite")


def _read(path: Path, task: TaskConfig) -> dict[str, np.ndarray]:
    """Weights of the actor by name, after a look at the settings."""
    try:
        import torch
    except ImportError as error:
        raise missing_extra(error, "torch", "sb3") from None
    try:
        with zipfile.ZipFile(path) as archive:
            _check_settings(path, json.loads(archive.read("data")), task)
            with archive.open("policy.pth") as file:
                weights = torch.load(file, map_location="cpu", weights_only=True)
            return {name: leaf.numpy() for name, leaf in weights.items() if name.startswith("actor.")}
    except FileNotFoundError:
        raise SettingsError(f"agent: {path}: no such file") from None
    except SettingsError:
        raise
    except Exception as error:  # what torch raises for a file that it cannot read is not documented
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise DamagedFileError(f"{path}: cannot be read as a zip of Stable-Baselines3: {reason}") from None


def _check_settings(path: Path, settings: dict[str, Any], task: TaskConfig) -> None:
    """Refuse what the weights do not show: another activation, actions that are not -1 to 1, another task."""
    activation = (settings.get("policy_kwargs") or {}).get("activation_fn")
    if activation is not None and not str(activation).endswith(".ReLU'>"):
        raise SettingsError(f"{path}: its activation function must be ReLU, got {activation}")
    for bound, allowed in (("low", -1.0), ("high", 1.0)):
        found = _bound(settings, "action_space", bound)
        if np.any(found != allowed):
            raise SettingsError(
                f"{path}: its actions must be from -1 to 1 (times the torque limit), got {bound} {found.tolist()}"
            )
    _, high = observation_bounds(task)
    found = _bound(settings, "observation_space", "high")
    if found.shape == high.shape and np.all(np.isfinite(found)) and not np.allclose(found, high, rtol=1e-3):
        raise SettingsError(
            f"{path}: its observations are not those of the task (other inertia, torque limit, rates or time), which"
            f" load_agent is told as task=TaskConfig(...): they are bounded by {found.tolist()}, those of the task"
            f" by {high.tolist()}"
        )


def _bound(settings: dict[str, Any], space: str, bound: str) -> np.ndarray:
    """A bound of a space, as its text gives it; empty where it does not."""
    text = str((settings.get(space) or {}).get(bound, ""))
    return np.array([float(number) for number in text.replace("[", " ").replace("]", " ").split()])
