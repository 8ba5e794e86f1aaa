"""Training on several devices: environments and replay buffer are divided among them, networks are on each.

XLA makes the exchange between devices out of where the arrays lie; the training step itself knows nothing of it.  The
results are those of one device up to rounding, since sums over a batch are taken in another order.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from koz_jax.config import TrainConfig
from koz_jax.errors import UserError
from koz_jax.training import TrainState

_AXIS = "environments"


def check(config: TrainConfig, devices: int) -> None:
    """Refuse a number of devices that there are not, or among which the environments cannot be divided.

    Raises:
        UserError: it cannot be.

    """
    present = len(jax.local_devices())
    if not 1 <= devices <= present:
        raise UserError(f"devices: must be from 1 to {present}, the devices that there are; got {devices}")
    if config.num_envs % devices:
        raise UserError(f"devices: must divide num_envs = {config.num_envs}; got {devices}")


def place(state: TrainState, devices: int) -> TrainState:
    """Divide a training state among the first ``devices`` devices; on one it stays as it is."""
    if devices == 1:
        return state
    mesh = Mesh(np.array(jax.local_devices()[:devices]), (_AXIS,))

    def put(tree: Any, *axes: str | None) -> Any:
        return jax.device_put(tree, NamedSharding(mesh, PartitionSpec(*axes)))

    return TrainState(
        learner=put(state.learner),
        buffer=put(state.buffer).replace(rows=put(state.buffer.rows, None, _AXIS)),
        env_states=put(state.env_states, _AXIS),
        key=put(state.key),
        updates=put(state.updates),
    )


def whole(tree: Any, devices: int) -> Any:
    """Bring something that ``place`` put on every device back to one, where evaluation can place it anew."""
    return tree if devices == 1 else jax.tree.map(jnp.asarray, jax.device_get(tree))
