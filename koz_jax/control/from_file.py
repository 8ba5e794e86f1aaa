"""A controller of one's own: load its class from a Python file, and say in a line why it cannot fly."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from koz_jax.config.task import TaskConfig
from koz_jax.control import trial
from koz_jax.control.base import Controller
from koz_jax.errors import SettingsError


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
        raise SettingsError(
            f"controller: {name} cannot be made without arguments: {trial.in_a_line(error, path)}"
        ) from error
    trial.check(made, name, path, task)
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
        raise SettingsError(f"controller: {path}: cannot be imported: {trial.in_a_line(error, str(path))}") from error
    return module
