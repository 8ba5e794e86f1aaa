"""Settings of the task: spacecraft, reward, scenarios.  Angles in degrees; imports no jax."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Discriminator, Tag, model_validator

from koz_jax.config.actuators import gyros, wheels
from koz_jax.config.actuators.gyros import GyroConfig
from koz_jax.config.actuators.wheels import WheelConfig
from koz_jax.config.base import (
    HalfAngleDeg,
    NonNegativeFloat,
    PositiveFloat,
    PositiveVector,
    Settings,
    SettingsOfAgents,
    Vector,
    ZoneCount,
    check_steps,
    check_unit,
)
from koz_jax.config.spread import SpreadConfig
from koz_jax.errors import SettingsError


def _form(limit: Any) -> str:
    return "each_axis" if isinstance(limit, tuple | list) else "all_axes"


# Told apart by their form, so that a refusal is about the one that was meant.
TorqueLimit = Annotated[
    Annotated[PositiveFloat, Tag("all_axes")] | Annotated[PositiveVector, Tag("each_axis")], Discriminator(_form)
]


class SpacecraftConfig(SettingsOfAgents):
    """The spacecraft (section 2.5 of the paper)."""

    later: ClassVar = ("gyros",)

    inertia: tuple[Vector, Vector, Vector] = ((60.0, 5.0, 1.0), (5.0, 50.0, 2.0), (1.0, 2.0, 70.0))
    """Inertia tensor in body axes, row by row [kg m^2]."""
    boresight: Vector = (1.0, 0.0, 0.0)
    """Unit vector of the telescope in body axes."""
    torque_limit: TorqueLimit = 2.0
    """Largest torque about each body axis [N m]: one number for all, or one for each; of no effect beside wheels
    or gyros."""
    wheels: tuple[WheelConfig, ...] = ()
    """Reaction wheels, at least three: axis, largest torque [N m], largest momentum [N m s], and that at the start."""
    gyros: tuple[GyroConfig, ...] = ()
    """Control moment gyros in place of wheels, at least three, as of ``GyroConfig``."""
    max_rate_deg: PositiveFloat | None = None
    """Largest norm of the body rate [deg/s], for agents that keep one; None sets no limit."""

    @property
    def torque_limits(self) -> Vector:
        """Largest torque about each body axis [N m]; of wheels when the body is at rest, all axes at once."""
        if self.wheels:
            return wheels.torque_box(self.wheels)
        if self.gyros:
            return gyros.torque_box(self.gyros)
        limit = self.torque_limit
        return limit if isinstance(limit, tuple) else (limit, limit, limit)

    @property
    def brake_limits(self) -> Vector:
        """Of that, what can be braked with at any rate [N m]; wheels need the rest for their own momentum."""
        x, y, z = self.torque_limits
        share = wheels.BRAKE_SHARE if self.wheels else 1.0
        return share * x, share * y, share * z

    @property
    def time_unit(self) -> float:
        """T = sqrt(J / u) [s], J a third of the inertia's trace, u the strength."""
        return float(np.sqrt(np.trace(np.array(self.inertia)) / 3.0 / self.strength))

    @property
    def strength(self) -> float:
        """u [N m], the root mean square of the torque limits."""
        return float(np.sqrt(np.mean(np.square(self.torque_limits))))

    @model_validator(mode="after")
    def _physical(self) -> Self:
        wheels.check_span(self.wheels)
        gyros.check_span(self.gyros)
        if self.wheels and self.gyros:
            raise ValueError(
                f"gyros: must be none beside wheels; got {len(self.gyros)} gyros and {len(self.wheels)} wheels"
            )
        inertia = np.array(self.inertia)
        if not np.allclose(inertia, inertia.T, rtol=1e-6, atol=0.0):
            raise ValueError(f"inertia must be symmetric; got {self.inertia}")
        principal = np.linalg.eigvalsh(inertia)
        if principal[0] <= 0:
            raise ValueError(f"inertia must be positive definite; its principal moments are {principal.tolist()}")
        if principal[0] + principal[1] < principal[2] * (1 - 1e-6):
            raise ValueError(
                "inertia must obey the triangle inequality (no principal moment above the sum of the other two);"
                f" its principal moments are {principal.tolist()}"
            )
        check_unit("boresight", self.boresight)
        return self


