"""Deeper networks that decide as shallower ones did, to be trained on (Net2DeeperNet, arXiv:1511.05641)."""

import jax
import jax.numpy as jnp

from koz_jax.config.training import NetworkConfig
from koz_jax.control.policy import PolicyController
from koz_jax.sac.networks import Params


def can_become(network: NetworkConfig, deeper: NetworkConfig) -> bool:
    """Whether one network is another, but for further hidden layers as wide as its last one."""
    sizes = network.hidden_sizes
    added = deeper.hidden_sizes[len(sizes) :]
    as_deep = network.model_copy(update={"hidden_sizes": (*sizes, *added)})
    return as_deep == deeper and set(added) <= set(sizes[-1:])


def deepened(controller: PolicyController, deeper: NetworkConfig) -> PolicyController:
    """Add hidden layers in front of the output that pass on what they are given.

    What they are given has gone through a ReLU, which does not change it a second time.
    """
    had, has = len(controller.network.hidden_sizes), len(deeper.hidden_sizes)
    layers: Params = dict(controller.policy["params"]["Mlp_0"])
    output, width = layers.pop(f"Dense_{had}"), deeper.hidden_sizes[-1]
    beside = output["kernel"].shape[0] - width  # features of the dials, which every layer sees
    for number in range(had, has):
        layers[f"Dense_{number}"] = {"kernel": jnp.eye(width + beside, width), "bias": jnp.zeros(width)}
        if beside:
            layers[f"Gain_{number}"] = jax.tree.map(jnp.zeros_like, layers[f"Gain_{had - 1}"])
    layers[f"Dense_{has}"] = output
    return controller.replace(policy={"params": {"Mlp_0": layers}}, network=deeper)
