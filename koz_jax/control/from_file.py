"""A controller of one's own: load its class from a Python file, and say in a line why it cannot fly."""

import importlib.util
import sys
import traceback
from pathlib import Path
from types import ModuleType
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


def load(path: str, class_name: str, task: TaskConfig) -> Controller:
    """Make an instance of a controller class without arguments, and try it on a task without flying it.

    Raises:
        SettingsError: there is no such class, or its instances are no controllers.

    """
    if not path or not class_name:
        raise SettingsError(f"controller: must be FILE.py:CLASS, got {path or class_name}")
    name = f"{path}:{class_name}"
    kind = _class(Path(path), class_name)
    try:
        made = kind()
    except Exception as error:
        raise SettingsError(f"controller: {name} cannot be made without arguments: {_told(error, path)}") from error
    if jax.tree_util.all_leaves([made]):
        raise SettingsError(f"controller: {name} must be a pytree; derive it from {_BASES}")
    for method in ("begin", "decide"):
        if not callable(getattr(made, method, None)):
            raise SettingsError(f"controller: {name} has no method {method}; see koz_jax.control.base.Controller")
    _try(made, name, path, task)
    return made


def _class(path: Path, class_name: str) -> type[Any]:
    """Import a file, and find a class in it."""
    if not path.is_file():
        raise SettingsError(f"controller: {path}: no such file")
    module = _imported(path)
    kind = getattr(module, class_name, None)
    if not isinstance(kind, type):
        own = [name for name, value in vars(module).items() if _is_own_class(value, module)]
        raise SettingsError(f"controller: {path} has no class {class_name!r}; it has {', '.join(own) or 'none'}")
    return kind


def _is_own_class(value: Any, module: ModuleType) -> bool:
    return isinstance(value, type) and value.__module__ == module.__name__


def _imported(path: Path) -> ModuleType:
    module_name = f"koz_jax_controller_{path.stem}"
    spec = importlib.util.spec_from_file_location(module_name, path)
    if spec is None or spec.loader is None:
        raise SettingsError(f"controller: {path}: must be a Python file, named *.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[module_name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise SettingsError(f"controller: {path}: cannot be imported: {_told(error, str(path))}") from error
    return module


def _try(made: Controller, name: str, path: str, task: TaskConfig) -> None:
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
        raise SettingsError(f"controller: {name} cannot decide: {_told(error, path)}") from error
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


def _told(error: Exception, path: str) -> str:
    """An error of somebody else's code in a line."""
    lines = str(error).splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}{_line(error, path)}"


def _line(error: Exception, path: str) -> str:
    """The line of a file that an error comes from, if it does."""
    file = Path(path).absolute()
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if Path(frame.filename) == file]
    return f" ({path}, line {frames[-1].lineno})" if frames else ""
