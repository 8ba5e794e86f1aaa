"""Units and names as figures and pages write them.  Draws nothing."""

import dataclasses
from pathlib import Path

from koz_jax.evaluation.digits import significant


@dataclasses.dataclass(frozen=True)
class Unit:
    """A unit in which values are shown."""

    name: str
    factor: float  # from the SI value to the shown one

    def __call__(self, value: float) -> str:
        """Write an SI value with three digits or more, and its unit."""
        return f"{significant(self.factor * value, 0)} {self.name}"


# The first whose least value is reached is taken; [N m] and [N^2 m^2 s].
_TORQUE = ((0.1, Unit("N m", 1.0)), (1e-4, Unit("mN m", 1e3)), (0.0, Unit("µN m", 1e6)))
_EFFORT = ((0.01, Unit("N² m² s", 1.0)), (1e-8, Unit("(mN m)² s", 1e6)), (0.0, Unit("(µN m)² s", 1e12)))


def torque_unit(limits: tuple[float, ...]) -> Unit:
    """Choose the unit of torques by what the actuators can do.  limits: [N m]."""
    return next(unit for least, unit in _TORQUE if max(limits) >= least)


def effort_unit(largest: float) -> Unit:
    """Choose the unit of control efforts by the largest of them [N^2 m^2 s]; zero and nan have the SI unit."""
    if not largest > 0.0:
        return _EFFORT[0][1]
    return next(unit for least, unit in _EFFORT if largest >= least)


def short_name(agent: str) -> str:
    """Name of an agent for a title: a shipped one's own, or the last part of a folder."""
    return Path(agent).resolve().name or agent
