"""Which parts of the observation the networks also see at finer scales; without jax."""

from koz_jax.config.training import NetworkConfig
from koz_jax.task.observation_layout import slices

Views = tuple[tuple[int, int, float], ...]  # (start, stop, scale): also feed tanh(observation[start:stop] / scale)


def views(network: NetworkConfig) -> Views:
    """Slices of the observation with their scales, in the order in which they are appended to it."""
    config, where = network.encoding, slices(network.observed_zones)
    q_vec = slice(where["q_e"].start + 1, where["q_e"].stop)
    parts = [(q_vec, config.attitude_scales), (where["omega_BN_B"], config.rate_scales)]
    parts += [(where[name], config.zone_margin_scales) for name in where if name.endswith("zone_margin")]
    return tuple((part.start, part.stop, scale) for part, scales in parts for scale in scales)
