"""Settings of the shield and of what it has to withstand.  Angles in degrees; imports no jax."""

from __future__ import annotations

from koz_jax.settings import NonNegativeFloat, PositiveFloat, PositiveInt, Settings, ShareBelowOne


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


CERTAIN = UncertaintyConfig()


class ShieldConfig(Settings):
    """The shield."""

    margin_deg: PositiveFloat = 0.1
    """Angle kept from every zone [deg]; more is kept where attitude noise is withstood."""
    withstands: UncertaintyConfig = CERTAIN
    """Errors for which the guarantee holds."""
    guide_rate_deg: PositiveFloat = 6.0
    """Rate with which the boresight is led around a zone [deg/s]."""
    samples: PositiveInt = 12
    """Samples of a brake path: more are less cautious and slower."""
