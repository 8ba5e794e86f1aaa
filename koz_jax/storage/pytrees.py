"""Pytrees as arrays by name.  jax is imported by the functions that need it, so that agents can be read without it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from koz_jax.errors import DamagedFileError


def named_leaves(tree: Any) -> dict[str, Any]:
    """Leaves by their path in the tree, such as ``learner/policy/params/kernel``."""
    import jax

    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _is_key(leaf: Any) -> bool:
    import jax
    import jax.numpy as jnp

    return hasattr(leaf, "dtype") and jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


def key_data(tree: Any) -> Any:
    """Replace typed PRNG keys by their data."""
    import jax

    return jax.tree.map(lambda leaf: jax.random.key_data(leaf) if _is_key(leaf) else leaf, tree)


def to_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Copy a tree to the host: arrays by name, typed PRNG keys as their data.

    A view would not do: the memory of a state is used again as soon as training goes on.
    """
    return {name: np.array(leaf) for name, leaf in named_leaves(key_data(tree)).items()}


def from_arrays(arrays: Mapping[str, np.ndarray], template: Any, path: Path) -> Any:
    """Make a tree with the structure of ``template`` from arrays by name.  path: where they come from, for messages."""
    import jax
    import jax.numpy as jnp

    wanted = named_leaves(template)
    if wanted.keys() != arrays.keys():
        missing, extra = sorted(wanted.keys() - arrays.keys()), sorted(arrays.keys() - wanted.keys())
        raise DamagedFileError(
            f"{path}: holds other arrays than expected: missing {missing[:3]}, unexpected {extra[:3]}"
        )
    leaves = []
    for name, leaf in wanted.items():
        stored = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        found = arrays[name]
        if found.shape != stored.shape or found.dtype != stored.dtype:
            raise DamagedFileError(
                f"{path}: {name} must be {stored.dtype}{stored.shape}, got {found.dtype}{found.shape}"
            )
        array = jnp.asarray(found)
        leaves.append(jax.random.wrap_key_data(array) if _is_key(leaf) else array)
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
