"""Figures of a Monte Carlo: every case as a point, coloured by how it ended."""

import dataclasses
from pathlib import Path
from typing import Literal

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.figures import palette, style, wording
from koz_jax.figures.style import Axes, Figure


@dataclasses.dataclass(frozen=True)
class Verdict:
    """How cases ended, and how they are drawn: colour and shape both tell."""

    name: str
    color: str
    marker: str
    size: float  # [points^2]


SETTLED = Verdict("settled, zone kept", palette.BLUE, "o", 5.0)
VIOLATED = Verdict("zone violated", palette.PURPLE, "^", 16.0)
NOT_SETTLED = Verdict("not settled", palette.ORANGE, "s", 16.0)
VERDICTS = (SETTLED, VIOLATED, NOT_SETTLED)


@dataclasses.dataclass(frozen=True)
class Points:
    """What is drawn of each case; arrays (cases,)."""

    reward: np.ndarray
    settling_time: np.ndarray  # [s]; ``beyond`` where the case did not settle
    control_effort: np.ndarray  # [N^2 m^2 s]
    accuracy_deg: np.ndarray  # phi at the end [deg]
    settled: np.ndarray  # bool
    verdict: np.ndarray  # index into ``VERDICTS``
    violated_unsettled: int  # cases with both faults: they count, and are drawn, as violated
    times: tuple[float, float]  # [s] the settling times are within

    @property
    def beyond(self) -> float:
        """Where on the axis of settling times the cases are that have none, past its break [s]."""
        return self.times[1] + _STRIP * (self.times[1] - self.times[0])

    def of(self, verdict: Verdict) -> np.ndarray:
        """Which cases ended so.  Returns (cases,) bool."""
        return self.verdict == VERDICTS.index(verdict)


# Of the range of settling times: how far past its end the cases are drawn that have none.
_STRIP = 0.14


def points(results: CaseResult, task: TaskConfig) -> Points:
    """Compute what is drawn.  results: NumPy leaves (cases,)."""
    settled, violated = np.asarray(results.settled), np.asarray(results.violated)
    failed = np.where(violated, VERDICTS.index(VIOLATED), VERDICTS.index(NOT_SETTLED))
    times = np.asarray(results.settling_time)[settled]
    low, high = (float(times.min()), float(times.max())) if times.size else (0.0, task.episode_seconds)
    shown = Points(
        reward=np.asarray(results.reward),
        settling_time=np.asarray(results.settling_time),
        control_effort=np.asarray(results.control_effort),
        # A logarithmic axis has no place for an exact zero.
        accuracy_deg=np.maximum(np.rad2deg(results.control_accuracy), 1e-6),
        settled=settled,
        verdict=np.where(settled & ~violated, VERDICTS.index(SETTLED), failed),
        violated_unsettled=int(np.sum(violated & ~settled)),
        times=(low, max(high, low + 10.0 * task.step_seconds)),
    )
    return dataclasses.replace(shown, settling_time=np.where(settled, shown.settling_time, shown.beyond))


def write(folder: Path, results: CaseResult, task: TaskConfig, title: str = "") -> list[Path]:
    """Write all Monte Carlo figures.  Returns the files."""
    shown = points(results, task)
    figures = {
        "monte-carlo-samples": draw_samples(shown, title),
        "monte-carlo-relations": draw_relations(shown, title),
        "monte-carlo-accuracy": draw_accuracy(shown, task.reward.settled_angle_deg, title),
    }
    return [path for name, figure in figures.items() for path in style.save(figure, folder, name)]


@style.look()
def draw_samples(shown: Points, title: str = "") -> Figure:
    """Draw reward, settling time and control effort against the sample number."""
    figure = style.new_figure(6.8, 7.0)
    panels = figure.subplots(3, 1, sharex=True)
    numbers = np.arange(len(shown.reward))
    for axes, (label, values) in zip(panels, _metrics(shown).items(), strict=True):
        _scatter(axes, numbers, values, shown)
        axes.set_ylabel(label)
        style.value_ticks(axes.yaxis, 6)
    _break_off_unsettled(panels[1], shown, "y")
    panels[2].set(xlabel="sample number [-]", xlim=(-0.01 * len(numbers), 1.01 * len(numbers)))
    _finish(figure, shown, title)
    return figure


@style.look()
def draw_relations(shown: Points, title: str = "") -> Figure:
    """Draw each two of reward, settling time and control effort against each other."""
    figure = style.new_figure(9.6, 3.7)
    (reward, rewards), (time, times), (effort, efforts) = _metrics(shown).items()
    pairs = [(time, times, reward, rewards), (time, times, effort, efforts), (effort, efforts, reward, rewards)]
    for axes, (xlabel, x, ylabel, y) in zip(figure.subplots(1, 3), pairs, strict=True):
        _scatter(axes, x, y, shown)
        axes.set(xlabel=xlabel, ylabel=ylabel)
        style.value_ticks(axes.xaxis)
        style.value_ticks(axes.yaxis, 6)
        if x is times:
            _break_off_unsettled(axes, shown, "x")
    _finish(figure, shown, title)
    return figure


