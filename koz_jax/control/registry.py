"""Controllers by name: the built-in ones, and any class in a file of one's own.  Imports jax only to load one."""

from __future__ import annotations

import dataclasses
import importlib
import inspect
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from koz_jax.config.task import TaskConfig
from koz_jax.errors import SettingsError

if TYPE_CHECKING:
    from koz_jax.control.base import Controller, TaskController


class BuiltIn(NamedTuple):
    """Where a built-in controller is, and what it is for."""

    module: str  # in koz_jax.control
    class_name: str
    adversarial: bool = False  # does its worst, to try the shield
    learned: bool = False  # has weights of a training in place of gains


BUILT_IN = {
    "pd": BuiltIn("quaternion_feedback", "QuaternionFeedback"),
    "potential": BuiltIn("potential", "PotentialFeedback"),
    "sliding": BuiltIn("sliding_mode", "PotentialSliding"),
    "lee_mesbahi_pd": BuiltIn("published.lee_mesbahi", "LeeMesbahiPD"),
    "lee_mesbahi_backstepping": BuiltIn("published.lee_mesbahi", "LeeMesbahiBackstepping"),
    "yang_sliding": BuiltIn("published.yang_sliding", "YangSliding"),
    "planner": BuiltIn("planning.path_planner", "PathPlanner"),
    "icosphere_astar": BuiltIn("planning.icosphere_astar", "IcosphereAStar"),
    "mrp_astar": BuiltIn("planning.mrp_astar", "MRPAStar"),
    "rrt": BuiltIn("planning.rrt", "RRT"),
    "dqn": BuiltIn("slews.dqn_slews", "DqnSlews", learned=True),
    "random": BuiltIn("adversarial", "Random", adversarial=True),
    "bang_bang": BuiltIn("adversarial", "BangBang", adversarial=True),
    "adversary": BuiltIn("adversarial", "Adversary", adversarial=True),
    "spin_up": BuiltIn("adversarial", "SpinUp", adversarial=True),
}

CLASSICAL = tuple(name for name, entry in BUILT_IN.items() if not (entry.adversarial or entry.learned))
LEARNED = tuple(name for name, entry in BUILT_IN.items() if entry.learned)
ADVERSARIAL = tuple(name for name, entry in BUILT_IN.items() if entry.adversarial)


@dataclasses.dataclass(frozen=True)
class NamedController:
    """A controller that needs no training, with a name and a task: a ``TaskController``."""

    name: str
    controller: Controller
    task: TaskConfig


def load_controller(name: str, task: TaskConfig | None = None) -> NamedController:
    """Make a controller with its default gains.

    name: of a built-in one, or ``path/to/file.py:ClassName`` for a class of one's own, which is made without arguments
        and called by the name of the class.
    task: the task that it flies unless told otherwise; by default the paper's.

    Raises:
        SettingsError: there is no such controller, or it cannot fly; the message lists what is allowed.

    """
    flown = task or TaskConfig()
    if ":" in name or name.endswith(".py"):
        from koz_jax.control import from_file

        path, _, class_name = name.rpartition(":")
        return NamedController(class_name, from_file.load(path, class_name, flown), flown)
    if name not in BUILT_IN:
        raise SettingsError(f"controller: must be one of {', '.join(BUILT_IN)}, or FILE.py:CLASS; got {name!r}")
    entry = BUILT_IN[name]
    made = getattr(importlib.import_module(f"koz_jax.control.{entry.module}"), entry.class_name)
    return NamedController(name, made(), flown)


def as_task_controller(given: TaskController | Controller, task: TaskConfig | None = None) -> TaskController:
    """Give a bare controller a name and a task; one of somebody else's making is tried before it flies.

    given: a ``TaskController``, such as an agent, or a controller; task: the one that it flies, by default its own or
        the paper's.

    Raises:
        SettingsError: it is neither, or it cannot fly.

    """
    if isinstance(given, type):
        raise SettingsError(f"agent: must be an object, got the class {given.__name__}; give {given.__name__}()")
    flying: Any = given
    if not all(hasattr(given, name) for name in ("name", "task", "controller")):
        if not hasattr(given, "decide"):
            raise SettingsError(
                f"agent: must be an agent (load_agent), a controller (load_controller), or an object with the methods"
                f" begin and decide; got {type(given).__name__}"
            )
        flying = NamedController(type(given).__name__, cast("Controller", given), task or TaskConfig())
    kind = type(flying.controller)
    if kind.__module__.partition(".")[0] != "koz_jax":
        from koz_jax.control import trial

        trial.check(flying.controller, kind.__name__, _source(kind), task or flying.task)
    return flying


def _source(kind: type) -> str:
    """File of a class; empty where it has none."""
    try:
        return inspect.getsourcefile(kind) or ""
    except (OSError, TypeError):
        return ""
