"""Agents of older versions: what has been added to what policies for any spacecraft see, they give no weight."""

from collections.abc import Mapping

import numpy as np

from koz_jax.config.training import NetworkConfig
from koz_jax.control.encoding import dials, views
from koz_jax.sac.dials import DIAL_FEATURES
from koz_jax.task.observation_layout import size, slices

_FIRST_LAYER = "params/Mlp_0/Dense_0/kernel"

# Parts of the observation that there were not at first.
_ADDED = ("stopping", "turning")


def as_today(arrays: Mapping[str, np.ndarray], network: NetworkConfig) -> dict[str, np.ndarray]:
    """Make the arrays that an agent has today of those of its folder: the policy decides as it did.

    arrays: float32 by their names.  Those of today are returned as they are.
    """
    found = dict(arrays)
    kernel = found.get(_FIRST_LAYER)
    if not network.scaled or kernel is None or kernel.ndim != 2:
        return found
    where = slices(network.observed_zones, scaled=True)
    added = np.concatenate([np.arange(where[name].start, where[name].stop) for name in _ADDED])
    seen = sum(stop - start for start, stop, _ in views(network)) + DIAL_FEATURES * len(dials(network))
    inputs = size(network.observed_zones, scaled=True) + seen
    if len(kernel) == inputs - len(added):
        today = np.zeros((inputs, kernel.shape[1]), kernel.dtype)
        today[np.setdiff1d(np.arange(inputs), added)] = kernel
        found[_FIRST_LAYER] = today
    return found
