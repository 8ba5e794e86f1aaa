"""The spacecraft as a solid, in body axes: the page turns it with the attitude."""

from typing import Any

import numpy as np

from koz_jax.figures import geometry, palette
from koz_jax.figures.geometry import Zone
from koz_jax.figures.palette import SCENE_AXES
from koz_jax.viewer.rounding import coordinates

_LONGEST = 0.26  # half of the box's longest side; the sphere has radius 1
_AXIS = 0.52  # length of the body axes
_TUBE_ENDS = 24

# Corners of the box are numbered by the signs of x, y, z as bits; two triangles a face, in pairs -x +x -y +y -z +z.
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
_TRIANGLES = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
_TRIANGLES += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
_EDGES = [(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit]


def half_sides(inertia: np.ndarray) -> np.ndarray:
    """Half sides (3,) of the box, in proportion to how far the mass reaches along each body axis.

    Its mean square along axis i is trace(I) / 2 - I_ii, per unit of mass; inertia: (3, 3) [kg m^2].
    """
    reach = np.sqrt(np.maximum(np.trace(inertia) / 2.0 - np.diag(inertia), 0.0))
    # Even a rod is drawn with some thickness.
    return _LONGEST * np.maximum(reach / reach.max(), 0.15)


def solid(inertia: np.ndarray, boresight_B: np.ndarray) -> list[dict[str, Any]]:
    """Traces of the body, in body axes.

    inertia: (3, 3) [kg m^2]; boresight_B: (3,) unit vector.
    """
    box = half_sides(inertia) * _CORNERS
    a, b, c = np.array(_TRIANGLES).T.tolist()
    faces = [tint for tint in ("#7C8794", "#97A1AC", "#6F7A87", "#A6AFB9", "#8A94A0", "#B5BDC6") for _ in range(2)]
    shade = {"ambient": 0.75, "diffuse": 0.5, "specular": 0.05, "fresnel": 0.0}
    mesh = {"type": "mesh3d", "hoverinfo": "skip", "flatshading": True, "lighting": shade}
    line = {"type": "scatter3d", "mode": "lines", "hoverinfo": "skip"}
    tube, (i, j, k) = _telescope(boresight_B)
    gap = np.full(3, np.nan)
    edges = np.array([point for start, end in _EDGES for point in (*box[[start, end]], gap)])
    traces_B = [
        mesh | {"name": "body", "i": a, "j": b, "k": c, "facecolor": faces} | coordinates(box),
        line | {"name": "body edges", "line": {"color": "#3A4047", "width": 3}} | coordinates(edges),
        mesh | {"name": "telescope", "i": i, "j": j, "k": k, "color": "#3A4047"} | coordinates(tube),
        line
        | {
            "name": "line of sight",
            "line": {"color": palette.TRACE, "width": 2},
        }
        | coordinates(np.array([_AXIS * boresight_B, boresight_B])),
    ]
    for axis, direction in zip(SCENE_AXES, np.eye(3), strict=True):
        axis_line = {
            "name": f"body axis {axis}",
            "mode": "lines+text",
            "text": ["", axis],
            "textfont": {"color": SCENE_AXES[axis], "size": 15},
            "line": {"color": SCENE_AXES[axis], "width": 7},
        }
        traces_B.append(line | axis_line | coordinates(np.array([0.0 * direction, _AXIS * direction])))
    return traces_B


def _telescope(boresight: np.ndarray) -> tuple[np.ndarray, list[list[int]]]:
    """Draw the telescope as a tube that opens along the boresight.  Returns points (n, 3) and triangles as i, j, k."""
    count = _TUBE_ENDS
    rim = geometry.zone_circle(Zone(boresight, np.pi / 2), count + 1)[:-1]
    points = np.concatenate([0.08 * rim, 0.10 * rim + 0.40 * boresight])
    here = np.arange(count)
    after = (here + 1) % count
    triangles = np.concatenate([[here, after, here + count], [after, after + count, here + count]], axis=1)
    return points, triangles.tolist()
