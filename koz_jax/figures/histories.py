"""Time histories of a maneuver: attitude error, body rates, torque, margin to the keep-out zone.

The turn has the wide column; what comes long after settling has a narrow one beside it, at scales of its own.
"""

import dataclasses

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.figures import geometry, palette, style, wording
from koz_jax.figures.style import Axes, Figure

# The turn is shown until so many settling times, and at least so many steps.
_SHOWN_SETTLING_TIMES = 1.3
_LEAST_STEPS = 10

# A hold of less than this share of the maneuver has no column of its own.
_LEAST_HOLD = 0.1


@dataclasses.dataclass(frozen=True)
class _Curve:
    """One line of a panel."""

    label: str
    color: str
    values: np.ndarray  # (steps + 1,)


@dataclasses.dataclass(frozen=True)
class _Panel:
    """One quantity over time, in the unit of its axis."""

    label: str
    curves: list[_Curve]
    least_span: float  # of the hold's scale: what is smaller is noise
    is_held: bool = False  # constant over a step
    bounds: tuple[tuple[float, str], ...] = ()  # dashed lines at plus and minus a value, and their colours
    is_margin: bool = False


def turn_seconds(result: CaseResult, task: TaskConfig) -> float:
    """How much of the maneuver the wide column shows: until soon after settling, or everything [s]."""
    whole = task.episode_seconds
    if not result.settled:
        return whole
    end = max(_SHOWN_SETTLING_TIMES * float(result.settling_time), _LEAST_STEPS * task.step_seconds)
    return end if end <= (1.0 - _LEAST_HOLD) * whole else whole


@style.look()
def draw(history: History, result: CaseResult, task: TaskConfig, title: str = "") -> Figure:
    """Draw the four panels of the paper over time; a dotted line marks the settling time, if there is one.

    The first four axes of the figure show the turn.  Where the maneuver settles, four more show the hold that follows.
    """
    end, seconds = turn_seconds(result, task), np.arange(len(history.zone_margin)) * task.step_seconds
    panels = [_attitude(history), _rates(history), _torque(history, task), _margin(history)]
    holds = end < task.episode_seconds
    figure = style.new_figure(7.4, 7.2)
    grid = figure.add_gridspec(len(panels), 1 + holds, width_ratios=[2.6, 1.0] if holds else [1.0])
    turns: list[Axes] = []
    for row, panel in enumerate(panels):
        axes = figure.add_subplot(grid[row, 0], sharex=turns[0] if row else None)
        _draw_turn(axes, panel, seconds)
        turns.append(axes)
    turns[0].set_xlim(0.0, end)
    _finish_column(turns)
    if result.settled:
        _mark_settling(turns, float(result.settling_time))
    if holds:
        _draw_holds([figure.add_subplot(grid[row, 1]) for row in range(len(panels))], panels, seconds, end)
    # Beside the panels, where no data are.
    for axes, left in zip(figure.axes[-len(panels) :], turns, strict=True):
        handles, labels = left.get_legend_handles_labels()
        if handles:
            axes.legend(handles, labels, loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)
    figure.suptitle(title)
    figure.align_ylabels(turns)
    return figure


def _attitude(history: History) -> _Panel:
    q_e = np.asarray(history.attitude_error)
    colors = (palette.BLACK, *palette.BODY_AXES)
    curves = [_Curve(f"$q_{{e{i}}}$", color, q_e[:, i]) for i, color in enumerate(colors)]
    return _Panel("attitude error $q_e$ [-]", curves, 2e-5)


def _rates(history: History) -> _Panel:
    omega_deg = np.rad2deg(history.state.body.omega_BN_B).T
    named = zip("xyz", palette.BODY_AXES, omega_deg, strict=True)
    return _Panel(
        "body rate [deg/s]", [_Curve(rf"$\omega_{name}$", color, values) for name, color, values in named], 2e-4
    )


