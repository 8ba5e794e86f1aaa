"""The 3-D scene of one maneuver: sphere, zones, paths, and the traces that move."""

from typing import Any

import numpy as np

from koz_jax.figures import geometry, palette
from koz_jax.figures.geometry import SphereTraces, Zone
from koz_jax.viewer import body
from koz_jax.viewer.maneuver import Frames, Maneuver
from koz_jax.viewer.rounding import coordinates, rounded

# Lines lie on the unit sphere, surfaces a little below it, so that the lines are not drawn half inside them.
_BALL_RADIUS = 0.985
_CAP_RADIUS = 0.992

_POLE = np.array([0.0, 0.0, 1.0])
_CROSS = 0.11  # half length of its strokes: longer than the dot that begins there
_EYE = 1.3  # distance of the camera, in units of plotly
_TILT = 0.3  # tangent of how far the camera stands beside the middle of the path, so that the body is seen too


def scene(maneuver: Maneuver, frames: Frames) -> dict[str, Any]:
    """A plotly figure, and which of its traces turn: their numbers, and a quaternion for every frame.

    The page cuts the trail, and turns the body and the zones, to the instant shown.
    """
    drawn = geometry.sphere_traces(maneuver.history)
    parts: list[tuple[list[dict[str, Any]], np.ndarray | None]] = [(_ball(), None)]
    for number, zone in enumerate(drawn.zones, 1):
        turn = geometry.zone_turns(zone, frames.seconds) if zone.turns else None
        parts.append((_zone(zone, number if len(drawn.zones) > 1 else None), turn))
    ways = [_shortest(drawn.shortest_N), _cross("start", drawn.shortest_N[0], palette.SHORTEST)]
    ways += [_dot("target", drawn.shortest_N[-1], palette.TARGET, 9)]
    ways += [_trail(frames), _dot("now", frames.boresight_N[0], palette.TRACE, 6)]
    solid = body.solid(np.array(maneuver.task.spacecraft.inertia), geometry.boresight(maneuver.history))
    parts += [(ways, None), (solid, frames.q_BN)]
    data, turning = [], []
    for traces, turn in parts:
        if turn is not None:
            turning.append({"traces": [len(data) + i for i in range(len(traces))], "turns": rounded(turn, 5)})
        data += traces
    return {"data": data, "layout": _layout(drawn), "turning": turning}


def line(name: str, points: np.ndarray, **look: Any) -> dict[str, Any]:
    """Make a 3-D line.  points: (n, 3), nan for a gap."""
    trace = {"type": "scatter3d", "mode": "lines", "name": name, "hoverinfo": "skip"}
    return trace | {"line": look} | coordinates(points)


def _sheet(name: str, points: np.ndarray, color: str, opacity: float) -> dict[str, Any]:
    """Make a surface through a grid of points (rows, columns, 3)."""
    rows, columns = points.shape[:2]
    corner = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = corner[:-1, :-1], corner[:-1, 1:], corner[1:, 1:], corner[1:, :-1]
    i, j, k = np.concatenate([np.stack([a, b, c]).reshape(3, -1), np.stack([a, c, d]).reshape(3, -1)], axis=1).tolist()
    light = {"ambient": 0.95, "diffuse": 0.1, "specular": 0.0, "fresnel": 0.0}
    look = {"type": "mesh3d", "name": name, "color": color, "opacity": opacity, "hoverinfo": "skip", "lighting": light}
    return look | {"i": i, "j": j, "k": k} | coordinates(points.reshape(-1, 3), 3)


def _ball() -> list[dict[str, Any]]:
    """A translucent ball with a grid of circles."""
    ball = np.stack([geometry.zone_circle(Zone(_POLE, angle), 37) for angle in np.linspace(0.0, np.pi, 19)])
    gap = np.full((1, 3), np.nan)
    grid = np.concatenate([part for circle in geometry.graticule(points=49) for part in (circle, gap)])
    return [
        _sheet("sphere", _BALL_RADIUS * ball, palette.SPHERE, 0.3),
        line("grid", _BALL_RADIUS * grid, color=palette.GRID, width=1),
    ]


