"""Settings of reaction wheels, and the torques that they can make.  Imports no jax.

A torque is shared out by the least norm of the wheels' torques: each wheel gets a row of the pseudo-inverse of the
matrix of axes.  Of what the wheels can make in this way, controllers are told of a box in body axes.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pydantic import model_validator

from koz_jax.config.base import PositiveFloat, Settings, Vector, check_unit

# Axes that span space only by less than this are a slip of the pen.
_LEAST_SPAN = 1e-3

# Of wheels' torque, what braking counts on at any rate; the rest is for the gyroscopic torque of their momentum.
BRAKE_SHARE = 0.5

# Of wheels' torque, what controllers are told of at least, also where they are told of more than there is.
LEAST_SHARE = 0.05


class WheelConfig(Settings):
    """A reaction wheel."""

    axis: Vector
    """Unit vector of its axis, in body axes."""
    max_torque: PositiveFloat
    """Largest torque of its motor [N m]."""
    max_momentum: PositiveFloat
    """Largest angular momentum that it holds [N m s]."""
    momentum: float = 0.0
    """Angular momentum at the start [N m s]."""

    @model_validator(mode="after")
    def _possible(self) -> WheelConfig:
        check_unit("axis", self.axis)
        if abs(self.momentum) > self.max_momentum:
            raise ValueError(
                f"momentum must be at most max_momentum = {self.max_momentum:g} in size; got {self.momentum:g}"
            )
        return self


Wheels = tuple[WheelConfig, ...]


def check_span(wheels: Wheels) -> None:
    """Refuse wheels that cannot turn the body about every axis."""
    if not wheels:
        return
    spans = np.linalg.svd(_axes(wheels), compute_uv=False)
    if len(wheels) < 3 or spans[-1] < _LEAST_SPAN:
        raise ValueError(
            f"wheels must be at least three, with axes that do not lie in a plane; got {len(wheels)} along"
            f" {', '.join(str(wheel.axis) for wheel in wheels)}"
        )


def allocation(wheels: Wheels) -> npt.NDArray[np.float64]:
    """Torque of each wheel per torque on the body: (wheels, 3)."""
    return np.asarray(np.linalg.pinv(_axes(wheels).T), np.float64)


def torque_box(wheels: Wheels) -> tuple[float, float, float]:
    """Torques about the body axes that can be made at once [N m].

    In proportion to what is possible about each axis alone.
    """
    rows = np.abs(allocation(wheels))
    limits = np.array([wheel.max_torque for wheel in wheels])
    alone = np.min(limits[:, None] / np.maximum(rows, 1e-12), axis=0)
    x, y, z = (np.min(limits / (rows @ alone)) * alone).tolist()
    return x, y, z


def _axes(wheels: Wheels) -> npt.NDArray[np.float64]:
    """Rows (wheels, 3)."""
    return np.array([wheel.axis for wheel in wheels])
