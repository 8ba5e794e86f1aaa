"""The rate limit, as the shield and the planner keep it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

from koz_jax.config.shield import ShieldConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.base import Memoryless
from koz_jax.control.planning.path_planner import PathPlanner
from koz_jax.control.shield.filter import under_shield
from koz_jax.evaluation.rollout import run_case
from koz_jax.task import dynamics
from koz_jax.task.environment import Reorientation
from koz_jax.task.state import EnvState, Model

LIMIT_DEG = 5.0
TASK = TaskConfig(
    spread=SpreadConfig(spacecraft=True, step_shares=(0.02, 0.05), max_rate_deg=(LIMIT_DEG, LIMIT_DEG)),
    episode_seconds=100.0,
)


class SpinUp(Memoryless):
    """Asks for whatever makes the body turn faster, and where it is at rest for a turn about x."""

    def decide(self, state: EnvState, model: Model, memory: None) -> tuple[jax.Array, None]:
        """Action (3,), at the end of the box along the rate."""
        return jnp.where(jnp.sign(state.body.omega_BN_B) >= 0.0, 1.0, -1.0), memory


def largest_rate(inertia: np.ndarray, omega: np.ndarray) -> float:
    """Largest rate with the momentum and the energy of a rate: a linear programme in the squared components."""
    moments, axes = np.linalg.eigh(inertia)
    own = axes.T @ omega
    kept = np.stack([moments**2, moments])
    found = optimize.linprog(-np.ones(3), A_eq=kept, b_eq=kept @ own**2)
    return float(np.sqrt(-found.fun))


def test_the_form_is_the_largest_rate_with_the_same_momentum_and_energy():
    for number in range(200):
        rng = np.random.default_rng(number)
        second = rng.uniform(0.05, 1.0, 3)
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        inertia = turn @ np.diag(second.sum() - second) @ turn.T
        omega = rng.normal(size=3)
        form = np.asarray(dynamics.peak_rate_form(jnp.float32(inertia)), np.float64)
        assert np.sqrt(omega @ form @ omega) == pytest.approx(largest_rate(inertia, omega), rel=1e-4)


@pytest.mark.slow
def test_whoever_asks_for_more_is_kept_below_the_limit():
    """Random spacecraft, spun up for a whole maneuver: the limit is reached, and never passed by more than 1 %."""

    def peak_rates(shield: ShieldConfig | None) -> np.ndarray:
        def one(key: jax.Array) -> jax.Array:
            env = under_shield(Reorientation.from_config(TASK).drawn(key).replace(episode_steps=300), shield)
            return run_case(env, SpinUp(), env.sample(key), key=key).peak_rate

        return np.rad2deg(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(0), 32)))

    free, kept = peak_rates(None), peak_rates(ShieldConfig())
    assert np.all(free > 2.0 * LIMIT_DEG)
    assert np.all(kept <= 1.01 * LIMIT_DEG)
    assert np.mean(kept) > 0.7 * LIMIT_DEG


@pytest.mark.slow
def test_the_planner_keeps_the_limit_and_arrives():
    @jax.jit
    def flights(keys: jax.Array) -> tuple[jax.Array, jax.Array]:
        def one(key: jax.Array) -> tuple[jax.Array, jax.Array]:
            env = Reorientation.from_config(TASK).drawn(key).replace(episode_steps=1000)
            found = run_case(env, PathPlanner(candidates=8, rounds=2), env.sample(key), key=key)
            return found.peak_rate, found.settled

        return jax.vmap(one)(keys)

    peaks, settled = flights(jax.random.split(jax.random.key(0), 16))
    assert np.all(np.rad2deg(peaks) <= 1.01 * LIMIT_DEG)
    assert np.all(settled)
