"""Settings of single-gimbal control moment gyros, and the torques that they are counted on for.  Imports no jax.

A rotor of constant momentum is turned about a gimbal axis, and the body gets the torque.  Where the gimbals stand in a
singular arrangement there is a direction in which none of them gives a torque, so controllers are told of a box that
is smaller than what the gyros can make at best.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from pydantic import Field, model_validator

from koz_jax.config.base import PositiveFloat, Settings, Vector, check_unit

# Of the torque about all axes at once that there is with all gimbals at zero, what controllers are told of.
BOX_SHARE = 0.5

# Axes that span space only by less than this are a slip of the pen.
_LEAST_SPAN = 1e-3


class GyroConfig(Settings):
    """A single-gimbal control moment gyro."""

    gimbal_axis: Vector
    """Unit vector of its gimbal's axis, in body axes."""
    rotor_axis: Vector
    """Unit vector of its rotor's momentum at gimbal angle zero, square to that, in body axes."""
    momentum: PositiveFloat
    """Momentum of its rotor [N m s], which is constant."""
    max_gimbal_rate_deg: PositiveFloat
    """Largest rate of its gimbal [deg/s]."""
    angle_deg: float = 0.0
    """Gimbal angle at the start [deg]."""

    @model_validator(mode="after")
    def _possible(self) -> GyroConfig:
        check_unit("gimbal_axis", self.gimbal_axis)
        check_unit("rotor_axis", self.rotor_axis)
        along = float(np.dot(self.gimbal_axis, self.rotor_axis))
        if abs(along) > 1e-6:
            raise ValueError(f"rotor_axis must be square to gimbal_axis; got {self.rotor_axis}, {along:.6g} along it")
        return self


Gyros = tuple[GyroConfig, ...]


class PyramidConfig(Settings):
    """Four gyros in a pyramid about the body's z axis, the gimbal axes square to its faces."""

    momentum: PositiveFloat
    """Momentum of each rotor [N m s]."""
    max_gimbal_rate_deg: PositiveFloat
    """Largest rate of each gimbal [deg/s]."""
    skew_deg: float = Field(default=54.74, gt=0, lt=90)
    """Angle between the gimbal axes and z [deg]."""
    angles_deg: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Gimbal angles at the start [deg]; at zero the momenta cancel."""

    @property
    def gyros(self) -> Gyros:
        """One by one, beginning with the one towards x."""
        sine, cosine = np.sin(np.deg2rad(self.skew_deg)), np.cos(np.deg2rad(self.skew_deg))
        sides = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
        return tuple(
            GyroConfig(
                gimbal_axis=(float(sine * x), float(sine * y), float(cosine)),
                rotor_axis=(-y, x, 0.0),
                momentum=self.momentum,
                max_gimbal_rate_deg=self.max_gimbal_rate_deg,
                angle_deg=angle,
            )
            for (x, y), angle in zip(sides, self.angles_deg, strict=True)
        )


def check_span(gyros: Gyros) -> None:
    """Refuse gyros that cannot turn the body about every axis."""
    if not gyros:
        return
    spans = np.linalg.svd(_torque_per_rate(gyros), compute_uv=False)
    if len(gyros) < 3 or spans[-1] < _LEAST_SPAN * spans[0]:
        raise ValueError(
            "gyros must be at least three, whose torques at gimbal angle zero do not lie in a plane; got"
            f" {len(gyros)} along {', '.join(str(gyro.gimbal_axis) for gyro in gyros)}"
        )


def torque_box(gyros: Gyros) -> Vector:
    """Torques about the body axes that controllers are told of [N m], the same about all.

    ``BOX_SHARE`` of what the gyros make about all axes at once, by the least gimbal rates, with all gimbals at zero.
    """
    rates = np.sum(np.abs(np.linalg.pinv(_torque_per_rate(gyros))), axis=1)
    limit = BOX_SHARE * min(
        float(np.deg2rad(gyro.max_gimbal_rate_deg) / rate) for gyro, rate in zip(gyros, rates, strict=True) if rate > 0
    )
    return limit, limit, limit


def _torque_per_rate(gyros: Gyros) -> npt.NDArray[np.float64]:
    """Torque on the body per gimbal rate [N m s], but for the sign, with all gimbals at zero.  Returns (3, gyros)."""
    return np.stack([gyro.momentum * np.cross(gyro.gimbal_axis, gyro.rotor_axis) for gyro in gyros], axis=1)
