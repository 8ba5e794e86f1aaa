"""Policies of Stable-Baselines3: read the weights of a SAC zip without executing anything in it.

Of a zip, only the weights are read (by torch, which refuses anything else) and the plain text of its settings, never
the pickles in them.  What cannot be seen there is taken for granted: the observation is ours, in our order
(``observation_layout.LAYOUT``).  The task is told by the caller; where bounds of observations in the zip are finite, as
those of our environments are, they must be those of the task.

A zip holds the last observation of its training, whose quaternion and boresight are of unit length unless a wrapper
such as VecNormalize has changed them.  Such a zip needs its statistics, see ``normalization``.
"""

import base64
import json
import logging
import pickletools
import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from koz_jax.agents.normalization import Normalization, fold, read_normalization
from koz_jax.agents.numpy_policy import layer_names
from koz_jax.agents.record import Provenance, Record
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import NO_ENCODING, NetworkConfig
from koz_jax.errors import DamagedFileError, SettingsError, missing_extra
from koz_jax.task.observation_layout import ACTION_SIZE, SLICES, observation_bounds, size

_log = logging.getLogger(__name__)

_LAYER = re.compile(r"actor\.latent_pi\.(\d+)\.weight")


def is_sb3(name: str | Path) -> bool:
    """Whether a name is that of a zip of Stable-Baselines3, and not of an agent of ours."""
    return Path(name).suffix == ".zip"


def read_sb3(
    path: str | Path, task: TaskConfig, normalization: Path | str | Mapping[str, Any] | None = None
) -> tuple[Record, dict[str, np.ndarray]]:
    """Record and arrays as those of an agent's folder.

    task: what it was trained for; normalization: statistics of VecNormalize, see ``read_normalization``.

    Raises:
        SettingsError: it is no SAC policy for the task's observation and for our action, torch is not installed, or
            its observations were normalised and there are no statistics, or the other way round.

    """
    zones = task.zones[1]
    statistics = None if normalization is None else read_normalization(normalization, zones)
    weights, settings = _read(Path(path), task)
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
    _check_sizes(path, kernels, zones)
    _check_normalization(path, settings, statistics, zones)
    if statistics is not None:
        kernels[0], biases[0] = fold(kernels[0], biases[0], statistics, task)
    arrays = {}
    for number, (kernel, bias) in enumerate(zip(kernels, biases, strict=True)):
        kernel_name, bias_name = layer_names(number)
        arrays |= {kernel_name: np.ascontiguousarray(kernel, np.float32), bias_name: np.asarray(bias, np.float32)}
    hidden_sizes = tuple(len(bias) for bias in biases[:-1])
    network = NetworkConfig(hidden_sizes=hidden_sizes, encoding=NO_ENCODING, observed_zones=zones)
    folded = "" if statistics is None else ", with the statistics of its observations"
    provenance = Provenance(command=f"Stable-Baselines3, read from {Path(path).name}{folded}")
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


def _check_normalization(
    path: str | Path, settings: dict[str, Any], statistics: Normalization | None, zones: int
) -> None:
    """Refuse statistics that are missing or too many, as far as the last observation of the training tells."""
    last = _array_in(settings, "_last_obs", size(zones))
    as_ours = None if last is None else _has_unit_vectors(last)
    if statistics is None and as_ours is False:
        raise SettingsError(
            f"{path}: its observations were changed by a wrapper such as VecNormalize, so it would fly wrongly; give"
            " the statistics: load_agent(..., normalization=...) with a file or mapping of mean, var, epsilon and clip"
        )
    if statistics is None and as_ours is None:
        _log.warning(
            "%s: does not tell whether its observations were normalised; if they were (VecNormalize), it flies wrongly"
            " without their statistics: load_agent(..., normalization=...)",
            path,
        )
    if statistics is not None and as_ours:
        raise SettingsError(f"normalization: {path} was trained on observations that are not normalised")
    if statistics is not None and last is not None:
        original = _array_in(settings, "_last_original_obs", size(zones))
        if original is not None and not np.allclose(statistics(original), last, rtol=0.01, atol=0.05):
            _log.warning(
                "normalization: these are not the statistics with which %s was saved: of its last observation they make"
                " something else, by up to %.3g",
                path,
                np.abs(statistics(original) - last).max(),
            )


def _has_unit_vectors(observations: npt.NDArray[np.float32]) -> bool:
    """Whether q_e and the boresight are of unit length.  observations: (n, entries)."""
    parts = [observations[:, SLICES[name]] for name in ("q_e", "boresight_B")]
    return all(np.allclose(np.linalg.norm(part, axis=1), 1.0, atol=1e-3) for part in parts)


def _array_in(settings: dict[str, Any], name: str, entries: int) -> npt.NDArray[np.float32] | None:
    """Rows (n, entries) of an array that is pickled in the settings; None where there is none of that size.

    The pickle is taken apart, and nothing in it is executed.
    """
    try:
        operations = pickletools.genops(base64.b64decode(settings[name][":serialized:"]))
        held = [bytes(argument) for _, argument, _ in operations if isinstance(argument, bytes | bytearray)]
    except (KeyError, TypeError, ValueError):
        return None
    row, envs = 4 * entries, settings.get("n_envs")
    buffers = [content for content in held if content and len(content) == row * (envs or 1)]
    return np.frombuffer(buffers[0], "<f4").reshape(-1, entries) if len(buffers) == 1 else None


def _read(path: Path, task: TaskConfig) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Weights of the actor by name, and the settings, which are looked at first."""
    try:
        import torch
    except ImportError as error:
        raise missing_extra(error, "torch", "sb3") from None
    try:
        with zipfile.ZipFile(path) as archive:
            settings = json.loads(archive.read("data"))
            _check_settings(path, settings, task)
            with archive.open("policy.pth") as file:
                weights = torch.load(file, map_location="cpu", weights_only=True)
            return {name: leaf.numpy() for name, leaf in weights.items() if name.startswith("actor.")}, settings
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
