"""Golden vectors of the right shape for self-tests that are compiled and not run: none need be searched for."""

from collections.abc import Sequence

import numpy as np

from koz_jax.agents.agent import Agent
from koz_jax.agents.numpy_policy import exported_zone_count
from koz_jax.config.base import Vector
from koz_jax.config.shield import ShieldConfig
from koz_jax.export.golden import Golden
from koz_jax.export.shield_golden import ShieldGolden
from koz_jax.task.observation_layout import size


def _entries(agent: Agent, further: int, least_zones: int) -> int:
    """Numbers of a situation."""
    zones = exported_zone_count(agent.controller.network, agent.task.scenario, least_zones)
    return 11 + (5 if further else 4) * zones + len(agent.task.spacecraft.wheels)


def golden(agent: Agent, count: int, further_boresights: Sequence[Vector] = (), least_zones: int = 0) -> Golden:
    """In place of ``export.golden.golden``."""
    network, wheels = agent.controller.network, len(agent.task.spacecraft.wheels)
    memory = 4 + network.scaled + 3 * bool(wheels) + bool(further_boresights)
    seen = size(network.observed_zones, network.scaled)
    entries = _entries(agent, len(further_boresights), least_zones)
    return Golden(*(np.zeros((count, each), np.float32) for each in (entries, memory, seen, 3, 3, wheels)))


def shield_golden(
    agent: Agent, config: ShieldConfig, count: int, further_boresights: Sequence[Vector] = (), least_zones: int = 0
) -> ShieldGolden:
    """In place of ``export.shield_golden.shield_golden``."""
    torques, entries = np.zeros((count, 3), np.float32), _entries(agent, len(further_boresights), least_zones)
    return ShieldGolden(np.zeros((count, entries), np.float32), torques, torques, np.zeros(count, bool))
