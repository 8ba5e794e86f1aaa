"""Settings of learners with a deterministic policy.  Imports no jax.

Batches, replay buffer, n-step returns and moving averages are those of Soft Actor-Critic's settings.
"""

from koz_jax.config.base import MarginDeg, NonNegativeFloat, PositiveFloat, PositiveInt, Settings


class Td3Config(Settings):
    """Twin Delayed DDPG (Fujimoto et al. 2018)."""

    exploration_noise: PositiveFloat = 0.1
    """Standard deviation of the Gaussian noise on actions that gather experience."""
    target_noise: NonNegativeFloat = 0.2
    """Standard deviation of the noise on the action in the critics' target, which smooths them."""
    target_noise_clip: NonNegativeFloat = 0.5
    """Largest noise in the critics' target."""
    policy_delay: PositiveInt = 2
    """Updates of the critics for each of the policy and of the moving averages."""


class DdpgConfig(Settings):
    """Deep Deterministic Policy Gradient (Lillicrap et al. 2016), with a priority of what is met near zones."""

    exploration_noise: PositiveFloat = 0.1
    """Standard deviation of the Gaussian noise on actions that gather experience."""
    zone_priority: PositiveInt = 4
    """In phase 2, a step near a zone or in it is drawn so many times as often as another; 1 draws all alike."""
    zone_margin_deg: MarginDeg = 5.0
    """A step is near a zone where its margin is below this [deg]."""
