"""Time histories under a scene: margin to the zone, pointing error and torque, with a cursor at the instant shown."""

from typing import Any

import numpy as np

from koz_jax.figures import palette
from koz_jax.figures.palette import SCENE_AXES
from koz_jax.viewer.maneuver import Clock, Frames, Maneuver
from koz_jax.viewer.rounding import rounded

_ROWS = {"margin": (0.70, 1.0), "error": (0.36, 0.64), "torque": (0.0, 0.30)}

# Below this the pointing error is not told apart from zero [deg].
_LEAST_ERROR_DEG = 1e-3


def timelines(maneuvers: list[Maneuver], shown: list[Frames], at: Clock) -> list[dict[str, Any]]:
    """A plotly figure per maneuver, all to the same scales.  The cursor is the first shape of the layout."""
    margins = np.concatenate([frames.margin_deg for frames in shown])
    errors = np.concatenate([frames.phi_deg for frames in shown])
    largest = max(max(maneuver.task.spacecraft.torque_limits) for maneuver in maneuvers)
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
    for axis, color, torque in zip(SCENE_AXES, SCENE_AXES.values(), frames.torque_B.T, strict=True):
        held = _line(f"torque {axis}", at, torque, "y3", color, "%{y:.2f} N m")
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
    titles = {"margin": "margin [°]", "error": "error [°]", "torque": "torque [N m]"}
    y_axes = {
        f"yaxis{number if number > 1 else ''}": axis
        | {"domain": list(domain), "range": ranges[name], "title": {"text": titles[name], "standoff": 6}, "anchor": "x"}
        for number, (name, domain) in enumerate(_ROWS.items(), start=1)
    }
    decades = {"type": "log", "tickvals": [0.001, 0.01, 0.1, 1, 10, 100]}
    y_axes["yaxis2"] |= decades | {"ticktext": ["0.001", "0.01", "0.1", "1", "10", "100"]}
    end = float(at.times[-1])
    x_axis = axis | {"range": [0.0, end], "title": {"text": "time [s]", "standoff": 4}, "anchor": "y3", "nticks": 12}
    return {
        "xaxis": x_axis,
        **y_axes,
        "shapes": _shapes(maneuver, end, ranges),
        "margin": {"l": 62, "r": 12, "t": 6, "b": 38},
        "font": {"size": 12, "family": "system-ui, sans-serif", "color": "#22272C"},
        "showlegend": False,
        "hovermode": "x unified",
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "#FFFFFF",
    }


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
