"""One maneuver of one's own: its scenario, its flight, and what that comes to constraint by constraint."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import numpy.typing as npt

from koz_jax.config.filters import for_cones
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_tables import ConstraintConfig, fastest_cone_deg
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.control.policy import PolicyController
from koz_jax.evaluation import cases, cautions
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.task import maneuver as maneuvers
from koz_jax.task import pointing_constraints, rotations
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario

# Constraints of a maneuver are checked at so many instants of every step, at least.
SUBSTEPS = 5


@dataclasses.dataclass(frozen=True)
class FlownManeuver:
    """A maneuver that was flown."""

    history: History
    result: CaseResult
    margins_deg: np.ndarray  # (constraints,) [deg] smallest margin to each, those that are absent left out
    peak_rate_deg: float  # [deg/s] largest norm of the body rate
    peak_momentum_share: float | None = None  # most that any wheel held, of its limit; None without wheels

    def report(self) -> dict[str, Any]:
        """What ``koz fly --json`` writes; None stands for what there is not."""
        result = self.result
        return {
            "settled": bool(result.settled),
            "violated": bool(result.violated),
            "settling_time_s": _number(result.settling_time),
            "control_effort": _number(result.control_effort),
            "end_error_deg": _number(np.rad2deg(result.control_accuracy)),
            "min_margin_deg": _number(self.margins_deg.min()) if len(self.margins_deg) else None,
            "peak_rate_deg": _number(self.peak_rate_deg),
            "peak_wheel_momentum_share": _number(self.peak_momentum_share),
            "intervention_rate": _number(result.intervention_rate),
            "deadlocked": bool(result.deadlocked),
            "margins_deg": [_number(margin) for margin in self.margins_deg],
        }


def _number(value: npt.ArrayLike | None) -> float | None:
    """A number with the digits that float32 has; None for none, and for one that is not finite."""
    return float(f"{float(np.asarray(value)):.7g}") if value is not None and np.isfinite(value) else None


def scenario(maneuver: ManeuverConfig) -> Scenario:
    """What is flown, in float32 arrays.  Without constraints there is one that is absent."""
    return maneuvers.of_numbers(
        maneuver.start.attitude,
        maneuver.aim.attitude,
        [_zone(maneuver, one) for one in maneuver.constraints],
        boresight=maneuver.task.spacecraft.boresight,
        rate_deg=maneuver.start.rate_deg,
    )


def _zone(maneuver: ManeuverConfig, one: ConstraintConfig) -> tuple[Any, ...]:
    """A zone as ``task.maneuver`` takes it."""
    cone = one.keep_out_cone
    return cone.direction, cone.half_angle_deg, maneuver.boresight(one.instrument), cone.rotation_deg


def config_of(maneuver: ManeuverConfig, config: MonteCarloConfig) -> MonteCarloConfig:
    """Conditions of a flight with the errors of a maneuver and the rates of its cones, checked closely."""
    changes: dict[str, Any] = {"substeps": max(SUBSTEPS, config.substeps)}
    if maneuver.has_errors:
        changes["uncertainty"] = maneuver.errors.uncertainty
    if config.shield is not None:
        changes["shield"] = for_cones(config.shield, fastest_cone_deg(maneuver.constraints))
    return config.model_copy(update=changes)


def unfamiliar(agent: TaskController, maneuver: ManeuverConfig) -> list[str]:
    """What a trained agent was not made for, in words; empty where it was, and for controllers of any spacecraft."""
    if not isinstance(agent.controller, PolicyController):
        return []
    if agent.controller.network.scaled:
        return []
    found = cautions.differences(agent.task, maneuver.task)
    looks = {tuple(maneuver.boresight(one.instrument).tolist()) for one in maneuver.constraints}
    looks.add(maneuver.task.spacecraft.boresight)
    return [*found, f"{len(looks)} instruments in place of one"] if len(looks) > 1 else found


def fly_closely(
    agent: TaskController, drawn: Scenario, task: TaskConfig, config: MonteCarloConfig, case: int = 0
) -> FlownManeuver:
    """``cases.fly_scenario``, with what each constraint came to at the settings' ``substeps`` of every step."""
    history, result = cases.fly_scenario(agent, drawn, task, config, case)
    bodies = cases.within_steps(history, task, config, case)
    margins, rate = _worst(bodies, drawn.constraints, jnp.float32(task.step_seconds / config.substeps))
    present = np.asarray(drawn.constraints.is_present)
    return FlownManeuver(
        history,
        result,
        np.rad2deg(np.asarray(margins)[present]),
        float(np.rad2deg(rate)),
        _momentum_share(history, task),
    )