class RewardConfig(SettingsOfAgents):
    """Constants of the reward (Eq. 7 to 9 of the paper)."""

    attitude_scale: PositiveFloat = 0.14 * 2 * np.pi
    """Scale of exp(-phi / scale) [rad]."""
    settled_angle_deg: PositiveFloat = 0.25
    """Accuracy asked for: the maneuver is settled while phi is at most this [deg]."""
    settled_bonus: float = 9.0
    """Reward per step for being settled."""
    torque_cost: float = 0.05
    """Cost per step of |tau| / |tau_max|."""
    torque_change_cost: float = 0.005
    """Cost per step of the torque's change [1 / (N m)]."""
    zone_height: NonNegativeFloat = 10.0
    """beta: penalty per step inside the zone."""
    zone_decay: PositiveFloat = 66.0
    """alpha: how fast the penalty falls with the margin [1 / rad]."""
    no_progress_cost: float = 1.0
    """Cost of a step that does not bring the attitude closer."""
    progress_tolerance_deg: NonNegativeFloat = 0.0
    """Growth of phi in a step that still counts as progress [deg]; the paper counts a tie as none."""


class ScenarioConfig(SettingsOfAgents):
    """What scenarios are drawn (the deviation range comes from the curriculum or the evaluation)."""

    later: ClassVar = ("cone_rate_deg",)

    max_rate_deg: NonNegativeFloat = 0.001
    """Initial rates are uniform in plus or minus this, per axis [deg/s]."""
    min_half_angle_deg: HalfAngleDeg = 15.0
    """Smallest half angle of the keep-out zone [deg]."""
    max_half_angle_deg: HalfAngleDeg = 30.0
    """Largest half angle of the keep-out zone [deg]."""
    separation_deg: NonNegativeFloat = 2.0
    """Least angle between the zone's edge and the boresight at start and at target [deg]."""
    infeasible_zone: Literal["resample", "shrink"] = "resample"
    """Where the zone would hold start or target: draw the case again, or make the zone smaller."""
    min_zones: ZoneCount = 1
    """Least number of zones of a case."""
    max_zones: ZoneCount = 1
    """Largest number of zones of a case: the first on the direct way, the others around it."""
    zone_gap_deg: NonNegativeFloat = 10.0
    """Least gap between the edges of two zones [deg]."""
    cone_rate_deg: NonNegativeFloat = 0.0
    """Rate at which the axes of zones turn, each about a random direction [deg/s]; separation and gap are those at the
    start."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.min_zones > self.max_zones:
            raise ValueError(f"min_zones must be at most max_zones; got {self.min_zones} and {self.max_zones}")
        if self.min_half_angle_deg > self.max_half_angle_deg:
            raise ValueError(
                f"min_half_angle_deg must be at most max_half_angle_deg; got {self.min_half_angle_deg} and"
                f" {self.max_half_angle_deg}"
            )
        return self


class TaskConfig(Settings):
    """The maneuver: what is flown, and how it is judged."""

    spacecraft: SpacecraftConfig = SpacecraftConfig()
    """The body that turns, and its telescope."""
    reward: RewardConfig = RewardConfig()
    """What a step is worth."""
    scenario: ScenarioConfig = ScenarioConfig()
    """Where maneuvers start, and the zone in their way."""
    spread: SpreadConfig = SpreadConfig()
    """What else is drawn anew for every maneuver."""
    step_seconds: PositiveFloat = 0.1
    """Time step; the torque is held over it [s]."""
    episode_seconds: PositiveFloat = 100.0
    """Length of a maneuver in evaluation [s]."""
    angle_convention: Literal["full", "half"] = "full"
    """phi is the full rotation angle, or half of it (the literal equation of the paper)."""

    @property
    def shortest_step_seconds(self) -> float:
        """Shortest time step that is flown [s]."""
        spread = self.spread
        return spread.step_shares[0] * self.spacecraft.time_unit if spread.spacecraft else self.step_seconds

    @property
    def zones(self) -> tuple[int, int]:
        """Least and largest number of zones of a case."""
        return self.spread.zones or (self.scenario.min_zones, self.scenario.max_zones)

    @property
    def episode_steps(self) -> int:
        """Steps of a maneuver."""
        return round(self.episode_seconds / self.shortest_step_seconds)

    @property
    def time_to_paper(self) -> float:
        """Factor that takes times to those of the paper's spacecraft, so that results compare."""
        return SpacecraftConfig().time_unit / self.spacecraft.time_unit

    @property
    def effort_to_paper(self) -> float:
        """Factor that takes control efforts, u^2 T in units, to those of the paper's spacecraft."""
        return (SpacecraftConfig().strength / self.spacecraft.strength) ** 2 * self.time_to_paper

    def with_rules(
        self,
        angle_convention: Literal["full", "half"] | None = None,
        infeasible_zone: Literal["resample", "shrink"] | None = None,
        zones: int | None = None,
        max_rate_deg: float | None = None,
    ) -> TaskConfig:
        """Judge the same task by another angle convention, or draw it by another rule; None keeps what is set.

        zones: number of zones of every case; max_rate_deg: largest initial rate per axis [deg/s].
        """
        changed = self.model_dump()
        if angle_convention is not None:
            changed["angle_convention"] = angle_convention
        if infeasible_zone is not None:
            changed["scenario"]["infeasible_zone"] = infeasible_zone
        if zones is not None:
            changed["scenario"] |= {"min_zones": zones, "max_zones": zones}
            changed["spread"]["zones"] = None
        if max_rate_deg is not None:
            changed["scenario"]["max_rate_deg"] = max_rate_deg
        return TaskConfig.model_validate(changed)

    @model_validator(mode="after")
    def _whole_steps(self) -> Self:
        check_steps("episode_seconds", self.episode_seconds, self.step_seconds)
        return self


