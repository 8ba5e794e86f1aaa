"""Random maneuver files of every kind, in the format of docs/maneuvers.md.

Spacecraft and cones are those of ``koz evaluate`` for random spacecraft, made larger or smaller, faster or slower, and
turned to somewhere else.
"""

import dataclasses
import functools
import json
from collections.abc import Callable, Sequence
from typing import Any, Literal

import jax
import numpy as np

from koz_jax.config import attitudes
from koz_jax.config.maneuvers.maneuver_tables import BodyConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.task.actuators import ReactionWheels
from koz_jax.task.environment import Reorientation
from koz_jax.task.scenario import Scenario, ScenarioRanges
from koz_jax.task.state import Model, nominal_limits

STEPS = 800  # of every maneuver, so that flights of a kind share a compiled program
_STEP_SHARES = (0.012, 0.05)  # of T; the shortest leave too little time for some maneuvers
_TUMBLING, _SLOWEST_LIMIT, _FASTEST_LIMIT = 0.1, 0.3, 2.0  # [1/T] rates
_SLOWEST_CONE, _FASTEST_CONE = 1e-3, 1e-2  # [1/T]
_KEPT_IN = np.pi / 4.0  # [rad] cones of larger half angles are drawn only to keep an instrument in the others


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a compiled flight depends on; all else is mixed within a kind."""

    wheels: Literal["three", "pyramid"] | None
    limited: bool  # whether there is a limit of the rate
    instruments: int
    cones: int
    turning: bool  # whether cones turn
    shield: bool

    def __str__(self) -> str:
        actuators = {None: "box", "three": "three wheels", "pyramid": "four wheels"}[self.wheels]
        cones = f"{self.cones} {'turning ' if self.turning else ''}cone{'s' if self.cones > 1 else ''}"
        instruments = f"{self.instruments} instrument{'s' if self.instruments > 1 else ''}"
        more = [text for text, is_so in (("rate limit", self.limited), ("shield", self.shield)) if is_so]
        return ", ".join([actuators, instruments, cones, *more])


KINDS = (
    Kind(None, False, 1, 1, False, True),
    Kind(None, True, 1, 2, False, False),
    Kind(None, False, 3, 3, False, True),
    Kind(None, True, 3, 4, True, True),
    Kind("three", False, 1, 1, True, True),
    Kind("three", True, 2, 2, False, True),
    Kind("three", False, 2, 3, True, False),
    Kind("three", True, 3, 4, False, False),
    Kind("pyramid", False, 1, 1, False, False),
    Kind("pyramid", True, 1, 2, True, True),
    Kind("pyramid", False, 3, 4, True, True),
    Kind("pyramid", True, 2, 3, False, True),
)


@dataclasses.dataclass(frozen=True)
class Size:
    """Factors from the spacecraft that was drawn, which has the paper's trace and strength, to the one of a file."""

    inertia: float
    time: float

    @property
    def torque(self) -> float:
        """Of torques."""
        return self.inertia / self.time**2

    @property
    def momentum(self) -> float:
        """Of momenta."""
        return self.inertia / self.time

    @property
    def time_unit(self) -> float:
        """T [s]."""
        return SpacecraftConfig().time_unit * self.time


def draw(kind: Kind, seeds: tuple[int, ...]) -> str | None:
    """Draw a maneuver.  Returns the text of a file; None where fewer cones find a place than the kind has."""
    rng = np.random.default_rng(seeds)
    model, ranges, scenario = jax.tree.map(np.asarray, _drawer(kind)(jax.random.key(rng.integers(2**31))))
    if not np.all(scenario.constraints.is_present):
        return None
    size = Size(10.0 ** rng.uniform(-3.0, 1.0), 10.0 ** rng.uniform(-0.3, 1.0))
    body = _spacecraft(kind, model, size, rng)
    step_seconds = float(size.time * model.dt)
    told: dict[str, Any] = {"name": str(kind)}
    if rng.random() < 0.5:
        told["duration_seconds"] = STEPS * step_seconds
    else:
        # As long as a file lasts that does not say it.
        step_seconds = 10.0 * np.ceil(0.5 * BodyConfig.model_validate(body).half_turns[0]) / STEPS
    told |= {"step_seconds": step_seconds, "spacecraft": body}
    return toml(told | _maneuver(kind, ranges, scenario, size, rng))


@functools.cache
def _drawer(kind: Kind) -> Callable[[jax.Array], tuple[Model, ScenarioRanges, Scenario]]:
    several = {"instruments": kind.instruments, "keep_in": 0.5} if kind.instruments > 1 else {}
    spread = SpreadConfig.model_validate(
        {"spacecraft": True, "wheels": kind.wheels, "zones": (kind.cones, kind.cones), "step_shares": _STEP_SHARES}
        | several
    )
    env = Reorientation.from_config(TaskConfig(spread=spread))

    @jax.jit
    def drawn(key: jax.Array) -> tuple[Model, ScenarioRanges, Scenario]:
        own = env.drawn(key)
        return own.model, own.ranges, own.sample(jax.random.fold_in(key, 1))

    return drawn


