"""Figures of a Monte Carlo: every case as a point, coloured by how it ended."""

import dataclasses
from pathlib import Path

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.rollout import CaseResult
from koz_jax.figures import palette, style
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
    settling_time: np.ndarray  # [s]; ``not_settled_at`` where the case did not settle
    control_effort: np.ndarray  # [N^2 m^2 s]
    accuracy_deg: np.ndarray  # phi at the end [deg]
    settled: np.ndarray  # bool
    verdict: np.ndarray  # index into ``VERDICTS``
    violated_unsettled: int  # cases with both faults: they count, and are drawn, as violated
    not_settled_at: float  # [s]

    def of(self, verdict: Verdict) -> np.ndarray:
        """Which cases ended so.  Returns (cases,) bool."""
        return self.verdict == VERDICTS.index(verdict)


def points(results: CaseResult, task: TaskConfig) -> Points:
    """Compute what is drawn.  results: NumPy leaves (cases,).

    Cases that did not settle are put at twice the maneuver's length: at 200 s for the paper's 100 s.
    """
    settled, violated = np.asarray(results.settled), np.asarray(results.violated)
    not_settled_at = 2.0 * task.episode_seconds
    failed = np.where(violated, VERDICTS.index(VIOLATED), VERDICTS.index(NOT_SETTLED))
    return Points(
        reward=np.asarray(results.reward),
        settling_time=np.where(settled, results.settling_time, not_settled_at),
        control_effort=np.asarray(results.control_effort),
        # A logarithmic axis has no place for an exact zero.
        accuracy_deg=np.maximum(np.rad2deg(results.control_accuracy), 1e-6),
        settled=settled,
        verdict=np.where(settled & ~violated, VERDICTS.index(SETTLED), failed),
        violated_unsettled=int(np.sum(violated & ~settled)),
        not_settled_at=not_settled_at,
    )


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
    _name_not_settled(panels[1], shown)
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
    _finish(figure, shown, title)
    return figure


def _metrics(shown: Points) -> dict[str, np.ndarray]:
    return {
        "reward [-]": shown.reward,
        "settling time [s]": shown.settling_time,
        "control effort [N² m² s]": shown.control_effort,
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


def _name_not_settled(axes: Axes, shown: Points) -> None:
    """Say on the axis of settling times that one of them is none."""
    if not shown.settled.all():
        axes.axhline(shown.not_settled_at, color=palette.GREY, linewidth=0.8, linestyle=":", zorder=1)
        note = f"did not settle: drawn at {shown.not_settled_at:g} s"
        axes.annotate(note, (0.0, shown.not_settled_at), xytext=(8, -11), textcoords="offset points", fontsize=7.5)


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
    figure.legend(handles=handles, loc="outside lower center", ncols=3 if len(handles) == 3 else 2)
    figure.align_ylabels()
