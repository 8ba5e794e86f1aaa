"""Fly a maneuver of one's own with an agent or a controller, by name."""

from pathlib import Path

from koz_jax.agents.agent import load_agent
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.control.base import TaskController
from koz_jax.control.registry import BUILT_IN, load_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation import maneuver as maneuvers
from koz_jax.evaluation.maneuver import FlownManeuver

# Who flies where nobody is named, if it was made for the spacecraft.
DEFAULT_AGENT = "phase2"


def fly(
    maneuver: ManeuverConfig,
    agent: TaskController | Path | str | None = None,
    *,
    shield: ShieldConfig | None = None,
    seed: int = 0,
    substeps: int = maneuvers.SUBSTEPS,
) -> FlownManeuver:
    """Fly a maneuver, such as ``load_maneuver`` reads.

    Args:
        maneuver: what is flown.
        agent: who flies: an agent or controller, the name of a built-in controller, ``FILE.py:CLASS``, or what
            ``load_agent`` takes; by default the shipped agent, if it was made for the spacecraft.
        shield: to fly under; None flies without.
        seed: of what is random in flight: errors, and planners' searches.
        substeps: constraints are checked at so many instants of every step, at least 5.

    Raises:
        SettingsError: there is no such agent or controller, or nobody was named for a spacecraft of one's own.

    """
    flying = load_for(maneuver, agent)
    if shield is not None:
        shield.check(maneuver.task.spacecraft.torque_limits)
    asked = MonteCarloConfig(seed=seed, shield=shield, substeps=substeps)
    config = maneuvers.config_of(maneuver, asked)
    return maneuvers.fly_closely(flying, maneuvers.scenario(maneuver), maneuver.task, config)


def load_for(maneuver: ManeuverConfig, agent: TaskController | Path | str | None = None) -> TaskController:
    """Load who flies a maneuver; nobody by default where the default agent was not made for it.

    agent: as of ``fly``.

    Raises:
        SettingsError: there is no such agent or controller, or nobody was named for a spacecraft of one's own.

    """
    if isinstance(agent, str) and (agent in BUILT_IN or ".py:" in agent):
        return load_controller(agent, maneuver.task)
    flying = load_agent(agent or DEFAULT_AGENT) if agent is None or isinstance(agent, Path | str) else agent
    other = maneuvers.unfamiliar(flying, maneuver)
    if other and agent is None:
        raise SettingsError(
            f"agent: {DEFAULT_AGENT}, which flies by default, was not made for {maneuver.name!r} ({'; '.join(other)});"
            " name who flies, such as --controller planner --shield, or --agent with an agent of your own"
        )
    return flying