def _spacecraft(kind: Kind, model: Model, size: Size, rng: np.random.Generator) -> dict[str, Any]:
    inertia = size.inertia * np.asarray(model.inertia_B, np.float64)
    body: dict[str, Any] = {"inertia": (0.5 * (inertia + inertia.T)).tolist()}
    if kind.limited:
        body["max_rate_deg"] = _rate_deg(rng, _SLOWEST_LIMIT, _FASTEST_LIMIT, size)
    if isinstance(model.actuators, ReactionWheels):
        made = model.actuators
        columns = {
            "axis": made.axes_B,
            "max_torque": size.torque * made.max_torque,
            "max_momentum": size.momentum * made.max_momentum,
            "momentum": size.momentum * made.momentum,
        }
        body["wheels"] = [
            {name: np.asarray(column)[wheel].tolist() for name, column in columns.items()}
            for wheel in range(len(made.max_torque))
        ]
    else:
        limits = size.torque * np.asarray(nominal_limits(model).box_B)
        body["torque_limit"] = limits.tolist() if rng.random() < 0.5 else float(np.mean(limits))
    return body


def _rate_deg(rng: np.random.Generator, slowest: float, fastest: float, size: Size) -> float:
    """A rate [deg/s], even over its logarithm.  slowest, fastest: [1/T]."""
    return float(np.rad2deg(slowest * (fastest / slowest) ** rng.uniform() / size.time_unit))


def _maneuver(
    kind: Kind, ranges: ScenarioRanges, scenario: Scenario, size: Size, rng: np.random.Generator
) -> dict[str, Any]:
    looks_B = [ranges.boresight_B, *(() if ranges.others_B is None else ranges.others_B)]
    turn = _direction(rng, 4)
    start = attitudes.multiply(turn, np.asarray(scenario.initial.q_BN))
    told: dict[str, Any] = {
        "instruments": [{"name": f"i{number}", "boresight": look_B.tolist()} for number, look_B in enumerate(looks_B)],
        "constraints": _constraints(kind, np.array(looks_B), scenario, turn, size, rng),
        "start": {"attitude": (rng.choice([-1.0, 1.0]) * start).tolist()},
    }
    if rng.random() < 0.5:
        told["start"]["rate_deg"] = (np.rad2deg(_TUMBLING / size.time_unit) * rng.uniform(-1.0, 1.0, 3)).tolist()
    if rng.random() < 0.5:
        which = int(rng.integers(len(looks_B)))
        towards = attitudes.rotate(turn, np.asarray(looks_B[which]))
        return told | {"target": {"instrument": f"i{which}", "direction": towards.tolist()}}
    return told | {"target": {"attitude": (rng.choice([-1.0, 1.0]) * turn).tolist()}}


def _constraints(
    kind: Kind, looks_B: np.ndarray, scenario: Scenario, turn: np.ndarray, size: Size, rng: np.random.Generator
) -> list[dict[str, Any]]:
    """Tables of cones, in any order; of those of a kind that turn, the first does."""
    cones = scenario.constraints
    told = []
    for number in rng.permutation(kind.cones):
        distance = np.linalg.norm(looks_B - cones.boresight_B[number], axis=1)
        axis, half_angle = attitudes.rotate(turn, np.asarray(cones.axis_N[number])), float(cones.half_angle[number])
        one: dict[str, Any] = {"instrument": f"i{int(np.argmin(distance))}"}
        if half_angle > _KEPT_IN:
            one["kind"], axis, half_angle = "keep_in", -axis, np.pi - half_angle
        one |= {"direction": axis.tolist(), "half_angle_deg": float(np.rad2deg(half_angle))}
        if kind.turning and (not told or rng.random() < 0.5):
            one["rotation_deg"] = (_rate_deg(rng, _SLOWEST_CONE, _FASTEST_CONE, size) * _direction(rng, 3)).tolist()
        told.append(one)
    return told


def _direction(rng: np.random.Generator, entries: int) -> np.ndarray:
    return attitudes.normalized(rng.normal(size=entries))


def toml(table: dict[str, Any], path: Sequence[str] = ()) -> str:
    """A table as TOML: numbers, text and lists of them, then tables and lists of tables."""
    lines, below = [], []
    for key, value in table.items():
        name = ".".join((*path, key))
        if isinstance(value, dict):
            below.append(f"\n[{name}]\n{toml(value, (*path, key))}")
        elif isinstance(value, list) and isinstance(value[0], dict):
            below += [f"\n[[{name}]]\n{toml(each, (*path, key))}" for each in value]
        else:
            lines.append(f"{key} = {json.dumps(value)}\n")
    return "".join([*lines, *below])
