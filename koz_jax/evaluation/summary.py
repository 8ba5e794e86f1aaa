"""The table of the paper from the outcome of every case."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from koz_jax.config.filters import ZohCbfConfig
from koz_jax.evaluation.digits import percent, percent_between, significant

if TYPE_CHECKING:
    from koz_jax.config.monte_carlo import MonteCarloConfig
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
    unsafe_start_rate: float = 0.0
    infeasible_steps_mean: float = 0.0
    infeasible_case_rate: float = 0.0


class Evaluated(Protocol):
    """What a table can be made of: a ``MonteCarlo``."""

    @property
    def config(self) -> MonteCarloConfig:
        """Which cases were flown, and how."""
        ...

    @property
    def results(self) -> CaseResult:
        """The outcome of every case; NumPy leaves (cases,)."""
        ...

    @property
    def label(self) -> str:
        """Who flew, and whether under the shield."""
        ...

    @property
    def is_of_paper(self) -> bool:
        """Whether the paper's numbers are of the same task."""
        ...


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
        unsafe_start_rate=float(np.mean(results.unsafe_start)),
        infeasible_steps_mean=float(np.mean(results.infeasible_steps)),
        infeasible_case_rate=float(np.mean(np.asarray(results.infeasible_steps) > 0)),
    )


def wilson_interval(rate: float, cases: int) -> tuple[float, float]:
    """95 % confidence interval of a rate (Wilson 1927): honest also at 0 of n.  Returns (low, high) in [0, 1]."""
    z = 1.959964
    centre = (rate + z * z / (2 * cases)) / (1 + z * z / cases)
    half_width = z / (1 + z * z / cases) * math.sqrt(rate * (1 - rate) / cases + z * z / (4 * cases * cases))
    return max(0.0, centre - half_width), min(1.0, centre + half_width)


def table(
    flown: Summary | Evaluated, cases: int = 0, name: str = "", shielded: bool | None = None, paper: bool = True
) -> str:
    """The paper's table with ours beside it, as text.

    Args:
        flown: a whole Monte Carlo, which knows all of the following itself; or its summary alone.
        cases: number of cases.
        name: of who flew, by default the agent's.
        shielded: whether a shield flew, for the rows on what it did; by default where it did anything.
        paper: whether the task is the paper's, so that its numbers stand beside ours.
    """
    if isinstance(flown, Summary):
        did_something = bool(flown.intervention_rate or flown.deadlock_rate or flown.unsafe_start_rate)
        with_shield = did_something if shielded is None else shielded
        return _lines(flown, cases, name, "shield" if with_shield else None, paper)
    under = None if flown.config.shield is None else flown.config.shield.name
    return _lines(summarise(flown.results), flown.config.cases, name or flown.label, under, flown.is_of_paper)


def _lines(ours: Summary, cases: int, name: str, under: str | None, paper: bool) -> str:
    """Rows of a label, the paper's number and ours, aligned.  under: name of the filter that flew, if any."""
    rows = [(f"{cases} cases", "paper", name), *_rows(ours, cases)]
    if under is not None:
        rows += [
            (f"{under} intervened, of all steps", "-", percent(ours.intervention_rate)),
            ("mean change of torque [N m]", "-", significant(ours.mean_torque_change, 4)),
            ("deadlocked", "-", percent(ours.deadlock_rate)),
            (f"start not covered by the {under}", "-", percent(ours.unsafe_start_rate)),
        ]
    if under == ZohCbfConfig.name or ours.infeasible_case_rate:
        rows += [
            ("steps without a solution, per case", "-", significant(ours.infeasible_steps_mean, 3)),
            ("cases with such a step", "-", percent(ours.infeasible_case_rate)),
        ]
    columns = (0, 1, 2) if paper else (0, 2)
    widths = [max(len(row[column]) for row in rows) for column in columns]
    lines = [
        "  ".join(row[column].ljust(width) for column, width in zip(columns, widths, strict=True)).rstrip()
        for row in rows
    ]
    lines.insert(1, "-" * max(map(len, lines)))
    return "\n".join([*lines, "* settled cases only; rates with their 95 % interval"])


def _rows(ours: Summary, cases: int) -> list[tuple[str, str, str]]:
    paper = PAPER_TABLE

    def spread(label: str, mean: str, std: str, decimals: int) -> tuple[str, str, str]:
        papers, own = ((getattr(summary, mean), getattr(summary, std)) for summary in (paper, ours))
        return (
            label,
            " +- ".join(f"{value:.2f}" for value in papers),
            " +- ".join(significant(value, decimals) for value in own),
        )

    def rate(label: str, field: str, decimals: int = 2) -> tuple[str, str, str]:
        own = getattr(ours, field)
        papers = f"{100 * getattr(paper, field):.{decimals}f} %"
        return label, papers, percent_between(own, *wilson_interval(own, cases))

    return [
        spread("mean reward", "mean_reward", "std_reward", 2),
        spread("settling time* [s]", "settling_time_mean", "settling_time_std", 2),
        spread("control effort* [N2 m2 s]", "control_effort_mean", "control_effort_std", 2),
        spread("control accuracy* [deg]", "control_accuracy_deg_mean", "control_accuracy_deg_std", 4),
        rate("not settled", "non_settled_rate"),
        rate("violated", "violation_rate"),
        rate("success", "success_rate", 0),
        ("smallest margin [deg]", "-", significant(ours.min_margin_deg, 3)),
    ]
