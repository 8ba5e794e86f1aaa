"""Dials: entries of the observation that modulate every layer of a policy; without jax."""

Dials = tuple[tuple[int, float, float], ...]  # (entry, low, high)

# Gaussian features of a dial, evenly spaced over its range.
DIAL_FEATURES = 5


def spacing(low: float, high: float) -> float:
    """Distance between the centres of two features of a dial."""
    return (high - low) / (DIAL_FEATURES - 1)
