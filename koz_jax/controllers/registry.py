"""Controllers by name: the classical ones, and the rogues that try the shield.  Imports jax only to load one."""

from __future__ import annotations

import dataclasses
import importlib
from typing import TYPE_CHECKING

from koz_jax.errors import UserError
from koz_jax.task_config import TaskConfig

if TYPE_CHECKING:
    from koz_jax.controllers.base import Controller

_CLASSES = {
    "pd": ("pd", "QuaternionFeedback"),
    "potential": ("potential", "PotentialFeedback"),
    "sliding": ("sliding", "PotentialSliding"),
    "planner": ("planner", "PathPlanner"),
    "random": ("rogues", "Random"),
    "bang_bang": ("rogues", "BangBang"),
    "adversary": ("rogues", "Adversary"),
    "spin_up": ("rogues", "SpinUp"),
}

CLASSICAL = ("pd", "potential", "sliding", "planner")
ROGUES = ("random", "bang_bang", "adversary", "spin_up")


@dataclasses.dataclass(frozen=True)
class NamedController:
    """A controller that needs no training, with a name and a task: a ``Pilot``."""

    name: str
    controller: Controller
    task: TaskConfig


def load_controller(name: str, task_config: TaskConfig | None = None) -> NamedController:
    """Make a controller with its default gains.

    task_config: the task that it flies unless told otherwise; by default the paper's.

    Raises:
        UserError: there is no such controller; the message lists what is allowed.

    """
    if name not in _CLASSES:
        raise UserError(f"controller: must be one of {', '.join(_CLASSES)}; got {name!r}")
    module, class_name = _CLASSES[name]
    made = getattr(importlib.import_module(f"koz_jax.controllers.{module}"), class_name)
    return NamedController(name, made(), task_config or TaskConfig())