def _momentum_share(history: History, task: TaskConfig) -> float | None:
    wheels = task.spacecraft.wheels
    if not wheels:
        return None
    limits = np.array([wheel.max_momentum for wheel in wheels])
    return float((np.abs(np.asarray(history.state.actuators)) / limits).max())


@jax.jit
def _worst(bodies: RigidBodyState, constraints: PointingConstraint, apart: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Smallest margin to each constraint, and the largest rate.

    bodies: leaves (instants, ...); apart: () [s] between the instants.  Returns (constraints,) [rad] and () [rad/s].
    """

    def margins_at(q_BN: jax.Array, instant: jax.Array) -> jax.Array:
        return pointing_constraints.margins(q_BN, pointing_constraints.later(constraints, instant * apart))

    margins = jax.vmap(margins_at)(bodies.q_BN, jnp.arange(len(bodies.q_BN)))
    return jnp.min(margins, axis=0), jnp.max(jax.vmap(rotations.norm)(bodies.omega_BN_B))


def describe(maneuver: ManeuverConfig, flown: FlownManeuver) -> str:
    """What was chosen, the margins, and the result beside what is published, in lines."""
    lines = []
    if maneuver.duration_seconds is None:
        lines.append(f"flown for {maneuver.seconds:g} s: {maneuver.default_duration[1]}")
    if maneuver.target.direction is not None:
        chosen = f"rolled by {maneuver.aim.roll_deg:+.1f} deg, clear of all cones" if maneuver.aim.roll_deg else "as is"
        lines.append(f"target: the roll that the smallest rotation gives, {chosen}; attitude {_row(maneuver)}")
    for i, (one, margin) in enumerate(zip(maneuver.constraints, flown.margins_deg, strict=True)):
        cone = f"{one.half_angle_deg:g} deg" + (" to be kept in" if one.kind == "keep_in" else "")
        lines.append(f"constraints.{i}: {one.instrument} {margin:.4g} deg {one.allowed_side} {cone}")
    looking = list(dict.fromkeys(one.instrument for one in maneuver.constraints))
    if len(looking) > 1:
        lines.append(f"pictures show where {looking[0]} looks and its cones, not {', '.join(looking[1:])}")
    return "\n".join([*lines, *_comparison(maneuver, flown)])


def _row(maneuver: ManeuverConfig) -> str:
    return "(" + ", ".join(f"{value:.6f}" for value in maneuver.aim.attitude) + ")"


def _comparison(maneuver: ManeuverConfig, flown: FlownManeuver) -> list[str]:
    """A table: the quantity, what was flown, what is published where something is."""
    report, others = flown.report(), maneuver.published
    slew = float(np.rad2deg(flown.result.initial_angle))
    rows = [
        ("rotation [deg]", slew, "slew_deg"),
        ("settling time [s]", report["settling_time_s"], "settling_seconds"),
        ("control effort [N2 m2 s]", report["control_effort"], "control_effort"),
        ("error at the end [deg]", report["end_error_deg"], "end_error_deg"),
        ("smallest margin [deg]", report["min_margin_deg"], "min_margin_deg"),
        ("largest rate [deg/s]", report["peak_rate_deg"], "peak_rate_deg"),
    ]
    head = f"{'':26}{'flown':>12}" + (f"{'published':>12}" if others else "")
    table = [head.rstrip()]
    for label, value, name in rows:
        cells = [value] + ([getattr(others, name)] if others else [])
        table.append(f"{label:26}" + "".join(f"{'-' if cell is None else f'{cell:.4g}':>12}" for cell in cells))
    return table + ([f"published: {others.by}"] if others and others.by else [])
