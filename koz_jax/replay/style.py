"""Colours of a replay (Okabe and Ito's, told apart by colour-blind people), and numbers short enough to ship."""

import numpy as np

TRAIL = "#000000"
VIOLATION = "#A50026"
ZONE = "#D55E00"
SHORTEST = "#0072B2"
TARGET = "#009E73"
SPHERE = "#C9D3DC"
GRID = "#9AA7B3"
AXES = {"x": "#E69F00", "y": "#CC79A7", "z": "#56B4E9"}


def rounded(values: np.ndarray, digits: int = 4) -> list:
    """Nested lists of rounded numbers: ``digits`` = 4 is 0.006 deg on the unit sphere."""
    return np.round(np.asarray(values, np.float64), digits).tolist()
