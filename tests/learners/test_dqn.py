"""Double DQN: updates against NumPy float64, and a problem with known answers."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.reference import COUNT, adam, as_float64, assert_close, encoded, make_batch, mlp, slopes

from koz_jax.learners.dqn import Dqn
from koz_jax.sac.losses import Batch

DQN = Dqn(hidden_sizes=(6, 5), encoding=((0, 2, 0.3),), observation_size=3, actions=4, soft_update=0.05, average=0.1)
RATE = 0.02

_update = jax.jit(Dqn.update, static_argnums=0)


def with_choices(batch, seed):
    return batch.replace(action=jax.random.randint(jax.random.key(seed), (COUNT,), 0, DQN.actions))


def values(params, observation):
    return mlp(params["params"]["Mlp_0"], encoded(observation))


def reference_update(learner, batch, rate):
    old, batch, rows = as_float64(learner), as_float64(batch), np.arange(COUNT)
    choice = batch.action.astype(int)
    best = np.argmax(values(old.values, batch.next_observation), axis=1)
    target = batch.reward + batch.discount * values(old.target_values, batch.next_observation)[rows, best]

    def loss(params):
        return 0.5 * np.mean((values(params, batch.observation)[rows, choice] - target) ** 2)

    new, optimizer = adam(old.values, slopes(loss, old.values), old.optimizer, rate)

    def average(share, before):
        return jax.tree.map(lambda n, b: share * n + (1 - share) * b, new, before)

    return old.replace(
        values=new,
        averaged_values=average(DQN.average, old.averaged_values),
        target_values=average(DQN.soft_update, old.target_values),
        optimizer=optimizer,
    ), loss(old.values)


@pytest.mark.slow
def test_a_chain_of_updates_is_that_of_the_reference():
    found = DQN.init(jax.random.key(0))
    # Another network for the target: it must matter which of the two chooses, and which is asked for the value.
    found = found.replace(target_values=DQN.init(jax.random.key(1)).values)
    expected = as_float64(found)
    for i in range(3):
        batch = with_choices(make_batch(i), i)
        found, loss = _update(DQN, found, batch, RATE)
        expected, wanted = reference_update(expected, batch, RATE)
        assert loss == pytest.approx(wanted, rel=1e-4)
        assert_close(found, expected, rtol=1e-4, atol=1e-5)


def test_a_share_of_actions_is_at_random():
    learner, observation = DQN.init(jax.random.key(0)), make_batch(0).observation
    many = jnp.tile(observation, (2000, 1))
    best = np.argmax(values(as_float64(learner.values), as_float64(many)), axis=1)
    for share in (0.0, 0.4, 1.0):
        found = np.asarray(jax.jit(Dqn.explore, static_argnums=0)(DQN, learner, many, jax.random.key(1), share))
        # One in four of those at random happens to be the best.
        assert np.mean(found == best) == pytest.approx(1.0 - 0.75 * share, abs=0.02)
        assert set(np.unique(found)) <= set(range(4))


@pytest.mark.slow
def test_values_of_a_walk_are_the_steps_that_are_left():
    """Places 0 to 4 on a line, of which 4 ends the walk; back, stay, on; each step costs one."""
    walk = Dqn(hidden_sizes=(32, 32), encoding=(), observation_size=1, actions=3, soft_update=0.05, average=0.02)
    gamma = 0.9

    @functools.partial(jax.jit, static_argnums=0)
    def learn(algorithm, key):
        def body(learner, inputs):
            key, rate = inputs
            place, choice = jax.random.randint(key, (2, 64), 0, jnp.array([[4], [3]]))
            after = jnp.clip(place + choice - 1, 0, 4)
            discount = jnp.where(after == 4, 0.0, gamma)
            batch = Batch(_seen(place), choice, -jnp.ones(64), discount, _seen(after))
            return algorithm.update(learner, batch, rate)

        rates = jnp.linspace(5e-3, 0.0, 2000)
        return jax.lax.scan(body, algorithm.init(key), (jax.random.split(key, 2000), rates))[0]

    learner = learn(walk, jax.random.key(0))
    found = walk.value(learner.averaged_values, _seen(jnp.arange(4)))
    left = -(1.0 - gamma ** np.arange(5.0)) / (1.0 - gamma)  # by steps that are left
    expected = [[-1.0 + gamma * left[4 - np.clip(place + way, 0, 4)] for way in (-1, 0, 1)] for place in range(4)]
    np.testing.assert_allclose(found, expected, atol=0.1)


def _seen(place):
    return place[:, None] / 2.0 - 1.0
