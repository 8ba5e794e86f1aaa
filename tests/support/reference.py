"""Pieces of a gradient update in NumPy float64 that share no code with the learners, for small networks.

Networks have two hidden layers; they see an observation (n, 3), and the first two entries of it at the scale 0.3.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax

from koz_jax.sac.losses import Batch

COUNT = 12
BETA_1, BETA_2, EPSILON = 0.9, 0.999, 1e-8


def make_batch(seed):
    draw = np.random.default_rng(seed)
    array = functools.partial(jnp.asarray, dtype=jnp.float32)
    return Batch(
        observation=array(draw.normal(size=(COUNT, 3))),
        action=array(draw.uniform(-1, 1, (COUNT, 2))),
        reward=array(draw.normal(size=COUNT)),
        discount=array(np.where(draw.random(COUNT) < 0.3, 0.0, 0.9)),
        next_observation=array(draw.normal(size=(COUNT, 3))),
    )


def encoded(observation):
    return np.concatenate([observation, np.tanh(observation[:, 0:2] / 0.3)], axis=1)


def mlp(net, x):
    for i in range(3):
        x = x @ net[f"Dense_{i}"]["kernel"] + net[f"Dense_{i}"]["bias"]
        x = np.maximum(x, 0.0) if i < 2 else x
    return x


def values(critic, observation, action):
    x = np.concatenate([encoded(observation), action], axis=1)
    return np.stack([mlp(critic["params"][name], x)[:, 0] for name in sorted(critic["params"])])


def slopes(loss, tree, h=1e-6):
    """Gradient of ``loss(tree)`` by central differences."""
    leaves, structure = jax.tree.flatten(tree)
    gradients = []
    for leaf in leaves:
        gradient = np.zeros_like(leaf)
        for at in np.ndindex(leaf.shape):
            old = leaf[at]
            leaf[at] = old + h
            above = loss(jax.tree.unflatten(structure, leaves))
            leaf[at] = old - h
            below = loss(jax.tree.unflatten(structure, leaves))
            leaf[at] = old
            gradient[at] = (above - below) / (2 * h)
        gradients.append(gradient)
    return jax.tree.unflatten(structure, gradients)


def adam(params, gradient, optimizer, rate):
    """Kingma and Ba's Adam with bias correction.  Returns the new parameters and optimizer state."""
    count = int(optimizer.count) + 1
    mu = jax.tree.map(lambda m, g: BETA_1 * m + (1 - BETA_1) * g, optimizer.mu, gradient)
    nu = jax.tree.map(lambda v, g: BETA_2 * v + (1 - BETA_2) * g**2, optimizer.nu, gradient)
    stepped = jax.tree.map(
        lambda p, m, v: p - rate * (m / (1 - BETA_1**count)) / (np.sqrt(v / (1 - BETA_2**count)) + EPSILON),
        params,
        mu,
        nu,
    )
    return stepped, optax.ScaleByAdamState(np.array(count), mu, nu)


def norm(tree):
    return np.sqrt(sum(np.sum(leaf**2) for leaf in jax.tree.leaves(tree)))


def as_float64(tree):
    return jax.tree.map(lambda x: np.array(x, np.float64), tree)


def assert_close(found, expected, **tolerance):
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for (path, leaf), wanted in zip(jax.tree.leaves_with_path(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(leaf, wanted, **tolerance, err_msg=jax.tree_util.keystr(path))
