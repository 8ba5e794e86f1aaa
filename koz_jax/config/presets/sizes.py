"""Sizes of a training on a GPU, which takes as long for a small batch as for one many times larger.

An update of 512 transitions counts for more than one of 128, and an iteration of refinement over a thousand maneuvers
for several over a hundred.  What a GPU trains was chosen and measured on one.
"""

from collections.abc import Mapping
from typing import Any

from koz_jax.config.base import Settings
from koz_jax.config.presets.named import preset
from koz_jax.config.training import TrainConfig

Sizes = Mapping[str, Any]  # by the names of the flags

_LEARNING: Sizes = {"num_envs": 1024, "sac.batch_size": 512}

_FAST: Sizes = {
    **_LEARNING,
    "curriculum.phase1.updates": 20_000,
    "curriculum.phase1.learning_rate": ((0.0, 7e-4),),
    "curriculum.phase2.updates": 60_000,
    "curriculum.phase2.effort_weight": ((0.0, 0.0), (0.1, 0.2), (0.5, 1.0)),
    "curriculum.phase2.learning_rate": ((0.0, 7e-4), (0.5, 7e-4), (1.0, 3.5e-5)),
    "refine.scenarios": 1024,
    "refine.horizon_seconds": 30.0,
    "refine.iterations": 150,
    "refine.learning_rate": 2e-3,
    # As the preset was refined when this was measured.
    "refine.max_gradient_norm": 0.03,
    "refine.max_maneuver_gradient": 0.0,
    "refine.violator_weight": 1.0,
    "refine.pointing_scales_deg": (0.1, 3.0, 50.0),
    "refine.pointing_weights": (4.0, 6.0, 1.0),
    "refine.effort_weight": 5.0,
    "eval_every": 20_000,
    "log_every": 4_000,
    "refine_eval_every": 50,
    "refine_log_every": 50,
}

_THOROUGH: Sizes = {
    **_FAST,
    "curriculum.phase2.updates": 180_000,
    "refine.iterations": 1000,
    "refine_eval_every": 250,
}

_UNIVERSAL: Sizes = {
    **_LEARNING,
    "refine.scenarios": 2048,
    "refine.iterations": 2700,
    "eval_every": 32_000,
    "eval_cases": 4000,
    "refine_eval_every": 500,
    "refine_log_every": 100,
}

_ON_GPU: Mapping[str, Sizes] = {"fast": _FAST, "thorough": _THOROUGH, "universal": _UNIVERSAL}


def for_gpu(config: TrainConfig) -> tuple[TrainConfig, Sizes]:
    """Give a training the sizes of a GPU, where it has a preset that knows them; what was set by hand stays.

    Returns the settings, and what differs in them.
    """
    sizes = _ON_GPU.get(config.preset, {})
    if not sizes:
        return config, {}
    begun_from = preset(config.preset)
    changed = {name: value for name, value in sizes.items() if _get(config, name) == _get(begun_from, name) != value}
    settings = config.model_dump()
    for name, value in changed.items():
        *folders, last = name.split(".")
        part = settings
        for folder in folders:
            part = part[folder]
        part[last] = value
    return TrainConfig.model_validate(settings), changed


def _get(settings: Settings, name: str) -> Any:
    """A setting by the name of its flag."""
    value: Any = settings
    for part in name.split("."):
        value = getattr(value, part)
    return value