def _torque(history: History, task: TaskConfig) -> _Panel:
    limits = task.spacecraft.torque_limits
    unit = wording.torque_unit(limits)
    named = zip("xyz", palette.BODY_AXES, unit.factor * np.asarray(history.torque_B).T, strict=True)
    curves = [_Curve(rf"$\tau_{name}$", color, values) for name, color, values in named]
    # One line for axes with the same limit; where they differ, each has the colour of its axis.
    colors = (palette.GREY,) if len({*limits}) == 1 else palette.BODY_AXES
    bounds = tuple((unit.factor * limit, color) for limit, color in zip(limits, colors, strict=False))
    return _Panel(f"torque [{unit.name}]", curves, 2e-4 * unit.factor * max(limits), is_held=True, bounds=bounds)


def _margin(history: History) -> _Panel:
    margin_deg = np.rad2deg(history.zone_margin)
    curves = [_Curve(r"$\theta_\mathrm{margin}$", palette.TRACE, margin_deg)] if geometry.zones(history) else []
    return _Panel(r"$\theta_\mathrm{margin}$ [deg]", curves, 0.02, is_margin=True)


def _draw_turn(axes: Axes, panel: _Panel, seconds: np.ndarray) -> None:
    axes.set_ylabel(panel.label)
    if not panel.curves:
        axes.text(0.5, 0.5, "no keep-out zone in this case", transform=axes.transAxes, ha="center", va="center")
        axes.set_yticks([])
        return
    _draw_curves(axes, panel, panel.curves, seconds)
    if panel.bounds:
        largest = max(bound for bound, _ in panel.bounds)
        axes.set_ylim(-1.15 * largest, 1.15 * largest)
    if panel.is_margin:
        margin_deg = panel.curves[0].values
        low, high = min(-0.12 * margin_deg.max(), 1.25 * margin_deg.min()), max(margin_deg.max(), 0.0)
        axes.set_ylim(low, high + 0.05 * (high - low))


def _draw_curves(axes: Axes, panel: _Panel, curves: list[_Curve], seconds: np.ndarray) -> None:
    """Draw curves from their last ``len(seconds)`` values on, with what a panel's values are compared with."""
    how = {"drawstyle": "steps-post", "linewidth": 1.0} if panel.is_held else {}
    for curve in curves:
        axes.plot(seconds, curve.values[-len(seconds) :], color=curve.color, label=curve.label, **how)
    for number, (bound, color) in enumerate(panel.bounds):
        for sign in (-1.0, 1.0):
            label = "limit" if number == 0 and sign > 0.0 else None
            axes.axhline(sign * bound, color=color, linewidth=0.8, linestyle="--", zorder=1, label=label)
    if panel.is_margin:
        axes.axhspan(-180.0, 0.0, color=palette.ZONE, alpha=0.18, linewidth=0, label="inside the\nzone")
        axes.axhline(0.0, color=palette.ZONE, linewidth=1.0, zorder=1)
    style.value_ticks(axes.yaxis)


def _draw_holds(column: list[Axes], panels: list[_Panel], seconds: np.ndarray, begin: float) -> None:
    shown = seconds[seconds >= begin]
    for axes, panel in zip(column, panels, strict=True):
        if not panel.curves:
            axes.set_axis_off()
            continue
        # The first of the attitude error is 1 while the others are small.
        curves = panel.curves[1:] if len(panel.curves) == 4 else panel.curves
        _draw_curves(axes, panel, curves, shown)
        values = np.stack([curve.values[-len(shown) :] for curve in curves])
        middle, span = 0.5 * (values.min() + values.max()), max(float(np.ptp(values)), panel.least_span)
        axes.set_ylim(middle - 0.6 * span, middle + 0.6 * span)
        style.value_ticks(axes.yaxis, 4)
        axes.set_xlim(begin, seconds[-1])
    column[0].set_title("hold, at scales of its own", fontsize=8)
    _finish_column([axes for axes in column if axes.axison])


def _finish_column(column: list[Axes]) -> None:
    for axes in column[:-1]:
        axes.tick_params(labelbottom=False)
    for axes in column:
        style.value_ticks(axes.xaxis)
    column[-1].set_xlabel("time [s]")


def _mark_settling(column: list[Axes], settled: float) -> None:
    for axes in column:
        axes.axvline(settled, color=palette.GREY, linewidth=0.9, linestyle=":", zorder=1)
    column[0].annotate(
        f"settled: {settled:.1f} s",
        (settled, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(3, 2),
        textcoords="offset points",
        fontsize=8,
        ha="center",
        color="#4D4D4D",
    )