def _zone(zone: Zone, number: int | None) -> list[dict[str, Any]]:
    """A keep-out zone: its edge on the sphere, the cap inside, the cone from the spacecraft to the edge, its number."""
    edge = geometry.zone_circle(zone, 91)
    shares = np.linspace(0.0, 1.0, 7)
    cap = [geometry.zone_circle(Zone(zone.axis_N, share * zone.half_angle), 61) for share in shares]
    cone = np.stack([0.0 * cap[-1], cap[-1]])
    traces = [
        _sheet("zone", _CAP_RADIUS * np.stack(cap), palette.ZONE, 0.4),
        _sheet("zone cone", _CAP_RADIUS * cone, palette.ZONE, 0.15),
        line("zone edge", edge, color=palette.ZONE, width=6),
    ]
    return traces if number is None else [*traces, _number(zone, number)]


def _number(zone: Zone, number: int) -> dict[str, Any]:
    """The number of a zone, in the middle of its edge: inside the edge from wherever one looks."""
    place = max(np.cos(zone.half_angle), 0.3) * zone.axis_N
    trace = {"type": "scatter3d", "mode": "text", "name": "zone number", "text": [f"<b>{number}</b>"]}
    look = {"hoverinfo": "skip", "textposition": "middle center", "textfont": {"color": "#4A1F00", "size": 18}}
    return trace | look | coordinates(place[None])


def _shortest(path: np.ndarray) -> dict[str, Any]:
    return line("shortest path", path, color=palette.SHORTEST, width=5, dash="dash")


def _trail(frames: Frames) -> dict[str, Any]:
    inside = (frames.margin_deg <= 0.0).astype(int).tolist()
    scale = [[0.0, palette.TRACE], [1.0, palette.TRACE_INSIDE]]
    return line("boresight trail", frames.boresight_N, width=8, color=inside, colorscale=scale, cmin=0, cmax=1)


def _cross(name: str, point: np.ndarray, color: str) -> dict[str, Any]:
    """Mark a direction (3,) by two strokes that lie on the sphere."""
    corners = geometry.zone_circle(Zone(point, _CROSS), 5)
    strokes = np.stack([corners[0], corners[2], np.full(3, np.nan), corners[1], corners[3]])
    return line(name, strokes, color=color, width=7)


def _dot(name: str, point: np.ndarray, color: str, size: int) -> dict[str, Any]:
    marker = {"color": color, "size": size, "line": {"color": "#FFFFFF", "width": 1}}
    trace = {"type": "scatter3d", "mode": "markers", "name": name, "marker": marker, "hoverinfo": "skip"}
    return trace | coordinates(point[None])


def _layout(drawn: SphereTraces) -> dict[str, Any]:
    """Look at the path from a little beside it and from above, so that the zone does not hide the body."""
    towards, start, target = drawn.view.axes_N[2], drawn.shortest_N[0], drawn.shortest_N[-1]
    across = np.cross(start, target)
    length = np.linalg.norm(across)
    across = across / length if length > 1e-3 else drawn.view.axes_N[0]
    eye = towards + _TILT * across * (1.0 if across[2] >= 0.0 else -1.0)
    eye *= _EYE / np.linalg.norm(eye)
    up = np.eye(3)[2 if abs(eye[2]) < 0.9 * _EYE else 0]
    camera = {name: dict(zip("xyz", rounded(vector, 3), strict=True)) for name, vector in (("eye", eye), ("up", up))}
    hidden = {"visible": False, "showspikes": False, "range": [-1.03, 1.03]}
    space = {f"{axis}axis": hidden for axis in "xyz"}
    return {
        "scene": space | {"aspectmode": "cube", "camera": camera, "dragmode": "orbit", "hovermode": False},
        "margin": dict.fromkeys("lrtb", 0),
        "showlegend": False,
        "paper_bgcolor": "rgba(0,0,0,0)",
    }
