"""Numbers short enough to ship."""

from typing import Any

import numpy as np


def rounded(values: np.ndarray, digits: int = 4) -> list:
    """Nested lists of rounded numbers: ``digits`` = 4 is 0.006 deg on the unit sphere."""
    return np.round(np.asarray(values, np.float64), digits).tolist()


def coordinates(points: np.ndarray, digits: int = 4) -> dict[str, Any]:
    """x, y and z of a trace.  points: (n, 3), nan for a gap."""
    found = ([None if np.isnan(value) else value for value in row] for row in rounded(points.T, digits))
    return dict(zip("xyz", found, strict=True))
