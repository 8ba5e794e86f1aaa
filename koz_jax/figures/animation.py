"""A maneuver as a short moving picture (GIF)."""

import io
from pathlib import Path

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.rollout import CaseResult, History
from koz_jax.figures import geometry, palette, sphere, style, wording
from koz_jax.figures.style import Axes
from koz_jax.storage import files

_SPEED = 2.5  # maneuver seconds per second of the picture
_FRAMES_PER_SECOND = 12.5  # browsers keep to multiples of 10 ms
_REST_S = 1.5  # how long the last frame stays [s]
_AFTER_SETTLING_S = 3.0  # of the maneuver
_COLOURS = 255
_DPI = 110
_MAX_FRAMES = 250  # a longer maneuver is shown faster


def shown_instants(history: History, result: CaseResult, task: TaskConfig) -> np.ndarray:
    """Which steps of the history become frames: until shortly after settling, or all.  Returns (frames,) int."""
    last = len(history.zone_margin) - 1
    if result.settled:
        last = min(last, round((float(result.settling_time) + _AFTER_SETTLING_S) / task.step_seconds))
    stride = max(1, round(_SPEED / _FRAMES_PER_SECOND / task.step_seconds), -(-last // _MAX_FRAMES))
    return np.unique(np.append(np.arange(0, last + 1, stride), last))


def write(path: Path, history: History, result: CaseResult, task: TaskConfig, title: str = "") -> Path:
    """Write the moving picture of one maneuver."""
    files.write_bytes(path, gif(history, result, task, title))
    return path


@style.look()
def gif(history: History, result: CaseResult, task: TaskConfig, title: str = "") -> bytes:
    """Draw the trace as it grows, beside margin and torque as they come."""
    from PIL import Image

    instants = shown_instants(history, result, task)
    scene = _Scene(history, task, float(instants[-1] * task.step_seconds), title)
    # One palette for all frames, and no dithering, so that what stands still costs nothing.
    ends = np.concatenate([scene.at(instants[0]), scene.at(instants[-1])])
    palette = Image.fromarray(ends).quantize(_COLOURS)
    frames = [Image.fromarray(scene.at(i)).quantize(palette=palette, dither=Image.Dither.NONE) for i in instants]
    milliseconds = [round(1000 / _FRAMES_PER_SECOND)] * (len(frames) - 1) + [round(1000 * _REST_S)]
    content = io.BytesIO()
    frames[0].save(
        content, "gif", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, optimize=True
    )
    return content.getvalue()


class _Scene:
    """A figure whose moving parts are set to any instant."""

    def __init__(self, history: History, task: TaskConfig, end: float, title: str) -> None:
        self.traces = geometry.sphere_traces(history)
        self.seconds = np.arange(len(history.zone_margin)) * task.step_seconds
        self.margin_deg = np.rad2deg(history.zone_margin)
        self.unit = wording.torque_unit(task.spacecraft.torque_limits)
        self.torque = self.unit.factor * np.asarray(history.torque_B)
        self.projected = self.traces.view.project(self.traces.trace_N)
        self.figure = style.new_figure(7.6, 4.1)
        grid = self.figure.add_gridspec(2, 2, width_ratios=[1.1, 1.0])
        self._draw_sphere(self.figure.add_subplot(grid[:, 0]))
        self.margin_line = self._draw_margin(self.figure.add_subplot(grid[0, 1]), end)
        self.torque_lines = self._draw_torque(
            self.figure.add_subplot(grid[1, 1]), end, self.unit.factor * max(task.spacecraft.torque_limits)
        )
        handles, labels = self.figure.axes[0].get_legend_handles_labels()
        self.figure.legend(handles, labels, loc="outside lower center", ncols=5, handlelength=1.6, columnspacing=1.2)
        self.figure.suptitle(title)
        self.figure.set_dpi(_DPI)
        self.canvas = style.FigureCanvasAgg(self.figure)
        self.moving = [self.back, self.front, self.dot, self.clock, self.margin_line, *self.torque_lines]
        for part in self.moving:
            part.set_animated(True)
        # What stands still is drawn once: most of the time would go there.
        self.canvas.draw()
        self.still = self.canvas.copy_from_bbox(self.figure.bbox)

    def _draw_sphere(self, axes: Axes) -> None:
        sphere.draw_scene(axes, self.traces, pixels=400)
        sphere.mark(axes, self.traces.view, self.traces.trace_N[0], "x", palette.START, "start")
        sphere.mark(axes, self.traces.view, self.traces.shortest_N[-1], "o", palette.TARGET, "target")
        (self.back,) = axes.plot(
            [], [], color=palette.TRACE, linewidth=1.2, alpha=0.45, linestyle=(0, (3, 2)), zorder=2
        )
        (self.front,) = axes.plot([], [], color=palette.TRACE, linewidth=2.2, zorder=4, label="boresight trace")
        self.clock = axes.text(0.0, 1.0, "", transform=axes.transAxes, va="top", fontsize=11)
        (self.dot,) = axes.plot([], [], "o", color=palette.TRACE, markersize=5.5, zorder=6)

    def _draw_margin(self, axes: Axes, end: float) -> style.Line2D:
        low, high = min(0.0, float(self.margin_deg.min())), float(self.margin_deg.max())
        axes.set(xlim=(0.0, end), ylim=(1.2 * low - 0.1 * high, 1.08 * high), ylabel="margin to zone [deg]")
        if self.traces.zones:
            axes.axhspan(1.2 * low - 0.1 * high, 0.0, color=palette.ZONE, alpha=0.2, linewidth=0)
            axes.axhline(0.0, color=palette.ZONE, linewidth=1.2)
        return axes.plot([], [], color=palette.TRACE, linewidth=1.6)[0]

    def _draw_torque(self, axes: Axes, end: float, limit: float) -> list[style.Line2D]:
        axes.set(
            xlim=(0.0, end), ylim=(-1.1 * limit, 1.1 * limit), xlabel="time [s]", ylabel=f"torque [{self.unit.name}]"
        )
        lines = [
            axes.plot([], [], color=color, linewidth=1.3, drawstyle="steps-post", label=name)[0]
            for name, color in zip("xyz", palette.BODY_AXES, strict=True)
        ]
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=1.0)
        return lines

    def at(self, instant: int) -> np.ndarray:
        """Draw one instant.  Returns (height, width, 3) uint8."""
        upto = slice(0, instant + 1)
        front, back = geometry.front_and_back(self.projected[upto])
        self.front.set_data(*front.T)
        self.back.set_data(*back.T)
        here = self.projected[instant]
        self.dot.set_data([here[0]], [here[1]])
        self.dot.set_alpha(1.0 if here[2] >= 0.0 else 0.45)
        self.margin_line.set_data(self.seconds[upto], self.margin_deg[upto])
        for line, values in zip(self.torque_lines, self.torque[upto].T, strict=True):
            line.set_data(self.seconds[upto], values)
        self.clock.set_text(f"{self.seconds[instant]:.1f} s")
        self.canvas.restore_region(self.still)
        for part in self.moving:
            part.axes.draw_artist(part)
        return np.asarray(self.canvas.buffer_rgba())[..., :3].copy()
