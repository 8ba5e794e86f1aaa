"""Sliding mode: the surface is reached, and kept."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.states import MODEL, directions

from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.sliding_mode import PotentialSliding
from koz_jax.evaluation import cases
from koz_jax.task import rotations
from koz_jax.task.actuators import TorqueBox
from koz_jax.task.any_spacecraft import units
from koz_jax.task.environment import Reorientation


@pytest.mark.slow
def test_sliding_surface_is_reached_and_kept():
    """With strong actuators s decays at the rate of the reaching law, and stays small all the way to the target."""
    strong = MODEL.replace(actuators=TorqueBox(jnp.full(3, 60.0)), dt=jnp.float32(0.01))
    env = Reorientation.from_config().replace(model=strong)
    controller = PotentialSliding(torque_share=0.02, layer=1.0)
    draw = MonteCarloConfig(cases=8, seed=3)
    drawn = jax.vmap(lambda i: cases.draw_case(TaskConfig(), draw, i))(jnp.arange(8))

    def one(case, omega_B):
        start = env.reset(case.replace(initial=case.initial.replace(omega_BN_B=omega_B)))

        def advance(state, _):
            action, _ = controller.decide(state, strong, None)
            s_B = state.body.omega_BN_B - controller.wanted_rate(state, strong)
            return env.step(state, action).state, (rotations.norm(s_B), state.angle)

        return jax.lax.scan(advance, start, None, length=6000)[1]

    sizes, angles = map(np.asarray, jax.jit(jax.vmap(one))(drawn, 0.1 * directions(8, 7)))
    assert np.all(sizes[:, 0] > 0.05)
    reached = int(8.0 / controller.reach * units.of(strong).time / strong.dt)
    assert np.all(sizes[:, reached:] < 0.03)
    assert np.all(angles[:, -1] < 0.01)
