"""Warnings of what an agent was not made for: another task, more zones than it sees, a target close to a zone."""

import logging

import numpy as np
import numpy.typing as npt

from koz_jax.config import plausibility
from koz_jax.config.actuators.agility import rate_at_start
from koz_jax.config.filters import FilterConfig
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.presets.named import preset
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.control.policy import PolicyController
from koz_jax.storage import processes
from koz_jax.task import pointing_constraints
from koz_jax.task.scenario import Scenario

_log = logging.getLogger(__name__)

# [deg] In float32, two directions are known to about this.
_ROUNDING_DEG = 0.01

# By this factor steps and rates may be outside of what was trained without a word.
_SLACK = 1.2


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
    scaled = agent.controller.network.scaled
    found = outside_of_training(agent.task, task) if scaled else differences(agent.task, task)
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


def outside_of_training(made_for: TaskConfig, flown: TaskConfig) -> list[str]:
    """Name what of a task is outside of what agents for any spacecraft are trained with, in units of the spacecraft.

    That is what the preset ``universal`` spreads, since an agent does not keep what its own training spread; and the
    task that it was made for, which for an agent of ``koz train --spacecraft`` is that spacecraft's.
    """
    if flown.spread.spacecraft:  # steps are drawn
        return []
    trained = preset("universal").task
    found, (shortest, longest) = [], trained.spread.step_shares
    step, own_step = (task.step_seconds / task.spacecraft.time_unit for task in (flown, made_for))
    if not min(shortest, own_step) / _SLACK <= step <= max(longest, own_step) * _SLACK:
        found.append(f"a time step of {step:.2g} T in place of {shortest:g} to {longest:g}")
    rate, own_rate = (rate_at_start(task.spacecraft) * task.spacecraft.time_unit for task in (flown, made_for))
    slowest = np.deg2rad((trained.spread.max_rate_deg or (0.0, 0.0))[0]) * trained.spacecraft.time_unit
    if rate < min(slowest, own_rate) / _SLACK:
        found.append(f"a largest rate of {rate:.2g} / T in place of {slowest:.2g} or more")
    if found:
        found[-1] += f" (T = sqrt(J / u) = {flown.spacecraft.time_unit:.3g} s)"
    return found


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
