"""Time histories under a scene: margin to the zone, pointing error and torque, with a cursor at the instant shown."""

from typing import Any

import numpy as np

from koz_jax.figures import palette
from koz_jax.figures.palette import SCENE_AXES
from koz_jax.figures.wording import torque_unit
from koz_jax.viewer.maneuver import Clock, Frames, Maneuver, same_spacecraft
from koz_jax.viewer.rounding import rounded

# Where each row is, from below; its title stands above it.
_ROWS = {"margin": (0.74, 1.0), "error": (0.37, 0.63), "torque": (0.0, 0.26)}

_DECADES = (0.001, 0.01, 0.1, 1, 10, 100)
_TICK_SIZE = 11

# Below this the pointing error is not told apart from zero [deg].
_LEAST_ERROR_DEG = 1e-3


def timelines(maneuvers: list[Maneuver], shown: list[Frames], at: Clock) -> list[dict[str, Any]]:
    """A plotly figure per maneuver.  The cursor is the first shape of the layout.

    Maneuvers of one spacecraft have the same scales, those of different ones each their own.
    """
    if not same_spacecraft(maneuvers):
        return [_timelines([each], [frames], at)[0] for each, frames in zip(maneuvers, shown, strict=True)]
    return _timelines(maneuvers, shown, at)


def _timelines(maneuvers: list[Maneuver], shown: list[Frames], at: Clock) -> list[dict[str, Any]]:
    """The figures of one spacecraft, all to the same scales."""
    margins = np.concatenate([frames.margin_deg for frames in shown])
    errors = np.concatenate([frames.phi_deg for frames in shown])
    limits = maneuvers[0].task.spacecraft.torque_limits
    largest = max(limits) * torque_unit(limits).factor
    ranges = {
        "margin": _padded(min(0.0, float(margins.min())), max(0.0, float(margins.max()))),
        "error": np.log10([_LEAST_ERROR_DEG, 2.0 * max(float(errors.max()), 1.0)]).tolist(),
        "torque": _padded(-largest, largest),
    }
    return [_timeline(maneuver, frames, at, ranges) for maneuver, frames in zip(maneuvers, shown, strict=True)]


def _padded(low: float, high: float) -> list[float]:
    pad = 0.06 * (high - low) or 1.0
    return [low - pad, high + pad]


def _timeline(maneuver: Maneuver, frames: Frames, at: Clock, ranges: dict[str, list[float]]) -> dict[str, Any]:
    errors = np.maximum(frames.phi_deg, _LEAST_ERROR_DEG)
    data = [
        _line("margin to the zone", at, frames.margin_deg, "y", palette.TRACE, "%{y:.2f}°"),
        _line("pointing error", at, errors, "y2", palette.SHORTEST, "%{y:.3f}°"),
    ]
    unit = torque_unit(maneuver.task.spacecraft.torque_limits)
    for axis, color, torque in zip(SCENE_AXES, SCENE_AXES.values(), unit.factor * frames.torque_B.T, strict=True):
        held = _line(f"torque {axis}", at, torque, "y3", color, f"%{{y:.3~g}} {unit.name}")
        data.append(held | {"line": {"color": color, "width": 1.6, "shape": "hv"}})
    return {"data": data, "layout": _layout(maneuver, at, ranges)}


def _line(name: str, at: Clock, values: np.ndarray, axis: str, color: str, hover: str) -> dict[str, Any]:
    return {
        "type": "scatter",
        "mode": "lines",
        "name": name,
        "x0": 0.0,
        "dx": at.seconds,
        "y": rounded(values, 4),
        "yaxis": axis,
        "line": {"color": color, "width": 2},
        "hovertemplate": hover,
    }


def _layout(maneuver: Maneuver, at: Clock, ranges: dict[str, list[float]]) -> dict[str, Any]:
    axis = {"zeroline": False, "gridcolor": "#E6EAEE", "linecolor": "#9AA7B3", "fixedrange": True, "nticks": 5}
    axis |= {"tickfont": {"size": _TICK_SIZE}, "exponentformat": "power"}
    y_axes = {
        f"yaxis{number if number > 1 else ''}": axis | {"domain": list(domain), "range": ranges[name], "anchor": "x"}
        for number, (name, domain) in enumerate(_ROWS.items(), start=1)
    }
    # Every other decade has a label: there is no room for more.
    names = [f"{decade:g}" if i % 2 == 0 else "" for i, decade in enumerate(_DECADES)]
    y_axes["yaxis2"] |= {"type": "log", "tickvals": list(_DECADES), "ticktext": names}
    end = float(at.times[-1])
    x_axis = axis | {"range": [0.0, end], "title": {"text": "time [s]", "standoff": 4}, "anchor": "y3", "nticks": 12}
    return {
        "xaxis": x_axis,
        **y_axes,
        "shapes": _shapes(maneuver, end, ranges),
        "annotations": _titles(maneuver),
        "margin": {"l": 50, "r": 12, "t": 20, "b": 38},
        "font": {"size": 12, "family": "system-ui, sans-serif", "color": "#22272C"},
        "showlegend": False,
        "hovermode": "x unified",
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#FFFFFF",
    }


def _titles(maneuver: Maneuver) -> list[dict[str, Any]]:
    """Titles of the rows, above them and in one line with the axis, clear of the numbers on it."""
    unit = torque_unit(maneuver.task.spacecraft.torque_limits).name
    texts = {"margin": "margin to the zone [°]", "error": "pointing error [°]", "torque": f"torque [{unit}]"}
    place = {"xref": "paper", "yref": "paper", "x": 0.0, "xanchor": "left", "yanchor": "bottom", "showarrow": False}
    return [place | {"y": _ROWS[name][1], "text": text} for name, text in texts.items()]


def _shapes(maneuver: Maneuver, end: float, ranges: dict[str, list[float]]) -> list[dict[str, Any]]:
    """The cursor, the inside of the zone, and the accuracy asked for."""
    across = {"xref": "x", "x0": 0.0, "x1": end}
    settled_deg = maneuver.task.reward.settled_angle_deg
    cursor = {"type": "line", "xref": "x", "x0": 0.0, "x1": 0.0, "yref": "paper", "y0": 0, "y1": 1}
    inside = across | {"type": "rect", "yref": "y", "y0": ranges["margin"][0], "y1": 0.0, "layer": "below"}
    accuracy = across | {"type": "line", "yref": "y2", "y0": settled_deg, "y1": settled_deg}
    return [
        cursor | {"line": {"color": "#111111", "width": 1.5}},
        inside | {"fillcolor": palette.TRACE_INSIDE, "opacity": 0.15, "line": {"width": 0}},
        accuracy | {"line": {"color": palette.TARGET, "width": 1.5, "dash": "dash"}},
    ]
