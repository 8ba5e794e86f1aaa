"""Settings of what controller and shield do not know.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from koz_jax.config.base import NonNegativeFloat, Settings, ShareBelowOne

# Torques that are on their way to the actuators.
MAX_DELAY = 3

DelaySteps = Annotated[int, Field(ge=0, le=MAX_DELAY)]


class UncertaintyConfig(Settings):
    """How far the truth may be from the model."""

    inertia_error: ShareBelowOne = 0.0
    """Largest relative error of the inertia about any axis."""
    disturbance_torque: NonNegativeFloat = 0.0
    """Norm of a constant torque from outside [N m]."""
    attitude_noise_deg: NonNegativeFloat = 0.0
    """Standard deviation per axis of the measured attitude [deg], cut at 3 times that."""
    rate_noise_deg: NonNegativeFloat = 0.0
    """Standard deviation per axis of the measured rate [deg/s], cut at 3 times that."""
    attitude_bias_deg: NonNegativeFloat = 0.0
    """Constant error of the measured attitude [deg], about a random axis."""
    rate_bias_deg: NonNegativeFloat = 0.0
    """Norm of a constant error of the measured rate [deg/s], its direction random."""
    delay_steps: DelaySteps = 0
    """Steps by which the torque comes late."""


CERTAIN = UncertaintyConfig()
