"""The reward, term by term (Eq. 7 to 9 of the paper), and what of a step it is computed from.

Terms and their weights share one type, so a term without a weight cannot exist.
"""

from typing import Literal

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.task import RewardConfig
from koz_jax.task.actuators import TorqueLimits


class RewardParams(struct.PyTreeNode):
    """Constants of the reward; traced."""

    angle_factor: jax.Array  # () phi = angle_factor * rotation angle: 1 (full angle) or 0.5 (the literal equation)
    attitude_scale: jax.Array  # () [rad] of exp(-phi / scale)
    settled_angle: jax.Array  # () [rad] the accuracy asked for
    settled_bonus: jax.Array  # ()
    torque_cost: jax.Array  # () per unit of |tau| / |tau_max|
    torque_change_cost: jax.Array  # () [1 / (N m)]
    zone_height: jax.Array  # () beta
    zone_decay: jax.Array  # () [1 / rad] alpha
    zone_tightening: jax.Array  # () [rad] the penalty sees every zone wider by this; 0 in the paper
    no_progress_cost: jax.Array  # ()
    progress_tolerance: jax.Array  # () [rad] phi may grow by less than this and still count as progress


class Outcome(struct.PyTreeNode):
    """What is measured of one step; the replay buffer stores it, and the reward is a function of it."""

    angle: jax.Array  # () [rad] full rotation angle to the target after the step
    angle_previous: jax.Array  # () [rad] the same before the step
    torque: jax.Array  # () [N m] norm of the torque
    torque_change: jax.Array  # () [N m] norm of its change since the step before; 0 in the first step
    zone_margin: jax.Array  # () [rad] margin to the nearest zone after the step
    intervention: jax.Array  # () norm of what a shield changed of the action; 0 without a shield


class RewardTerms(struct.PyTreeNode):
    """One number per term, or one weight per term."""

    attitude: jax.Array | float
    settled: jax.Array | float
    torque: jax.Array | float
    torque_change: jax.Array | float
    zone: jax.Array | float
    no_progress: jax.Array | float
    effort: jax.Array | float  # not in the paper: squared torque, which is what control effort integrates
    intervention: jax.Array | float  # not in the paper: what a shield changed of the action


PAPER_WEIGHTS = RewardTerms(
    attitude=1.0, settled=1.0, torque=1.0, torque_change=1.0, zone=1.0, no_progress=1.0, effort=0.0, intervention=0.0
)


def pointing_error(angle: jax.Array, params: RewardParams) -> jax.Array:
    """phi of the paper in the chosen convention.  angle: () [rad] full rotation angle.  Returns () [rad]."""
    return params.angle_factor * angle


def is_settled(angle: jax.Array, params: RewardParams) -> jax.Array:
    """Whether phi is within the accuracy asked for.  angle: () [rad] full rotation angle.  Returns () bool."""
    return pointing_error(angle, params) <= params.settled_angle


def zone_penalty(margin: jax.Array, params: RewardParams) -> jax.Array:
    """P of Eq. 9: beta inside the zone, beta exp(-alpha margin) outside.  margin: () [rad].  Returns ()."""
    tightened = margin - params.zone_tightening
    return params.zone_height * jnp.exp(-params.zone_decay * jnp.maximum(tightened, 0.0))


def terms(outcome: Outcome, params: RewardParams, limits: TorqueLimits) -> RewardTerms:
    """Every term of the reward of one step, signed as it enters the sum (Eq. 7 and 8).

    |tau_max| of the paper is the norm of the largest torque; effort is counted in shares of the actuators' strength.
    """
    phi = pointing_error(outcome.angle, params)
    phi_previous = pointing_error(outcome.angle_previous, params)
    squared_action = (outcome.torque / limits.scale) ** 2
    progress = phi < phi_previous + params.progress_tolerance
    return RewardTerms(
        attitude=jnp.exp(-phi / params.attitude_scale),
        settled=params.settled_bonus * is_settled(outcome.angle, params),
        torque=-params.torque_cost * outcome.torque / limits.largest,
        torque_change=-params.torque_change_cost * outcome.torque_change,
        zone=-zone_penalty(outcome.zone_margin, params),
        no_progress=-params.no_progress_cost * (1.0 - progress),
        effort=-squared_action,
        intervention=-outcome.intervention,
    )


def total(reward_terms: RewardTerms, weights: RewardTerms) -> jax.Array:
    """Weighted sum of the terms.  Returns ()."""
    return jax.tree.reduce(jnp.add, jax.tree.map(jnp.multiply, reward_terms, weights))


def from_config(config: RewardConfig, angle_convention: Literal["full", "half"]) -> RewardParams:
    """Constants of the reward, as the paper and the settings have them, float32."""
    return RewardParams(
        angle_factor=jnp.float32(1.0 if angle_convention == "full" else 0.5),
        attitude_scale=jnp.float32(config.attitude_scale),
        settled_angle=jnp.deg2rad(jnp.float32(config.settled_angle_deg)),
        settled_bonus=jnp.float32(config.settled_bonus),
        torque_cost=jnp.float32(config.torque_cost),
        torque_change_cost=jnp.float32(config.torque_change_cost),
        zone_height=jnp.float32(config.zone_height),
        zone_decay=jnp.float32(config.zone_decay),
        zone_tightening=jnp.float32(0.0),
        no_progress_cost=jnp.float32(config.no_progress_cost),
        progress_tolerance=jnp.deg2rad(jnp.float32(config.progress_tolerance_deg)),
    )
