"""Warnings of what an agent was not made for: another task, more zones than it sees, a target close to a zone."""

import logging

import numpy as np
import numpy.typing as npt

from koz_jax.config import plausibility
from koz_jax.config.filters import FilterConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.control.policy import PolicyController
from koz_jax.storage import processes
from koz_jax.task import pointing_constraints
from koz_jax.task.scenario import Scenario

_log = logging.getLogger(__name__)

# [deg] In float32, two directions are known to about this.
_ROUNDING_DEG = 0.01


def warn_of_task(agent: TaskController, task: TaskConfig, config: MonteCarloConfig) -> None:
    """Warn, once a flight, of numbers that hardly fit together, and of a task that the agent was not made for.

    agent: who flies; only trained ones are made for a task.  task, config: what is flown, and how.
    """
    if not processes.is_primary_process():
        return
    for finding in plausibility.findings(task, config.min_angle_deg, config.max_angle_deg):
        _log.warning("%s", finding.text)
    warn_of_differences(agent, task)


def warn_of_differences(agent: TaskController, task: TaskConfig) -> None:
    """Warn, in one line, of all in which a task differs from the one that an agent was trained for."""
    if not isinstance(agent.controller, PolicyController):
        return
    found = [] if agent.controller.network.scaled else differences(agent.task, task)
    seen = agent.controller.network.observed_zones
    if seen < task.zones[1]:
        nearest = "the nearest zone" if seen == 1 else f"the nearest {seen} zones"
        found.append(f"it sees {nearest} of up to {task.zones[1]}")
    if found:
        _log.warning("%s was not made for this: %s", agent.name, "; ".join(found))


def differences(made_for: TaskConfig, flown: TaskConfig) -> list[str]:
    """Name in what a task is another one, or a harder one, than that which an agent was trained for."""
    body, own = flown.spacecraft, made_for.spacecraft
    pairs: list[tuple[str, npt.ArrayLike, npt.ArrayLike]] = [
        ("a time step of {} s", flown.step_seconds, made_for.step_seconds),
        ("moments of inertia of {} kg m^2", np.diag(body.inertia), np.diag(own.inertia)),
        ("products of inertia of {} kg m^2", _products(body.inertia), _products(own.inertia)),
        ("torque limits of {} N m", body.torque_limits, own.torque_limits),
        ("the boresight {}", body.boresight, own.boresight),
    ]
    scenario, trained = flown.scenario, made_for.scenario
    if scenario.separation_deg < trained.separation_deg:
        pairs.append(("{} deg between zones and target", scenario.separation_deg, trained.separation_deg))
    if scenario.max_half_angle_deg > trained.max_half_angle_deg:
        pairs.append(("half angles up to {} deg", scenario.max_half_angle_deg, trained.max_half_angle_deg))
    if scenario.max_rate_deg > trained.max_rate_deg:
        pairs.append(("initial rates up to {} deg/s", scenario.max_rate_deg, trained.max_rate_deg))
    return [
        f"{form.format(_told(now))} in place of {_told(then)}"
        for form, now, then in pairs
        if not np.allclose(now, then, rtol=1e-6, atol=1e-9)
    ]


def _products(inertia: npt.ArrayLike) -> np.ndarray:
    """Entries beside the diagonal: xy, xz, yz."""
    return np.array(inertia)[np.triu_indices(3, 1)]


def _told(numbers: npt.ArrayLike) -> str:
    return ", ".join(f"{number:g}" for number in np.atleast_1d(numbers))


def warn_of_target(agent: TaskController, drawn: Scenario, shield: FilterConfig | None) -> None:
    """Warn of a target from which a zone is nearer than the agent was trained for, or than the shield allows.

    drawn: one maneuver; shield: or another filter that is flown under, if any.
    """
    present = np.asarray(drawn.constraints.is_present)
    if not present.any():
        return
    margins = np.rad2deg(np.asarray(pointing_constraints.margins(drawn.q_DN, drawn.constraints)))
    margin = float(margins[present].min())
    least = agent.task.scenario.separation_deg if isinstance(agent.controller, PolicyController) else 0.0
    where = f"the target is {margin:.3g} deg from the edge of a zone" if margin > 0.0 else "the target is inside a zone"
    if shield is not None and margin < shield.margin_deg:
        _log.warning("%s, and the %s keeps %g deg: it is never reached", where, shield.name, shield.margin_deg)
    elif margin < least - _ROUNDING_DEG:
        _log.warning("%s; %s was trained with %g deg or more, and may never settle on it", where, agent.name, least)
    elif margin <= 0.0:
        _log.warning("%s", where)
