"""What the C source of a spacecraft with reaction wheels holds of them, by placeholder of the templates."""

import numpy as np

from koz_jax.config.actuators import wheels
from koz_jax.config.actuators.wheels import BRAKE_SHARE, LEAST_SHARE
from koz_jax.config.task import SpacecraftConfig
from koz_jax.export.c_source import literals
from koz_jax.export.golden import Golden

WHEEL_FILES = ("koz_wheels.h",)


def replacements(spacecraft: SpacecraftConfig, vectors: Golden) -> dict[str, str]:
    """Text by placeholder; none where there are no wheels."""
    own = spacecraft.wheels
    if not own:
        return {}
    allocation, limits = wheels.allocation(own), np.array(spacecraft.torque_limits)
    moments = np.linalg.eigvalsh(np.array(spacecraft.inertia))
    rate_deg = spacecraft.max_rate_deg
    numbers = {
        "LEAST_SHARE": LEAST_SHARE,
        "LARGEST_WHEEL_TORQUE": max(wheel.max_torque for wheel in own),
        "RESERVE": (1.0 - BRAKE_SHARE) * np.min(limits),
        "BODY_LARGEST_MOMENT": moments[2],
        "BODY_MOMENT_DIFFERENCE": moments[2] - moments[0],
    }
    rows = {
        "ALLOCATED": np.linalg.norm(allocation, axis=1),
        "CORNER": np.abs(allocation) @ limits,
        "WHEEL_MAX_TORQUE": [wheel.max_torque for wheel in own],
        "WHEEL_MAX_MOMENTUM": [wheel.max_momentum for wheel in own],
    }
    return {
        "WHEEL_TORQUE_ROWS": literals.rows(vectors.wheel_torque),
        "WHEEL_AXES": literals.matrix([wheel.axis for wheel in own]),
        "ALLOCATION": literals.matrix(allocation),
        "BODY_INERTIA": literals.matrix(spacecraft.inertia),
        "BODY_INVERSE_INERTIA": literals.matrix(np.linalg.inv(np.array(spacecraft.inertia))),
        "MAX_RATE": "INFINITY" if rate_deg is None else literals.number(float(np.deg2rad(rate_deg))),
        **{name: literals.row(values) for name, values in rows.items()},
        **{name: literals.number(float(value)) for name, value in numbers.items()},
    }
