"""Which parts of the observation the networks also see at finer scales; without jax."""

import math

from koz_jax.config.training import NetworkConfig
from koz_jax.sac.dials import Dials
from koz_jax.task.observation_layout import FREE_RATE, slices

# [1/T] Least rate limit that a policy tells apart.
SLOWEST_RATE = 0.15

Views = tuple[tuple[int, int, float], ...]  # (start, stop, scale): also feed tanh(observation[start:stop] / scale)


def views(network: NetworkConfig) -> Views:
    """Slices of the observation with their scales, in the order in which they are appended to it."""
    config, where = network.encoding, slices(network.observed_zones, network.scaled)
    q_vec = slice(where["q_e"].start + 1, where["q_e"].stop)
    rate = where["omega_BN_P" if network.scaled else "omega_BN_B"]
    parts = [(q_vec, config.attitude_scales), (rate, config.rate_scales)]
    parts += [(where[name], config.zone_margin_scales) for name in where if name.endswith("zone_margin")]
    return tuple((part.start, part.stop, scale) for part, scales in parts for scale in scales)


def dials(network: NetworkConfig) -> Dials:
    """Entries of the observation that modulate the policy's layers: none but where it is for any spacecraft."""
    if not network.scaled:
        return ()
    where = slices(network.observed_zones, scaled=True)
    return (where["rate_limit"].start, math.log(SLOWEST_RATE / FREE_RATE), 0.0), (where["urgency"].start, -1.0, 1.0)
