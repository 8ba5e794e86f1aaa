"""Fly a maneuver of one's own with an agent or a controller, by name."""

from pathlib import Path

from koz_jax.agents.agent import Agent, load_agent
from koz_jax.agents.record import DEFAULT_AGENT, DEFAULT_FOR_OTHERS
from koz_jax.config.filters import FilterConfig
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.control.registry import BUILT_IN, load_controller
from koz_jax.errors import SettingsError
from koz_jax.evaluation import maneuver as maneuvers
from koz_jax.evaluation.maneuver import FlownManeuver


def fly(
    maneuver: ManeuverConfig,
    agent: TaskController | Path | str | None = None,
    *,
    urgency: float | None = None,
    shield: FilterConfig | None = None,
    seed: int = 0,
    substeps: int = maneuvers.SUBSTEPS,
) -> FlownManeuver:
    """Fly a maneuver, such as ``load_maneuver`` reads.

    Args:
        maneuver: what is flown.
        agent: who flies: an agent or controller, the name of a built-in controller, ``FILE.py:CLASS``, or what
            ``load_agent`` takes; by default a shipped agent: the one of the paper's spacecraft, or the one for all.
        urgency: how much an agent hurries that listens to it, from 0 (thrifty) to 1 (as fast as the torque allows).
        shield: or another safety filter to fly under; None flies without.
        seed: of what is random in flight: errors, and planners' searches.
        substeps: constraints are checked at so many instants of every step, at least 5.

    Raises:
        SettingsError: there is no such agent or controller, or it does not listen to the urgency.

    """
    flying = load_for(maneuver, agent, urgency)
    if shield is not None:
        shield.check(maneuver.task.spacecraft.brake_limits)
    asked = MonteCarloConfig(seed=seed, shield=shield, substeps=substeps)
    config = maneuvers.config_of(maneuver, asked)
    return maneuvers.fly_closely(flying, maneuvers.scenario(maneuver), maneuver.task, config)


def load_for(
    maneuver: ManeuverConfig, agent: TaskController | Path | str | None = None, urgency: float | None = None
) -> TaskController:
    """Load who flies a maneuver; by default the shipped agent that was made for its spacecraft.

    agent, urgency: as of ``fly``.

    Raises:
        SettingsError: as of ``fly``.

    """
    flying = named(agent, maneuver.task) if isinstance(agent, Path | str) else agent
    if flying is None:
        flying = load_agent(DEFAULT_AGENT)
        if urgency is not None or maneuvers.unfamiliar(flying, maneuver):
            flying = load_agent(DEFAULT_FOR_OTHERS)
    return flying if urgency is None else in_a_hurry(flying, urgency)


def named(name: Path | str, task: TaskConfig) -> TaskController:
    """An agent as ``load_agent`` takes it, or a controller by its name or file.

    task: what a controller flies unless told otherwise.

    Raises:
        SettingsError: there is no such agent or controller.

    """
    if isinstance(name, str) and (name in BUILT_IN or ".py:" in name):
        return load_controller(name, task)
    return load_agent(name)


def in_a_hurry(flying: TaskController, urgency: float) -> Agent:
    """The same with an urgency, from 0 (thrifty) to 1 (as fast as the torque allows).

    Raises:
        SettingsError: it is not in [0, 1], or who flies does not listen to it.

    """
    if not isinstance(flying, Agent):
        raise SettingsError(f"urgency: is of agents, and {flying.name} has none; got {urgency}")
    return flying.with_urgency(urgency)