def check_deviations(min_angle_deg: float, max_angle_deg: float) -> None:
    """Refuse a range of initial deviations that is none.

    Raises:
        SettingsError: the angles are not in [0, 180] deg, or not in order.

    """
    if not 0.0 <= min_angle_deg <= 180.0:
        raise SettingsError(f"min_angle_deg: must be in [0, 180], got {min_angle_deg}")
    if not min_angle_deg <= max_angle_deg <= 180.0:
        raise SettingsError(f"max_angle_deg: must be in [min_angle_deg = {min_angle_deg}, 180], got {max_angle_deg}")


def check_feasible(task: TaskConfig, max_angle_deg: float, name: str = "max_angle_deg") -> None:
    """Refuse a deviation range in which ``resample`` could draw for ever.

    The boresight is at most half the deviation away from the zone's axis at start and target.  name: the setting that
    gave ``max_angle_deg``, for the message.
    """
    needed = 2.0 * (task.scenario.min_half_angle_deg + task.scenario.separation_deg)
    if task.scenario.infeasible_zone == "resample" and max_angle_deg <= needed:
        raise SettingsError(
            f"{name}: must be above {needed:g} deg, so that a zone fits between start and target under the rule"
            f" 'resample'; got {max_angle_deg:g}. The rule 'shrink' leaves such zones out."
        )


def is_paper_task(task: TaskConfig) -> bool:
    """Whether the paper's numbers are of this task: same spacecraft, reward, scenarios, step and episode.

    What the paper leaves open (the angle convention, what to do with a zone that has no room, whether a tie is
    progress) does not count.
    """
    return _papers_part(task) == _papers_part(TaskConfig())


def _papers_part(task: TaskConfig) -> tuple[dict[str, Any], Vector]:
    left_open: dict[str, Any] = {
        "angle_convention": True,
        "scenario": {"infeasible_zone"},
        "reward": {"progress_tolerance_deg"},
        "spacecraft": {"torque_limit"},
    }
    return task.model_dump(exclude=left_open), task.spacecraft.torque_limits
