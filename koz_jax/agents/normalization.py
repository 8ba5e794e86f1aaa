"""Statistics of observations that Stable-Baselines3's VecNormalize keeps beside a model, folded into its first layer.

VecNormalize saves them as a pickle, which is never opened here, because that executes what is in it.  Who trained the
model writes the numbers down, as .npz or as JSON with the same names::

    env = VecNormalize.load("vecnormalize.pkl", venv)
    numpy.savez("statistics.npz", mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon, clip=env.clip_obs)
"""

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from koz_jax.config.task import TaskConfig
from koz_jax.errors import DamagedFileError, SettingsError
from koz_jax.task import host
from koz_jax.task.observation_layout import observation_bounds, size, slices

_log = logging.getLogger(__name__)

_RECIPE = (
    'numpy.savez("statistics.npz", mean=env.obs_rms.mean, var=env.obs_rms.var, epsilon=env.epsilon, clip=env.clip_obs)'
)

# VecNormalize's own.
_DEFAULTS = {"epsilon": 1e-8, "clip": 10.0}


class Normalization(NamedTuple):
    """x -> clip((x - mean) / sqrt(var + epsilon), -clip, clip), entry by entry."""

    mean: host.Floats  # (entries,)
    var: host.Floats  # (entries,)
    epsilon: float
    clip: float

    @property
    def scale(self) -> host.Floats:
        """1 / sqrt(var + epsilon).  Returns (entries,)."""
        return 1.0 / np.sqrt(self.var + self.epsilon)

    def __call__(self, observations: npt.NDArray[Any]) -> host.Floats:
        """Normalise observations (..., entries) as VecNormalize does."""
        return np.clip((observations - self.mean) * self.scale, -self.clip, self.clip)


def read_normalization(source: Path | str | Mapping[str, Any], zones: int) -> Normalization:
    """Read statistics.

    source: a file .npz or .json, or a mapping, with ``mean`` and ``var`` (entries,), and where they are not
    VecNormalize's defaults of 1e-8 and 10, ``epsilon`` and ``clip``.  zones: how many an observation shows.

    Raises:
        SettingsError: it is none of these, or the numbers cannot be those of observations.

    """
    found = dict(source) if isinstance(source, Mapping) else _read(Path(source))
    unknown, missing = found.keys() - Normalization._fields, {"mean", "var"} - found.keys()
    if unknown or missing:
        raise SettingsError(
            f"normalization: must have mean and var, and may have epsilon and clip, got {sorted(found)}; {_RECIPE}"
            " writes them"
        )
    entries = (size(zones),)
    mean, var = (host.numbers(f"normalization, {name}", found[name], entries) for name in ("mean", "var"))
    epsilon, clip = (
        float(host.numbers(f"normalization, {name}", found.get(name, default), ()))
        for name, default in _DEFAULTS.items()
    )
    if np.any(var < 0.0) or not epsilon > 0.0 or not clip > 0.0:
        raise SettingsError(
            "normalization: var must be 0 or more, epsilon and clip above 0, got a smallest var of"
            f" {var.min():.6g}, {epsilon:.6g} and {clip:.6g}"
        )
    return Normalization(mean, var, epsilon, clip)


def _read(path: Path) -> dict[str, Any]:
    if path.suffix not in (".npz", ".json"):
        pickled = " (a pickle is never opened)" if path.suffix in (".pkl", ".pickle") else ""
        raise SettingsError(
            f"normalization: must be a file .npz or .json, got {path}{pickled}; {_RECIPE} writes one, with env ="
            " VecNormalize.load(...)"
        )
    try:
        if path.suffix == ".json":
            return dict(json.loads(path.read_text(encoding="utf-8")))
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except FileNotFoundError:
        raise SettingsError(f"normalization: {path}: no such file") from None
    except Exception as error:  # what NumPy raises for a file that it cannot read is not documented
        raise DamagedFileError(f"{path}: cannot be read as statistics: {error}") from None


def fold(
    kernel: npt.NDArray[Any], bias: npt.NDArray[Any], normalization: Normalization, task: TaskConfig
) -> tuple[host.Floats, host.Floats]:
    """First layer that makes of observations what the given one makes of normalised ones.

    The boresight is the same in every observation of the task, so its part goes into the bias; its variance is zero,
    and its rounding would be blown up.  Clipping cannot be folded in: where observations of the task can come to it,
    a warning says from which values on the policy decides otherwise.

    kernel: (entries, outputs); bias: (outputs,).  Returns the same, float64.
    """
    where = slices(task.zones[1])["boresight_B"]
    kernel, bias = np.asarray(kernel, np.float64), np.asarray(bias, np.float64)
    looks = np.zeros(len(kernel))
    looks[where] = task.spacecraft.boresight
    constant = normalization(looks)[where]
    scale = normalization.scale.copy()
    scale[where] = 0.0
    _tell_of_clipping(normalization, task)
    return kernel * scale[:, None], bias + constant @ kernel[where] - (normalization.mean * scale) @ kernel


def _tell_of_clipping(normalization: Normalization, task: TaskConfig) -> None:
    reach = normalization.clip / normalization.scale
    lowest, highest = normalization.mean - reach, normalization.mean + reach
    low, high = observation_bounds(task)
    lost = []
    for name, part in slices(task.zones[1]).items():
        if name != "boresight_B" and np.any((low[part] < lowest[part]) | (high[part] > highest[part])):
            lost.append(f"{name} below {lowest[part].max():.3g} or above {highest[part].min():.3g}")
    if lost:
        _log.warning(
            "normalization: clipping at %g is left out; the policy may decide otherwise than in training for %s",
            normalization.clip,
            ", ".join(lost),
        )
