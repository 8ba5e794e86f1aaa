"""The boresight's trace on the unit sphere, with the keep-out zone and the shortest path."""

import numpy as np

from koz_jax.config.task import TaskConfig
from koz_jax.evaluation.rollout import History
from koz_jax.figures import geometry, palette, style
from koz_jax.figures.geometry import SphereTraces, View, Zone
from koz_jax.figures.style import Axes, Figure

_PIXELS = 800  # of the shaded sphere

_NOTE = "x, y, z: inertial axes; grid every 30°"
_DASHED = "; dashed: on the far side"


@style.look()
def draw(history: History, task: TaskConfig, title: str = "") -> Figure:
    """Draw the trace of one maneuver as the paper does: start a blue cross, end a green dot, zone red, trace black."""
    figure = style.new_figure(5.2, 6.3)
    axes = figure.add_subplot()
    traces = geometry.sphere_traces(history)
    draw_scene(axes, traces)
    draw_line(axes, traces.view, traces.trace_N, palette.TRACE, 1.8, "boresight trace")
    mark(axes, traces.view, traces.trace_N[0], "x", palette.START, "start")
    mark(axes, traces.view, traces.trace_N[-1], "o", palette.TARGET, f"end, after {task.episode_seconds:g} s")
    figure.suptitle(title)
    figure.legend(loc="outside lower center", ncols=2, handlelength=2.4)
    lines_N = [traces.trace_N, traces.shortest_N, *traces.circles_N]
    note = _NOTE + _DASHED * any(_is_dashed(traces.view, line_N) for line_N in lines_N)
    axes.text(0.5, -0.02, note, transform=axes.transAxes, ha="center", va="top", fontsize=7.5, color=palette.GREY)
    return figure


def draw_scene(axes: Axes, traces: SphereTraces, pixels: int = _PIXELS) -> None:
    """Draw what does not depend on who flies: the sphere, its grid and axes, the zones, the shortest path."""
    picture = sphere_picture(traces.view, traces.zones, pixels)
    axes.imshow(picture, extent=(-1.0, 1.0, -1.0, 1.0), interpolation="bilinear", zorder=0)
    turn = np.linspace(0.0, 2.0 * np.pi, 361)
    axes.plot(np.cos(turn), np.sin(turn), color=palette.GREY, linewidth=0.8, zorder=1)
    for line in geometry.graticule():
        front, _ = geometry.front_and_back(traces.view.project(line))
        axes.plot(*front.T, color="#9A9A9A", linewidth=0.4, zorder=1)
    _draw_axes_of_space(axes, traces.view)
    for name, zone, circle in zip(geometry.zone_names(traces.zones), traces.zones, traces.circles_N, strict=True):
        draw_line(axes, traces.view, circle, palette.ZONE, 1.8, f"{name}, {zone.size}")
        if zone.last_axis_N is not None:
            last = geometry.zone_circle(Zone(zone.last_axis_N, zone.half_angle))
            draw_line(axes, traces.view, last, palette.ZONE, 0.9, f"{name} at the end")
        if len(traces.zones) > 1:
            _number_zone(axes, traces.view, zone, name.removeprefix("zone "))
    label = f"shortest path ({np.rad2deg(traces.deviation):.0f}° rotation)"
    draw_line(axes, traces.view, traces.shortest_N, palette.SHORTEST, 1.4, label)
    axes.set(xlim=(-1.13, 1.13), ylim=(-1.13, 1.13), aspect="equal")
    axes.set_axis_off()


def sphere_picture(view: View, zones: list[Zone], pixels: int) -> np.ndarray:
    """Colours of a lit sphere with its zones tinted.  Returns (pixels, pixels, 4) in [0, 1]."""
    directions_N = view.sphere_directions(pixels)
    is_sphere = np.isfinite(directions_N[..., 0])
    directions_N = np.nan_to_num(directions_N)
    light_N = np.array([-0.35, 0.45, 0.82]) @ view.axes_N
    shade = np.clip(0.82 + 0.18 * directions_N @ light_N, 0.0, 1.0)
    colour = shade[..., None] * np.array([0.97, 0.98, 1.0])
    for zone in zones:
        tint = 0.35 * geometry.inside(directions_N, zone)[..., None]
        colour = (1.0 - tint) * colour + tint * np.array([0.835, 0.369, 0.0])
    return np.concatenate([colour, is_sphere[..., None].astype(float)], axis=-1)


def draw_line(axes: Axes, view: View, line_N: np.ndarray, color: str, width: float, label: str) -> None:
    """Draw a line on the sphere; what lies on the far side is thin, dashed and faint.  line_N: (n, 3)."""
    front, back = geometry.front_and_back(view.project(line_N))
    axes.plot(*back.T, color=color, linewidth=0.6 * width, alpha=0.45, linestyle=(0, (3, 2)), zorder=2)
    axes.plot(*front.T, color=color, linewidth=width, label=label, zorder=3)


def _is_dashed(view: View, line_N: np.ndarray) -> bool:
    """Whether ``draw_line`` dashes any of a line."""
    return bool(np.isfinite(geometry.front_and_back(view.project(line_N))[1]).any())


def _number_zone(axes: Axes, view: View, zone: Zone, number: str) -> None:
    """Write a zone's number where most of the zone is seen; faint if all of it is on the far side."""
    shares = np.linspace(0.0, 1.0, 9)
    inside = np.concatenate([geometry.zone_circle(Zone(zone.axis_N, share * zone.half_angle), 37) for share in shares])
    seen = view.project(inside)
    is_front = seen[:, 2] >= 0.0
    right, up = seen[is_front if is_front.any() else slice(None), :2].mean(axis=0)
    text = axes.text(right, up, number, ha="center", va="center", fontsize=11, fontweight="bold", color="#7A3500")
    text.set(alpha=1.0 if is_front.any() else 0.45, zorder=6)
    text.set_path_effects([style.halo()])


def mark(axes: Axes, view: View, point_N: np.ndarray, marker: str, color: str, label: str) -> None:
    """Mark a direction; faint on the far side.  point_N: (3,)."""
    right, up, depth = view.project(point_N)
    alpha = 1.0 if depth >= 0.0 else 0.45
    width = 2.4 if marker == "x" else 0.8
    edge = color if marker == "x" else "white"
    axes.plot(
        right,
        up,
        marker,
        color=color,
        markeredgecolor=edge,
        markersize=9.0,
        markeredgewidth=width,
        alpha=alpha,
        label=label,
        zorder=5,
    )


def _draw_axes_of_space(axes: Axes, view: View) -> None:
    """Draw the inertial axes, from the sphere's surface outwards."""
    for name, axis_N in zip("xyz", np.eye(3), strict=True):
        right, up, depth = view.project(axis_N)
        color, zorder = (palette.BLACK, 4) if depth >= 0.0 else (palette.GREY, -1)
        stem = np.array([1.0, 1.08])
        axes.plot(right * stem, up * stem, color=color, linewidth=0.9, zorder=zorder)
        axes.text(1.13 * right, 1.13 * up, name, color=color, style="italic", ha="center", va="center", zorder=zorder)
