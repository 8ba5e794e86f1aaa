"""Keep-out-zone attitude control learned end to end in JAX.

The public names are loaded on first use: importing the package alone does not import jax.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from koz_jax.agent import Agent, load_agent, shipped_agents
    from koz_jax.config import TrainConfig
    from koz_jax.errors import UserError
    from koz_jax.evaluation import MonteCarlo, fly_case, fly_scenario, monte_carlo
    from koz_jax.numpy_policy import load_policy
    from koz_jax.presets import preset
    from koz_jax.summary import summarise, table
    from koz_jax.trainer import train

__version__ = "0.1.0"

__all__ = [
    "Agent",
    "MonteCarlo",
    "TrainConfig",
    "UserError",
    "fly_case",
    "fly_scenario",
    "load_agent",
    "load_policy",
    "monte_carlo",
    "preset",
    "shipped_agents",
    "summarise",
    "table",
    "train",
]

_HOME = {
    "Agent": "agent",
    "load_agent": "agent",
    "shipped_agents": "agent",
    "TrainConfig": "config",
    "UserError": "errors",
    "MonteCarlo": "evaluation",
    "fly_case": "evaluation",
    "fly_scenario": "evaluation",
    "monte_carlo": "evaluation",
    "load_policy": "numpy_policy",
    "preset": "presets",
    "summarise": "summary",
    "table": "summary",
    "train": "trainer",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'koz_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"koz_jax.{_HOME[name]}"), name)