@style.look()
def draw_accuracy(shown: Points, limit_deg: float, title: str = "") -> Figure:
    """Draw the pointing error at the end: all cases, then the settled ones with the accuracy that is asked for."""
    figure = style.new_figure(6.8, 5.6)
    everything, settled_only = figure.subplots(2, 1, sharex=True)
    numbers = np.arange(len(shown.reward))
    _scatter(everything, numbers, shown.accuracy_deg, shown)
    everything.set_title("all cases")
    _scatter(settled_only, numbers, shown.accuracy_deg, shown, shown.settled)
    settled_only.set(title="settled cases", xlabel="sample number [-]")
    settled_only.set_xlim(-0.01 * len(numbers), 1.01 * len(numbers))
    for axes in (everything, settled_only):
        axes.set(ylabel=r"pointing error $\varphi$ at the end [deg]", yscale="log")
        label = f"accuracy asked for, {limit_deg:g} deg" if axes is everything else None
        axes.axhline(limit_deg, color=palette.BLACK, linewidth=1.0, linestyle="--", label=label)
        style.decade_ticks(axes.yaxis)
    _finish(figure, shown, title)
    return figure


def _metrics(shown: Points) -> dict[str, np.ndarray]:
    unit = wording.effort_unit(float(np.max(shown.control_effort, initial=0.0)))
    return {
        "reward [-]": shown.reward,
        "settling time [s]": shown.settling_time,
        f"control effort [{unit.name}]": unit.factor * shown.control_effort,
    }


def _scatter(axes: Axes, x: np.ndarray, y: np.ndarray, shown: Points, chosen: np.ndarray | None = None) -> None:
    """Draw cases as points.  Many are drawn fainter; all as one picture, which keeps a PDF small."""
    chosen = np.ones(len(x), bool) if chosen is None else chosen
    kinds = [(verdict, shown.of(verdict) & chosen) for verdict in VERDICTS]
    # The rarest are drawn last, on top.
    for order, (verdict, drawn) in enumerate(sorted(kinds, key=lambda kind: -int(kind[1].sum()))):
        count = int(drawn.sum())
        axes.scatter(
            x[drawn],
            y[drawn],
            s=verdict.size if count < 1000 else 5.0,
            c=verdict.color,
            marker=verdict.marker,
            alpha=float(np.clip(3000.0 / max(count, 1), 0.3, 0.9)),
            linewidths=0.0,
            rasterized=True,
            zorder=2 + order,
        )


def _break_off_unsettled(axes: Axes, shown: Points, which: Literal["x", "y"]) -> None:
    """Break the axis of settling times where these end, and name the strip behind: cases that never settled."""
    if shown.settled.all():
        return
    (low, high), span = shown.times, shown.times[1] - shown.times[0]
    edge, end = high + 0.5 * _STRIP * span, high + 1.5 * _STRIP * span
    axis = axes.yaxis if which == "y" else axes.xaxis
    ticks = [tick for tick in axis.get_major_locator().tick_values(low, high) if low - 0.05 * span <= tick < edge]
    axis.set_ticks([*ticks, shown.beyond], [*(f"{tick:g}" for tick in ticks), "never"])
    axes.set(**{f"{which}lim": (low - 0.05 * span, end)})
    (axes.axhspan if which == "y" else axes.axvspan)(edge, end, color=palette.GREY, alpha=0.12, linewidth=0, zorder=0)
    # Two strokes across the axis, as where paper is torn.
    place = (edge - low + 0.05 * span) / (end - low + 0.05 * span)
    for shift in (-0.012, 0.012):
        at = np.array([place - 0.01 + shift, place + 0.01 + shift]), np.array([-0.012, 0.012])
        x, y = at if which == "x" else at[::-1]
        axes.plot(x, y, transform=axes.transAxes, color=palette.BLACK, linewidth=0.8, clip_on=False, zorder=5)


def _finish(figure: Figure, shown: Points, title: str) -> None:
    """Add title and legend; the legend counts, and stands below the panels."""
    handles, _ = figure.axes[0].get_legend_handles_labels()
    for verdict in VERDICTS:
        count = int(shown.of(verdict).sum())
        label = f"{verdict.name}: {count} ({100.0 * count / len(shown.reward):.2f} %)"
        if verdict is VIOLATED and shown.violated_unsettled:
            label += f", {shown.violated_unsettled} of them not settled"
        shape = style.Line2D(
            [], [], linestyle="", marker=verdict.marker, color=verdict.color, markersize=6, label=label
        )
        handles.insert(VERDICTS.index(verdict), shape)
    figure.suptitle(title)
    # Three beside each other where they have room.
    columns = 3 if len(handles) == 3 and (figure.get_figwidth() > 8.0 or not shown.violated_unsettled) else 2
    figure.legend(handles=handles, loc="outside lower center", ncols=columns)
    figure.align_ylabels()
