"""Time histories of a maneuver: attitude error, body rates, torque, margin to the keep-out zone."""

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.figures import geometry, palette, style
from koz_jax.figures.style import Axes, Figure


@style.look()
def draw(history: History, result: CaseResult, task: TaskConfig, title: str = "") -> Figure:
    """Draw the four panels of the paper over time; a dotted line marks the settling time, if there is one."""
    figure = style.new_figure(6.6, 7.2)
    panels = figure.subplots(4, 1, sharex=True)
    seconds = np.arange(len(history.zone_margin)) * task.step_seconds
    _draw_attitude(panels[0], seconds, history)
    _draw_rates(panels[1], seconds, history)
    _draw_torque(panels[2], seconds, history, task)
    _draw_margin(panels[3], seconds, history)
    panels[3].set(xlabel="time [s]", xlim=(0.0, seconds[-1]))
    if result.settled:
        settled = float(result.settling_time)
        for axes in panels:
            axes.axvline(settled, color=palette.GREY, linewidth=0.9, linestyle=":", zorder=1)
        panels[0].annotate(
            f"settled: {settled:.1f} s",
            (settled, 1.0),
            xycoords=("data", "axes fraction"),
            xytext=(3, 2),
            textcoords="offset points",
            fontsize=8,
            color="#4D4D4D",
        )
    figure.suptitle(title)
    figure.align_ylabels()
    return figure


def _legend(axes: Axes) -> None:
    """Beside the panel, where no data are."""
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.4)


def _draw_attitude(axes: Axes, seconds: np.ndarray, history: History) -> None:
    q_e = np.asarray(history.attitude_error)
    for i, color in enumerate((palette.BLACK, *palette.BODY_AXES)):
        axes.plot(seconds, q_e[:, i], color=color, label=f"$q_{{e{i}}}$")
    axes.set(ylabel="attitude error $q_e$ [-]", ylim=(-1.08, 1.08))
    _legend(axes)


def _draw_rates(axes: Axes, seconds: np.ndarray, history: History) -> None:
    omega_deg = np.rad2deg(history.state.body.omega_BN_B)
    for name, values, color in zip("xyz", omega_deg.T, palette.BODY_AXES, strict=True):
        axes.plot(seconds, values, color=color, label=rf"$\omega_{name}$")
    axes.set_ylabel("body rate [deg/s]")
    _legend(axes)


def _draw_torque(axes: Axes, seconds: np.ndarray, history: History, task: TaskConfig) -> None:
    limits = task.spacecraft.torque_limits
    for name, values, color in zip("xyz", np.asarray(history.torque_B).T, palette.BODY_AXES, strict=True):
        # The torque is held over a step.
        axes.plot(seconds, values, color=color, linewidth=1.0, drawstyle="steps-post", label=rf"$\tau_{name}$")
    # One line for axes with the same limit; where they differ, each has the colour of its axis.
    bounds = {limits[0]: palette.GREY} if len({*limits}) == 1 else dict(zip(limits, palette.BODY_AXES, strict=True))
    for limit, color in bounds.items():
        for bound in (-limit, limit):
            label = "limit" if bound == limits[0] else None
            axes.axhline(bound, color=color, linewidth=0.8, linestyle="--", zorder=1, label=label)
    axes.set(ylabel="torque [N m]", ylim=(-1.15 * max(limits), 1.15 * max(limits)))
    _legend(axes)


def _draw_margin(axes: Axes, seconds: np.ndarray, history: History) -> None:
    axes.set_ylabel(r"$\theta_\mathrm{margin}$ [deg]")
    if not geometry.zones(history):
        axes.text(0.5, 0.5, "no keep-out zone in this case", transform=axes.transAxes, ha="center", va="center")
        return
    margin_deg = np.rad2deg(history.zone_margin)
    low = min(-0.12 * margin_deg.max(), 1.25 * margin_deg.min())
    axes.plot(seconds, margin_deg, color=palette.TRACE, label=r"$\theta_\mathrm{margin}$")
    axes.axhspan(low, 0.0, color=palette.ZONE, alpha=0.18, linewidth=0, label="inside the\nzone")
    axes.axhline(0.0, color=palette.ZONE, linewidth=1.0, zorder=1)
    axes.set_ylim(low, None)
    _legend(axes)
