"""What controller and shield do not know: another inertia, a disturbance torque, errors of sensors, a delay."""

import jax
import jax.numpy as jnp
from flax import struct

from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.task import rotations
from koz_jax.task.state import EnvState, Model, Truth


class Uncertainty(struct.PyTreeNode):
    """How far the truth may be from the model; every error is bounded.  Traced."""

    inertia_error: jax.Array  # () largest relative error of the inertia about any axis
    disturbance: jax.Array  # () [N m] norm of a constant torque from outside, its direction in body axes random
    attitude_noise: jax.Array  # () [rad] standard deviation per axis of the measured attitude, cut at 3 times that
    rate_noise: jax.Array  # () [rad/s] standard deviation per axis of the measured rate, cut at 3 times that
    attitude_bias: jax.Array  # () [rad] constant error of the measured attitude, about a random axis
    rate_bias: jax.Array  # () [rad/s] norm of a constant error of the measured rate
    delay: jax.Array | None = None  # () int32, steps by which the torque comes late; None: never

    def without_errors(self, nominal: jax.Array) -> "Uncertainty":
        """The same, or none of it in a nominal maneuver.  nominal: () bool."""
        return jax.tree.map(lambda bound: jnp.where(nominal, jnp.zeros_like(bound), bound), self)


# Noise is a normal distribution cut at so many standard deviations, so that a bound exists.
NOISE_BOUND = 3.0

# Separates the keys of a maneuver's biases from those of its steps.
_BIAS = 0x80000000


def sample_truth(uncertainty: Uncertainty, model: Model, key: jax.Array) -> Truth:
    """Draw the spacecraft that is really flown.

    The true inertia is L (1 + E) L^T with L L^T the model's and E symmetric with spectral norm ``inertia_error``, the
    worst that the bound allows.
    """
    key_inertia, key_disturbance = jax.random.split(key)
    raw = jax.random.normal(key_inertia, (3, 3))
    symmetric = raw + raw.T
    error = uncertainty.inertia_error * symmetric / jnp.max(jnp.abs(jnp.linalg.eigvalsh(symmetric)))
    root = jnp.linalg.cholesky(model.inertia_B)
    inertia_B = root @ (jnp.eye(3) + error) @ root.T
    direction_B = rotations.normalize(jax.random.normal(key_disturbance, (3,)))
    return Truth(inertia_B, uncertainty.disturbance * direction_B, uncertainty.delay)


def add_sensor_errors(uncertainty: Uncertainty, state: EnvState, key: jax.Array) -> EnvState:
    """What sensors make of the state: attitude and rate with noise and bias, and what follows from them.

    key: () typed PRNG key of the maneuver; the noise is another at every step of it.
    """
    key_attitude, key_rate = jax.random.split(jax.random.fold_in(key, state.steps))
    key_attitude_bias, key_rate_bias = jax.random.split(jax.random.fold_in(key, _BIAS))

    def error(key: jax.Array, deviation: jax.Array, key_bias: jax.Array, bias: jax.Array) -> jax.Array:
        noise = deviation * jax.random.truncated_normal(key, -NOISE_BOUND, NOISE_BOUND, (3,))
        return noise + bias * rotations.normalize(jax.random.normal(key_bias, (3,)))

    turn_B = error(key_attitude, uncertainty.attitude_noise, key_attitude_bias, uncertainty.attitude_bias)
    small = rotations.normalize(jnp.concatenate([jnp.ones(1), 0.5 * turn_B]))
    body = state.body.replace(
        q_BN=rotations.normalize(rotations.multiply(state.body.q_BN, small)),
        omega_BN_B=state.body.omega_BN_B
        + error(key_rate, uncertainty.rate_noise, key_rate_bias, uncertainty.rate_bias),
    )
    return state.replace(body=body)


def from_config(config: UncertaintyConfig) -> Uncertainty:
    """Settings in degrees to radians, traced."""
    return Uncertainty(
        inertia_error=jnp.float32(config.inertia_error),
        disturbance=jnp.float32(config.disturbance_torque),
        attitude_noise=jnp.deg2rad(jnp.float32(config.attitude_noise_deg)),
        rate_noise=jnp.deg2rad(jnp.float32(config.rate_noise_deg)),
        attitude_bias=jnp.deg2rad(jnp.float32(config.attitude_bias_deg)),
        rate_bias=jnp.deg2rad(jnp.float32(config.rate_bias_deg)),
        delay=jnp.int32(config.delay_steps) if config.delay_steps else None,
    )
