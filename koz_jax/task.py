"""From settings in degrees to the traced parameters of the core."""

import jax.numpy as jnp

from koz_jax.dynamics import Spacecraft
from koz_jax.env import EnvParams
from koz_jax.reward import RewardParams
from koz_jax.scenario import ScenarioRanges
from koz_jax.task_config import ScenarioConfig, TaskConfig


def env_params(task: TaskConfig) -> EnvParams:
    """The environment's parameters, float32."""
    reward = task.reward
    return EnvParams(
        spacecraft=Spacecraft(
            inertia_B=jnp.array(task.spacecraft.inertia),
            boresight_B=jnp.array(task.spacecraft.boresight),
            torque_limit=jnp.float32(task.spacecraft.torque_limit),
        ),
        reward=RewardParams(
            angle_factor=jnp.float32(1.0 if task.angle_convention == "full" else 0.5),
            attitude_scale=jnp.float32(reward.attitude_scale),
            settled_angle=jnp.deg2rad(jnp.float32(reward.settled_angle_deg)),
            settled_bonus=jnp.float32(reward.settled_bonus),
            torque_cost=jnp.float32(reward.torque_cost),
            torque_change_cost=jnp.float32(reward.torque_change_cost),
            zone_height=jnp.float32(reward.zone_height),
            zone_decay=jnp.float32(reward.zone_decay),
            zone_tightening=jnp.float32(0.0),
            no_progress_cost=jnp.float32(reward.no_progress_cost),
            progress_tolerance=jnp.deg2rad(jnp.float32(reward.progress_tolerance_deg)),
        ),
        dt=jnp.float32(task.step_seconds),
        disturbance_B=jnp.zeros(3),
    )


def scenario_ranges(scenario: ScenarioConfig, min_angle_deg: float, max_angle_deg: float) -> ScenarioRanges:
    """Distribution of scenarios with deviations uniform between two angles [deg]."""
    return ScenarioRanges(
        min_angle=jnp.deg2rad(jnp.float32(min_angle_deg)),
        max_angle=jnp.deg2rad(jnp.float32(max_angle_deg)),
        angle_bias=jnp.float32(1.0),
        max_rate=jnp.deg2rad(jnp.float32(scenario.max_rate_deg)),
        min_half_angle=jnp.deg2rad(jnp.float32(scenario.min_half_angle_deg)),
        max_half_angle=jnp.deg2rad(jnp.float32(scenario.max_half_angle_deg)),
        separation=jnp.deg2rad(jnp.float32(scenario.separation_deg)),
        zone_gap=jnp.deg2rad(jnp.float32(scenario.zone_gap_deg)),
        min_zones=jnp.int32(scenario.min_zones),
        max_zones=scenario.max_zones,
    )
