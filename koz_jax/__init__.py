"""Keep-out-zone attitude control learned end to end in JAX.

The public names are loaded on first use: importing the package alone does not import jax.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from koz_jax.agents.agent import Agent as Agent
    from koz_jax.agents.agent import load_agent as load_agent
    from koz_jax.agents.flight import fly as fly
    from koz_jax.agents.numpy_policy import load_policy as load_policy
    from koz_jax.agents.record import shipped_agents as shipped_agents
    from koz_jax.config.maneuvers.maneuver import ManeuverConfig as ManeuverConfig
    from koz_jax.config.maneuvers.maneuver_file import load_maneuver as load_maneuver
    from koz_jax.config.monte_carlo import MonteCarloConfig as MonteCarloConfig
    from koz_jax.config.presets.named import preset as preset
    from koz_jax.config.shield import ShieldConfig as ShieldConfig
    from koz_jax.config.task import ScenarioConfig as ScenarioConfig
    from koz_jax.config.task import SpacecraftConfig as SpacecraftConfig
    from koz_jax.config.task import TaskConfig as TaskConfig
    from koz_jax.config.training import TrainConfig as TrainConfig
    from koz_jax.config.uncertainty import UncertaintyConfig as UncertaintyConfig
    from koz_jax.control.registry import load_controller as load_controller
    from koz_jax.errors import DamagedFileError as DamagedFileError
    from koz_jax.errors import KozError as KozError
    from koz_jax.errors import MissingExtraError as MissingExtraError
    from koz_jax.errors import SettingsError as SettingsError
    from koz_jax.errors import StorageError as StorageError
    from koz_jax.evaluation.cases import fly_case as fly_case
    from koz_jax.evaluation.cases import fly_scenario as fly_scenario
    from koz_jax.evaluation.monte_carlo import MonteCarlo as MonteCarlo
    from koz_jax.evaluation.monte_carlo import monte_carlo as monte_carlo
    from koz_jax.evaluation.summary import summarise as summarise
    from koz_jax.evaluation.summary import table as table
    from koz_jax.runs.trainer import train as train
    from koz_jax.task.environment import Reorientation as Reorientation
    from koz_jax.task.maneuver import maneuver as maneuver

    __version__: str

# Where the public names are.
_HOME = {
    "Reorientation": "task.environment",
    "TaskConfig": "config.task",
    "SpacecraftConfig": "config.task",
    "ScenarioConfig": "config.task",
    "ShieldConfig": "config.shield",
    "UncertaintyConfig": "config.uncertainty",
    "MonteCarloConfig": "config.monte_carlo",
    "TrainConfig": "config.training",
    "preset": "config.presets.named",
    "train": "runs.trainer",
    "Agent": "agents.agent",
    "load_agent": "agents.agent",
    "load_policy": "agents.numpy_policy",
    "shipped_agents": "agents.record",
    "load_controller": "control.registry",
    "monte_carlo": "evaluation.monte_carlo",
    "MonteCarlo": "evaluation.monte_carlo",
    "fly_case": "evaluation.cases",
    "fly_scenario": "evaluation.cases",
    "maneuver": "task.maneuver",
    "ManeuverConfig": "config.maneuvers.maneuver",
    "load_maneuver": "config.maneuvers.maneuver_file",
    "fly": "agents.flight",
    "summarise": "evaluation.summary",
    "table": "evaluation.summary",
    "KozError": "errors",
    "SettingsError": "errors",
    "StorageError": "errors",
    "DamagedFileError": "errors",
    "MissingExtraError": "errors",
}

__all__ = [*_HOME]  # pyright: ignore[reportUnsupportedDunderAll]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from koz_jax.config.version import version

        return version()
    if name not in _HOME:
        raise AttributeError(f"module 'koz_jax' has no attribute {name!r}")
    return getattr(importlib.import_module(f"koz_jax.{_HOME[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME, "__version__"})
