"""A training for another spacecraft than the paper's: its times and rates are those of the preset, in units of T."""

from typing import Any

from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import TrainConfig


def _spread(given: TaskConfig, task: TaskConfig) -> SpreadConfig:
    """What a preset spreads, but for the spacecraft, in units of one."""
    stretch = task.spacecraft.time_unit / given.spacecraft.time_unit
    strength = task.spacecraft.strength / given.spacecraft.strength
    spread, errors = given.spread, given.spread.errors
    changes: dict[str, Any] = {"spacecraft": False, "instruments": 1, "keep_in": 0.0}
    if spread.max_rate_deg is not None:
        slowest, fastest = spread.max_rate_deg
        changes["max_rate_deg"] = (slowest / stretch, fastest / stretch)
    changes["errors"] = errors.model_copy(
        update={
            "disturbance_torque": errors.disturbance_torque * strength,
            "rate_noise_deg": errors.rate_noise_deg / stretch,
            "rate_bias_deg": errors.rate_bias_deg / stretch,
        }
    )
    return spread.model_copy(update=changes)


# How a policy in units and axes of its spacecraft is refined: that of Soft Actor-Critic chatters, so its gradients are
# bounded over the steps and for each maneuver.  By Adam at the presets' learning rate it unlearns the maneuver.
_REFINED = {
    "optimizer": "muon",
    "learning_rate": 2e-3,
    "max_maneuver_gradient": 0.1,
    "max_gradient_norm": 1.0,
    "state_gradient": (30.0, 300.0),
}


def for_spacecraft(config: TrainConfig, task: TaskConfig) -> TrainConfig:
    """Settings that train for one spacecraft; its policy sees it in its own units and axes.

    task: with the spacecraft, its time step, and maneuvers in its units, as ``SpacecraftFile.task`` gives it.
    """
    stretch = task.spacecraft.time_unit / config.task.spacecraft.time_unit

    def stretched(seconds: float) -> float:
        return max(round(stretch * seconds / task.step_seconds), 1) * task.step_seconds

    network, refined = config.network, {}
    if not network.scaled:
        refined = _REFINED
        own = config.task.spacecraft.time_unit
        in_units = tuple(own * scale for scale in network.encoding.rate_scales)
        encoding = network.encoding.model_copy(update={"rate_scales": in_units})
        network = network.model_copy(update={"encoding": encoding, "scaled": True})
    changes = {
        "task": task.model_copy(update={"spread": _spread(config.task, task)}),
        "network": network,
        "training_episode_seconds": stretched(config.training_episode_seconds),
        "refine": config.refine.model_copy(
            update={"horizon_seconds": stretched(config.refine.horizon_seconds), **refined}
        ),
    }
    return TrainConfig.model_validate(config.model_copy(update=changes).model_dump())
