"""Results as text: a CSV row per case, a CSV row per instant of a maneuver, one case in words."""

import csv
import io
from collections.abc import Iterable

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.digits import significant
from koz_jax.evaluation.rollout import CaseResult, History

# [rad] In float32.
_ROUNDING = 1e-6


def _csv(columns: dict[str, np.ndarray]) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(_cells(values) for values in columns.values()), strict=True))
    return text.getvalue()


def _cells(values: np.ndarray) -> Iterable[str]:
    exact = values.dtype.kind in "biu"
    return [str(int(value)) if exact else f"{value:.9g}" for value in values]


def cases_csv(results: CaseResult) -> str:
    """A row per case.  results: NumPy leaves (cases,)."""
    return _csv(
        {
            "case": np.arange(len(results.settled)),
            "initial_angle_deg": np.rad2deg(results.initial_angle),
            "reward": np.asarray(results.reward),
            "settling_time_s": np.asarray(results.settling_time),
            "control_effort_N2m2s": np.asarray(results.control_effort),
            "control_accuracy_deg": np.rad2deg(results.control_accuracy),
            "min_margin_deg": np.rad2deg(results.min_margin),
            "intervention_rate": np.asarray(results.intervention_rate),
            "mean_torque_change_Nm": np.asarray(results.mean_torque_change),
            "deadlocked": np.asarray(results.deadlocked),
            "unsafe_start": np.asarray(results.unsafe_start),
            "infeasible_steps": np.asarray(results.infeasible_steps),
            "settled": np.asarray(results.settled),
            "violated": np.asarray(results.violated),
        }
    )


def history_csv(history: History, task: TaskConfig) -> str:
    """A row per instant of a maneuver, the start first."""
    seconds = np.arange(len(history.zone_margin)) * task.step_seconds
    columns = {"time_s": seconds}
    q_e = np.asarray(history.attitude_error)
    columns |= {f"q_e{i}": q_e[:, i] for i in range(4)}
    omega_deg = np.rad2deg(history.state.body.omega_BN_B)
    columns |= {f"omega_{axis}_deg_s": omega_deg[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"torque_{axis}_Nm": np.asarray(history.torque_B)[:, i] for i, axis in enumerate("xyz")}
    columns |= {
        "theta_margin_deg": np.rad2deg(history.zone_margin),
        "phi_deg": np.rad2deg(history.pointing_error),
    }
    return _csv(columns)


def describe_case(case: int, result: CaseResult) -> str:
    """One case in one line."""
    return f"case {case}: {describe_result(result)}"


def _clearance(result: CaseResult) -> str:
    """How far it stayed from the zones; one that is absent has a margin of pi or more, which no other has."""
    margin = float(result.min_margin)
    if margin >= np.pi - _ROUNDING:
        return "no zone"
    zone = "violated the zone" if result.violated else "stayed clear of the zone"
    return f"{zone} (smallest margin {significant(np.rad2deg(margin), 2)} deg)"


def describe_result(result: CaseResult) -> str:
    """What a maneuver comes to, in one line."""
    settled = f"settled after {significant(float(result.settling_time), 1)} s" if result.settled else "not settled"
    start = ", from a start that the shield does not cover" if result.unsafe_start else ""
    return (
        f"{significant(np.rad2deg(float(result.initial_angle)), 1)} deg{start}, {settled}, {_clearance(result)},"
        f" effort {significant(float(result.control_effort), 1)} N2 m2 s,"
        f" accuracy {significant(np.rad2deg(float(result.control_accuracy)), 4)} deg,"
        f" reward {significant(float(result.reward), 1)}"
    )
