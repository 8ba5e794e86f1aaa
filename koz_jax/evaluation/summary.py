"""The table of the paper from the outcome of every case."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from koz_jax.evaluation.rollout import CaseResult


@dataclasses.dataclass(frozen=True)
class Summary:
    """The rows of Table 4; field names are the keys of the JSON results.

    Rates are shares in [0, 1], of all cases but for interventions, which are of all steps.  Settling time, effort and
    accuracy are over the settled cases, nan if there is none.
    """

    mean_reward: float
    std_reward: float
    settling_time_mean: float
    settling_time_std: float
    control_effort_mean: float
    control_effort_std: float
    control_accuracy_deg_mean: float
    control_accuracy_deg_std: float
    non_settled_rate: float
    violation_rate: float
    success_rate: float
    min_margin_deg: float = math.nan
    intervention_rate: float = 0.0
    mean_torque_change: float = 0.0
    deadlock_rate: float = 0.0


PAPER_TABLE = Summary(
    mean_reward=7281.91,
    std_reward=688.85,
    settling_time_mean=27.81,
    settling_time_std=5.24,
    control_effort_mean=76.02,
    control_effort_std=25.76,
    control_accuracy_deg_mean=0.08,
    control_accuracy_deg_std=0.04,
    non_settled_rate=0.0032,
    violation_rate=0.0266,
    success_rate=0.97,
)


def summarise(results: CaseResult) -> Summary:
    """Means, standard deviations and rates.  results: NumPy leaves (cases,)."""
    settled = np.asarray(results.settled)

    def over_settled(values: npt.ArrayLike) -> tuple[float, float]:
        chosen = np.asarray(values, np.float64)[settled]
        return (float(chosen.mean()), float(chosen.std())) if chosen.size else (math.nan, math.nan)

    reward = np.asarray(results.reward, np.float64)
    settling_time = over_settled(results.settling_time)
    effort = over_settled(results.control_effort)
    accuracy_deg = over_settled(np.rad2deg(results.control_accuracy))
    return Summary(
        mean_reward=float(reward.mean()),
        std_reward=float(reward.std()),
        settling_time_mean=settling_time[0],
        settling_time_std=settling_time[1],
        control_effort_mean=effort[0],
        control_effort_std=effort[1],
        control_accuracy_deg_mean=accuracy_deg[0],
        control_accuracy_deg_std=accuracy_deg[1],
        non_settled_rate=float(np.mean(~settled)),
        violation_rate=float(np.mean(results.violated)),
        success_rate=float(np.mean(results.success)),
        min_margin_deg=float(np.rad2deg(np.min(results.min_margin))),
        intervention_rate=float(np.mean(results.intervention_rate)),
        mean_torque_change=float(np.mean(results.mean_torque_change)),
        deadlock_rate=float(np.mean(results.deadlocked)),
    )


def wilson_interval(rate: float, cases: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927): honest also at 0 of n.  Returns (low, high) in [0, 1]."""
    z = 1.959964
    centre = (rate + z * z / (2 * cases)) / (1 + z * z / cases)
    half_width = z / (1 + z * z / cases) * math.sqrt(rate * (1 - rate) / cases + z * z / (4 * cases * cases))
    return max(0.0, centre - half_width), min(1.0, centre + half_width)


def table(summary: Summary, cases: int, name: str, shielded: bool = False) -> str:
    """The paper's table with ours beside it, as text; with what the shield did where there was one."""
    ours, paper = summary, PAPER_TABLE

    def spread(label: str, field: str, digits: int) -> tuple[str, str, str]:
        mean, std = {
            "reward": ("mean_reward", "std_reward"),
        }.get(field, (f"{field}_mean", f"{field}_std"))
        return (
            label,
            f"{getattr(paper, mean):.{min(digits, 2)}f} +- {getattr(paper, std):.{min(digits, 2)}f}",
            f"{getattr(ours, mean):.{digits}f} +- {getattr(ours, std):.{digits}f}",
        )

    def rate(label: str, field: str, digits: int = 2) -> tuple[str, str, str]:
        low, high = wilson_interval(getattr(ours, field), cases)
        return (
            label,
            f"{100 * getattr(paper, field):.{digits}f} %",
            f"{100 * getattr(ours, field):.2f} %  [{100 * low:.2f}, {100 * high:.2f}]",
        )

    rows = [
        (f"{cases} cases", "paper", name),
        spread("mean reward", "reward", 2),
        spread("settling time* [s]", "settling_time", 2),
        spread("control effort* [N2 m2 s]", "control_effort", 2),
        spread("control accuracy* [deg]", "control_accuracy_deg", 4),
        rate("not settled", "non_settled_rate"),
        rate("violated", "violation_rate"),
        rate("success", "success_rate", 0),
        ("smallest margin [deg]", "-", f"{ours.min_margin_deg:.3f}"),
    ]
    if shielded:
        rows += [
            ("shield intervened, of all steps", "-", f"{100 * ours.intervention_rate:.2f} %"),
            ("mean change of torque [N m]", "-", f"{ours.mean_torque_change:.4f}"),
            ("deadlocked", "-", f"{100 * ours.deadlock_rate:.2f} %"),
        ]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines.insert(1, "-" * max(map(len, lines)))
    return "\n".join([*lines, "* settled cases only; rates with their 95 % interval"])
