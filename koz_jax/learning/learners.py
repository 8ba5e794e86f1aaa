"""Who learns, as the settings say; and which experience it learns from more often."""

from typing import Any

import jax
import jax.numpy as jnp

from koz_jax.config.training import TrainConfig
from koz_jax.control import encoding
from koz_jax.learners.td3 import Td3
from koz_jax.sac.actor_critic import Learner
from koz_jax.sac.learner import Sac
from koz_jax.task import observation_layout
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.reward import Outcome


def make(config: TrainConfig) -> Learner:
    """The learner's static settings."""
    if config.learner == "td3":
        return make_td3(config)
    return make_ddpg(config) if config.learner == "ddpg" else make_sac(config)


def make_sac(config: TrainConfig) -> Sac:
    """Soft Actor-Critic."""
    return Sac(
        **_shared(config),
        target_entropy=config.sac.target_entropy,
        initial_entropy_coefficient=config.sac.initial_entropy_coefficient,
    )


def make_td3(config: TrainConfig) -> Td3:
    """Twin Delayed DDPG."""
    return Td3(**_shared(config), **config.td3.model_dump())


def make_ddpg(config: TrainConfig) -> Td3:
    """Deep Deterministic Policy Gradient."""
    return Td3(**_shared(config), critics=1, exploration_noise=config.ddpg.exploration_noise)


def _shared(config: TrainConfig) -> dict[str, Any]:
    network = config.network
    return {
        "hidden_sizes": network.hidden_sizes,
        "encoding": encoding.views(network),
        "dials": encoding.dials(network),
        "observation_size": observation_layout.size(network.observed_zones, network.scaled),
        "action_size": ACTION_SIZE,
        "soft_update": config.sac.soft_update,
        "policy_average": config.sac.policy_average,
    }


def priority(config: TrainConfig, outcome: Outcome, phase: jax.Array) -> jax.Array | None:
    """How often each step is drawn, in proportion; None where all are alike.

    Of DDPG, as by Cai et al. (2024): in phase 2, what was met near zones more often.

    outcome: leaves (...); phase: () int32.  Returns (...) int32.
    """
    if config.learner != "ddpg" or config.ddpg.zone_priority == 1:
        return None
    near = outcome.zone_margin < jnp.deg2rad(config.ddpg.zone_margin_deg)
    return jnp.where(near & (phase == 2), config.ddpg.zone_priority, 1)
