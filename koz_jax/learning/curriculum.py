"""The curriculum: everything that depends on training time, as a pure function of the training step."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from koz_jax.config.base import Ramp
from koz_jax.config.curriculum import CurriculumConfig, PhaseConfig
from koz_jax.task.reward import PAPER_WEIGHTS, RewardParams, RewardTerms


class Difficulty(struct.PyTreeNode):
    """What training looks like at one step."""

    phase: jax.Array  # () int32, 1 or 2
    min_angle: jax.Array  # () [rad] smallest initial deviation
    max_angle: jax.Array  # () [rad] largest initial deviation
    angle_bias: jax.Array  # () exponent; see ScenarioRanges
    zone_weight: jax.Array  # () factor on the zone penalty
    zone_tightening: jax.Array  # () [rad] how much wider than it is the penalty sees the zone
    zone_steepness: jax.Array  # () factor on the decay of the zone penalty
    effort_weight: jax.Array  # () cost of the squared action
    discount: jax.Array  # () gamma, per environment step
    learning_rate: jax.Array  # ()


def difficulty(curriculum: CurriculumConfig, update: jax.Array) -> Difficulty:
    """The difficulty at a training step.  update: () int32, gradient updates done.  jit-able and vmap-able."""
    start_2 = curriculum.phase1.updates
    in_phase_2 = update >= start_2
    first = _phase_difficulty(curriculum.phase1, 1, update)
    second = _phase_difficulty(curriculum.phase2, 2, update - start_2)
    return jax.tree.map(lambda one, two: jnp.where(in_phase_2, two, one), first, second)


def reward_weights(at: Difficulty) -> RewardTerms:
    """Weights of the reward's terms in training: the paper's, the zone's and effort's by the curriculum."""
    return PAPER_WEIGHTS.replace(zone=at.zone_weight, effort=at.effort_weight)


def reward_params(at: Difficulty, params: RewardParams) -> RewardParams:
    """Constants of the reward in training: the zone's edge and slope by the curriculum, the rest as given."""
    return params.replace(zone_tightening=at.zone_tightening, zone_decay=params.zone_decay * at.zone_steepness)


def _phase_difficulty(phase: PhaseConfig, number: int, update: jax.Array) -> Difficulty:
    # A phase of no length is at its end.
    fraction = jnp.clip(update / phase.updates, 0.0, 1.0) if phase.updates else 1.0

    def value(ramp: Ramp) -> jax.Array:
        fractions, values = np.array(ramp, np.float32).T
        return jnp.interp(fraction, fractions, values)

    return Difficulty(
        phase=jnp.int32(number),
        min_angle=jnp.deg2rad(value(phase.min_angle_deg)),
        max_angle=jnp.deg2rad(value(phase.max_angle_deg)),
        angle_bias=value(phase.angle_bias),
        zone_weight=value(phase.zone_weight),
        zone_tightening=jnp.deg2rad(value(phase.zone_tightening_deg)),
        zone_steepness=value(phase.zone_steepness),
        effort_weight=value(phase.effort_weight),
        discount=value(phase.discount),
        learning_rate=value(phase.learning_rate),
    )
