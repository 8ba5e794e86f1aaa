"""Numbers short enough to ship."""

import numpy as np


def rounded(values: np.ndarray, digits: int = 4) -> list:
    """Nested lists of rounded numbers: ``digits`` = 4 is 0.006 deg on the unit sphere."""
    return np.round(np.asarray(values, np.float64), digits).tolist()
