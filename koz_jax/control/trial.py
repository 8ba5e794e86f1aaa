"""Whether a controller of one's own can fly: it is traced over one decision, and a line says why it cannot."""

import traceback
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from koz_jax.config.task import TaskConfig
from koz_jax.control.base import Controller
from koz_jax.errors import SettingsError
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ACTION_SIZE
from koz_jax.task.scenario import SamplingRule

_BASES = "koz_jax.control.base.Memoryless or flax.struct.PyTreeNode"


def check(made: Any, name: str, path: str, task: TaskConfig) -> None:
    """Try a controller on a task without flying it.

    name: for messages; path: file of its class, for the line that an error comes from.

    Raises:
        SettingsError: it is no controller, or cannot decide.

    """
    if jax.tree_util.all_leaves([made]):
        raise SettingsError(f"controller: {name} must be a pytree; derive it from {_BASES}")
    for method in ("begin", "decide"):
        if not callable(getattr(made, method, None)):
            raise SettingsError(f"controller: {name} has no method {method}; see koz_jax.control.base.Controller")
    _decide(made, name, path, task)


def _decide(made: Controller, name: str, path: str, task: TaskConfig) -> None:
    """Trace the first decision of a maneuver."""
    # This rule leaves a zone out where there is no room for one.
    env = Reorientation.from_config(task, rule=SamplingRule("shrink"))

    def decide(made: Controller, key: jax.Array) -> tuple[Any, Any, Any]:
        state = env.reset(key)
        memory = made.begin(state, env.model, key)
        action, after = made.decide(state, env.model, memory)
        return jnp.asarray(action), memory, after

    try:
        action, before, after = jax.eval_shape(decide, made, jax.random.key(0))
    except jax.errors.TracerArrayConversionError as error:
        raise SettingsError(
            f"controller: {name} cannot be traced: it gives arrays of jax to NumPy; use jax.numpy in place of numpy"
            f"{_line(error, path)}"
        ) from error
    except jax.errors.ConcretizationTypeError as error:
        raise SettingsError(
            f"controller: {name} cannot be traced: it branches on a value (if, while, int, float); use jax.numpy.where"
            f" or jax.lax.cond{_line(error, path)}"
        ) from error
    except Exception as error:
        raise SettingsError(f"controller: {name} cannot decide: {in_a_line(error, path)}") from error
    if action.shape != (ACTION_SIZE,) or not jnp.issubdtype(action.dtype, jnp.floating):
        raise SettingsError(
            f"controller: the action of {name} must be {ACTION_SIZE} real numbers in [-1, 1], got shape {action.shape}"
            f" of {action.dtype}"
        )
    if _shapes(before) != _shapes(after):
        raise SettingsError(
            f"controller: the memory of {name} must keep its shapes and types; begin makes {_named(before)}, decide"
            f" {_named(after)}"
        )


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]


def _named(tree: Any) -> str:
    return str(jax.tree.map(lambda leaf: f"{leaf.dtype}{list(leaf.shape)}", tree)).replace("'", "")


def in_a_line(error: Exception, path: str) -> str:
    """Put an error of somebody else's code into a line.  path: their file."""
    lines = str(error).splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}{_line(error, path)}"


def _line(error: Exception, path: str) -> str:
    """The line of a file that an error comes from, if it does."""
    file = Path(path).absolute()
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename) == file]
    return f" ({path}, line {frames[-1].lineno})" if frames else ""
