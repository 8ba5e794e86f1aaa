"""Ask a trained agent with NumPy alone, for those who only fly it: importing this imports no jax.

>>> policy = load_policy("phase2")
>>> torque_B = policy.record.task.spacecraft.torque_limits * policy.predict(observation)

The observation keeps the sign of q_e from step to step, also where that of a measured attitude jumps;
``numpy_observer`` makes it so of what is measured.  It also turns the actions of a policy for any spacecraft, which are
angular accelerations, into torques of one.
"""

import dataclasses
import itertools
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from koz_jax.agents import older
from koz_jax.agents.record import Record, find_agent, read_agent_record
from koz_jax.config.task import ScenarioConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.control.encoding import Views, dials, views
from koz_jax.errors import DamagedFileError
from koz_jax.sac.dials import DIAL_FEATURES, Dials, spacing
from koz_jax.storage import archive
from koz_jax.task.observation_layout import ACTION_SIZE, as_observations, size


@dataclasses.dataclass(frozen=True)
class Layer:
    """x -> x kernel + bias; under dials x -> ([x, features] kernel + bias) (1 + features gain)."""

    kernel: np.ndarray  # (inputs, outputs) float32
    bias: np.ndarray  # (outputs,) float32
    gain: np.ndarray | None = None  # (features of all dials, outputs) float32; None at the end, and without dials


@dataclasses.dataclass(frozen=True)
class NumpyPolicy:
    """The deterministic policy of an agent: what it sees, and its layers (ReLU between, tanh at the end)."""

    views: Views
    layers: tuple[Layer, ...]
    record: Record
    name: str
    dials: Dials = ()

    def predict(self, observations: np.ndarray) -> np.ndarray:
        """Deterministic actions, as ``Agent.predict`` to rounding.

        observations: (16,) or (batch, 16), in the order of ``observation_layout.layout``; 5 entries more for each
        further zone that the agent sees.  Returns (3,) or (batch, 3) in [-1, 1]; times the torque limits that is the
        torque in body axes, but for a policy for any spacecraft, see ``ScaledObserver.torque``.
        """
        network = self.record.network
        observed = as_observations(observations, network.observed_zones, network.scaled)
        seen = [np.tanh(observed[..., start:stop] / np.float32(scale)) for start, stop, scale in self.views]
        dialled = _dial_features(observed, self.dials)
        x = np.concatenate([observed, *seen, dialled], axis=-1)
        for layer in self.layers[:-1]:
            x = x @ layer.kernel + layer.bias
            if layer.gain is not None:
                x = x * (np.float32(1.0) + dialled @ layer.gain)
            x = np.concatenate([np.maximum(x, np.float32(0.0)), dialled], axis=-1)
        return np.tanh(x @ self.layers[-1].kernel + self.layers[-1].bias)


def load_policy(name: str | Path = "phase2") -> NumpyPolicy:
    """Load an agent of ours by name or folder, see ``find_agent``.

    Raises:
        SettingsError: there is no such agent.
        DamagedFileError: its files are damaged.

    """
    folder = find_agent(name)
    record = read_agent_record(folder)
    try:
        return from_arrays(older.as_today(archive.read_arrays(folder), record.network), record, str(name))
    except DamagedFileError as error:
        raise DamagedFileError(f"{folder}: {error}") from None


def from_arrays(arrays: Mapping[str, np.ndarray], record: Record, name: str) -> NumpyPolicy:
    """Take the deterministic policy out of the arrays of an agent's folder.

    Raises:
        DamagedFileError: an array is missing, or has another shape or type than the record's network.

    """
    network = record.network
    features, layers = DIAL_FEATURES * len(dials(network)), []
    for number, (inputs, outputs) in enumerate(_shapes(network)):
        kernel, bias = layer_names(number)
        gained = features and number < len(network.hidden_sizes)
        layers.append(
            Layer(
                _array(arrays, kernel, (inputs + features, outputs)),
                _array(arrays, bias, (outputs,)),
                _array(arrays, f"params/Mlp_0/Gain_{number}/kernel", (features, outputs)) if gained else None,
            )
        )
    # The other half of the last layer is the spread of the actions, which only training needs.
    layers[-1] = Layer(layers[-1].kernel[:, :ACTION_SIZE], layers[-1].bias[:ACTION_SIZE])
    expected = sum(2 + (layer.gain is not None) for layer in layers)
    if len(arrays) != expected:
        raise DamagedFileError(f"{len(arrays)} arrays, but the network of the record has {expected}")
    return NumpyPolicy(views(network), tuple(layers), record, name, dials(network))


def exported_zone_count(network: NetworkConfig, scenario: ScenarioConfig, least: int = 0) -> int:
    """Zones that an exported controller is told of: all there may be, of which the policy sees the nearest.

    least: so many at least, such as a maneuver file has constraints.
    """
    return max(network.observed_zones, scenario.max_zones, least)


def layer_names(number: int) -> tuple[str, str]:
    """Names of a layer's kernel and bias among the arrays of an agent."""
    layer = f"params/Mlp_0/Dense_{number}"
    return f"{layer}/kernel", f"{layer}/bias"


def _dial_features(observed: np.ndarray, dials: Dials) -> np.ndarray:
    """Gaussian features of each dial.  observed: (..., n) float32.  Returns (..., dials * DIAL_FEATURES) float32."""
    features = [observed[..., :0]]
    for entry, low, high in dials:
        steps = (observed[..., entry, None] - np.float32(low)) / np.float32(spacing(low, high))
        features.append(np.exp(np.float32(-0.5) * (steps - np.arange(DIAL_FEATURES, dtype=np.float32)) ** 2))
    return np.concatenate(features, axis=-1)


def _shapes(network: NetworkConfig) -> list[tuple[int, int]]:
    """Inputs, without those of the dials, and outputs of each layer."""
    encoded = size(network.observed_zones, network.scaled) + sum(stop - start for start, stop, _ in views(network))
    sizes = (encoded, *network.hidden_sizes, 2 * ACTION_SIZE)
    return list(itertools.pairwise(sizes))


def _array(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> np.ndarray:
    if name not in arrays:
        raise DamagedFileError(f"the array {name} is missing")
    found = arrays[name]
    if found.shape != shape or found.dtype != np.float32:
        raise DamagedFileError(f"{name} must be float32{shape}, got {found.dtype}{found.shape}")
    return found
