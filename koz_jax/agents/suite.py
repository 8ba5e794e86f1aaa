"""The suite: maneuvers that others have published, flown by everybody, with what they report beside it.

A folder of maneuver files of one's own is flown in the same way.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from koz_jax.agents.flight import load_for, named
from koz_jax.agents.record import DEFAULT_FOR_OTHERS
from koz_jax.config.filters import FilterName, filter_named
from koz_jax.config.maneuvers.maneuver import ManeuverConfig
from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import TaskController
from koz_jax.control.registry import CLASSICAL
from koz_jax.errors import SettingsError
from koz_jax.evaluation import cases, timing
from koz_jax.evaluation import maneuver as maneuvers
from koz_jax.evaluation.digits import significant
from koz_jax.evaluation.maneuver import FlownManeuver
from koz_jax.evaluation.summary import summarise

EVERYBODY = (DEFAULT_FOR_OTHERS, *CLASSICAL)

# What a controller flies under.
Under = FilterName | None

PUBLISHED_FOLDER = Path(__file__).parent.parent / "evaluation" / "suite"

# Titles of the rows that are of no single maneuver.
ALL, DRAW = "all maneuvers", "random cases"


@dataclasses.dataclass(frozen=True)
class SuiteRow:
    """What one controller did in one maneuver, in all of them, or in a draw of cases; None: there is no such figure."""

    case: str
    by: str
    settling_time_s: float | None = None
    control_effort: float | None = None  # [N^2 m^2 s]
    end_error_deg: float | None = None
    success: float | None = None  # share of the maneuvers
    violated: float | None = None  # share of the maneuvers
    min_margin_deg: float | None = None
    decision_us: float | None = None
    planning_ms: float | None = None

    def cells(self) -> list[str]:
        """The row in text, in the order of ``COLUMNS``."""
        single = self.case not in (ALL, DRAW)
        return [
            self.case,
            self.by,
            *(_cell(figure, 2) for figure in (self.settling_time_s, self.control_effort)),
            _fixed(self.end_error_deg, 4),
            *(_share(share, single) for share in (self.success, self.violated)),
            _fixed(self.min_margin_deg, 2),
            *(_cell(figure, 1) for figure in (self.decision_us, self.planning_ms)),
        ]


COLUMNS = (
    "case",
    "controller",
    "settling time [s]",
    "effort [N² m² s]",
    "error at the end [deg]",
    "success",
    "violated",
    "smallest margin [deg]",
    "decision [us]",
    "planning [ms]",
)


def _cell(figure: float | None, decimals: int) -> str:
    return "-" if figure is None else significant(figure, decimals)


def _fixed(figure: float | None, decimals: int) -> str:
    return "-" if figure is None else f"{figure:.{decimals}f}"


def _share(share: float | None, single: bool) -> str:
    if share is None:
        return "-"
    return ("yes" if share else "no") if single else f"{100 * share:.2f} %"


class SuiteFlight(NamedTuple):
    """A row, and the maneuver that it is of, where there is one."""

    row: SuiteRow
    flown: FlownManeuver | None = None


def load_suite(folder: Path | str | None = None) -> dict[str, ManeuverConfig]:
    """Read the maneuver files of a folder, by the names of the files; by default those of the package.

    Raises:
        SettingsError: there is none, or one cannot be read.

    """
    found = sorted(Path(folder or PUBLISHED_FOLDER).glob("*.toml"))
    if not found:
        raise SettingsError(f"suite: must be a folder that holds maneuver files, *.toml; got {folder}")
    return {path.stem: load_maneuver(path) for path in found}


def label(name: str, under: Under) -> str:
    """What a controller under a filter is called in the table."""
    return name if under is None else f"{name} + {under}"


def labels(maneuvers: Mapping[str, ManeuverConfig], names: Sequence[str], filters: Sequence[Under]) -> Iterator[tuple]:
    """First two cells of all rows of ``fly_suite``, in their order."""
    flying = [label(name, under) for name in names for under in filters]
    for case, maneuver in maneuvers.items():
        yield from ((case, told.by) for told in [maneuver.published] if told is not None)
        yield from ((case, by) for by in flying)
    yield from ((title, by) for title in (ALL, DRAW) for by in flying)


def fly_suite(
    suite: Mapping[str, ManeuverConfig], names: Sequence[str], filters: Sequence[Under], draw: MonteCarloConfig | None
) -> Iterator[SuiteFlight]:
    """Fly everybody over all maneuvers, then over a draw of random cases of the paper's task; row by row.

    Args:
        suite: the maneuvers, by name.
        names: of agents and controllers, as ``koz_jax.fly`` takes them.
        filters: what each flies under in turn; None is nothing.
        draw: the random cases; None leaves them out.

    Raises:
        SettingsError: there is no such agent or controller, or a filter is not for the spacecraft of a maneuver.

    """
    flown: dict[str, list[SuiteRow]] = {}
    for case, maneuver in suite.items():
        if maneuver.published is not None:
            yield SuiteFlight(_told(case, maneuver))
        for name in names:
            flying = load_for(maneuver, name)
            for under in filters:
                flight = _fly(case, maneuver, flying, label(name, under), under)
                flown.setdefault(flight.row.by, []).append(flight.row)
                yield flight
    for name in names:
        for under in filters:
            rows = flown[label(name, under)]
            yield SuiteFlight(_worst(rows, named(name, TaskConfig()), under))
    if draw is not None:
        for name in names:
            for under in filters:
                yield SuiteFlight(_drawn(named(name, TaskConfig()), label(name, under), under, draw))


def _told(case: str, maneuver: ManeuverConfig) -> SuiteRow:
    """What others report."""
    told = maneuver.published
    assert told is not None
    return SuiteRow(
        case,
        told.by,
        settling_time_s=told.settling_seconds,
        control_effort=told.control_effort,
        end_error_deg=told.end_error_deg,
        min_margin_deg=told.min_margin_deg,
    )


def _fly(case: str, maneuver: ManeuverConfig, flying: TaskController, by: str, under: Under) -> SuiteFlight:
    """Fly one maneuver."""
    shield = None if under is None else filter_named(under)
    if shield is not None:
        shield.check(maneuver.task.spacecraft.brake_limits)
    config = maneuvers.config_of(maneuver, MonteCarloConfig(shield=shield))
    flown = maneuvers.fly_closely(flying, maneuvers.scenario(maneuver), maneuver.task, config)
    report = flown.report()
    row = SuiteRow(
        case,
        by,
        success=float(report["settled"] and not report["violated"]),
        violated=float(report["violated"]),
        **{name: report[name] for name in ("settling_time_s", "control_effort", "end_error_deg", "min_margin_deg")},
    )
    return SuiteFlight(row, flown)


def _worst(rows: Sequence[SuiteRow], flying: TaskController, under: Under) -> SuiteRow:
    """What all maneuvers come to, and how long deciding takes on the paper's task."""
    task, shield = TaskConfig(), None if under is None else filter_named(under)
    return SuiteRow(
        ALL,
        rows[0].by,
        end_error_deg=max(row.end_error_deg or 0.0 for row in rows),
        success=float(np.mean([row.success or 0.0 for row in rows])),
        violated=float(np.mean([row.violated or 0.0 for row in rows])),
        min_margin_deg=min((row.min_margin_deg for row in rows if row.min_margin_deg is not None), default=None),
        decision_us=timing.decision_us(flying.controller, task, shield),
        planning_ms=timing.planning_ms(flying.controller, task),
    )


def _drawn(flying: TaskController, by: str, under: Under, draw: MonteCarloConfig) -> SuiteRow:
    """Fly random cases of the paper's task."""
    config = draw.model_copy(update={"shield": None if under is None else filter_named(under)})
    summary = summarise(cases.fly_cases(flying.controller, TaskConfig(), config))
    figures = (summary.settling_time_mean, summary.control_effort_mean, summary.control_accuracy_deg_mean)
    settling, effort, error = (figure if np.isfinite(figure) else None for figure in figures)
    return SuiteRow(
        DRAW,
        by,
        settling_time_s=settling,
        control_effort=effort,
        end_error_deg=error,
        success=summary.success_rate,
        violated=summary.violation_rate,
        min_margin_deg=summary.min_margin_deg,
    )
