"""Slews that a double DQN chooses one after another, each flown by quaternion feedback.

In the way of Jiang et al. (2023), whose text was not to be had: discrete rotations, and a state of attitude error and
angles to forbidden directions, are theirs; all numbers are not.  ``python benchmarks/dqn.py`` trains it, for an
instrument that looks along x.
"""

import functools
import importlib.resources
import io

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from flax.traverse_util import unflatten_dict

from koz_jax.config.training import NetworkConfig
from koz_jax.control import encoding
from koz_jax.control.feedback import Gain
from koz_jax.control.quaternion_feedback import QuaternionFeedback
from koz_jax.control.slews import slews
from koz_jax.learners.dqn import ActionValues
from koz_jax.sac.networks import Params
from koz_jax.task import rotations
from koz_jax.task.observation import observe
from koz_jax.task.state import EnvState, Model

HIDDEN_SIZES = (64, 64)

ENCODING = encoding.views(NetworkConfig())


@functools.cache
def _shipped() -> dict[str, np.ndarray]:
    """Weights by their names."""
    content = importlib.resources.files("koz_jax").joinpath("control", "slews", "dqn_slews.npz").read_bytes()
    with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
        return dict(arrays)


def shipped_values() -> Params:
    """The network that comes with the package."""
    return unflatten_dict({name: jnp.asarray(array) for name, array in _shipped().items()}, sep="/")


class DqnSlews(struct.PyTreeNode):
    """Begins the next slew shortly before the end of the one before."""

    values: Params = struct.field(default_factory=shipped_values)
    tolerance: Gain = 0.087  # () [rad] to the end of a slew, where the next one begins
    feedback: QuaternionFeedback = QuaternionFeedback()

    def begin(self, state: EnvState, model: Model, key: jax.Array) -> jax.Array:
        """Attitude (4,) at the end of the first slew."""
        return self.after(slews.at_rest(state, state.body.q_BN))

    def decide(self, state: EnvState, model: Model, memory: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Action (3,), and the attitude (4,) at the end of the slew under way."""
        left = rotations.rotation_angle(rotations.multiply(rotations.conjugate(memory), state.body.q_BN))
        goal = jnp.where(left < self.tolerance, self.after(slews.at_rest(state, memory)), memory)
        aimed = state.replace(scenario=state.scenario.replace(q_DN=goal))
        return self.feedback.decide(aimed, model, None)[0], goal

    def after(self, at: EnvState) -> jax.Array:
        """Attitude (4,) at the end of the best slew from where a body is at rest; the target's where it is there."""
        values = ActionValues(HIDDEN_SIZES, ENCODING, slews.COUNT).apply(self.values, observe(at))
        found = slews.slew(at, jnp.argmax(values))  # pyright: ignore[reportArgumentType]
        return jnp.where(slews.is_there(at), at.scenario.q_DN, found.state.body.q_BN)
