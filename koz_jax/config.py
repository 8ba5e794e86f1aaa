"""Every setting of the project, declared and validated once.  Imports no jax: a bad setting costs no compute.

All classes are frozen and hashable (they are static arguments of jitted functions) and go to and from JSON.
Angles are in degrees here, where people write them, and in radians everywhere else.
"""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

PositiveFloat = Annotated[float, Field(gt=0)]
NonNegativeFloat = Annotated[float, Field(ge=0)]
# Counts are int32 on the device, and so are the bits of a seed.
PositiveInt = Annotated[int, Field(gt=0, lt=2**31)]
NonNegativeInt = Annotated[int, Field(ge=0, lt=2**31)]
Seed = Annotated[int, Field(ge=0, lt=2**32)]
Fraction = Annotated[float, Field(gt=0, le=1)]
HalfAngleDeg = Annotated[float, Field(gt=0, lt=180)]
DeviationDeg = Annotated[float, Field(ge=0, le=180)]
Vector = tuple[float, float, float]


def _check_ramp(ramp: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    fractions = [fraction for fraction, _ in ramp]
    if not ramp or fractions != sorted(set(fractions)) or fractions[0] < 0 or fractions[-1] > 1:
        raise ValueError("a ramp needs one or more (fraction, value) pairs with fractions rising strictly in [0, 1]")
    return ramp


def _check_steps(name: str, seconds: float, step_seconds: float) -> None:
    if not 0.5 < seconds / step_seconds < 2**31 - 1:
        raise ValueError(f"{name} must hold 1 to 2^31 - 1 steps of step_seconds = {step_seconds}; got {seconds}")


# Piecewise linear in the fraction of the phase that is done, constant before the first and after the last pair.
Ramp = Annotated[tuple[tuple[float, float], ...], AfterValidator(_check_ramp)]


def constant(value: float) -> Ramp:
    """Make a ramp that stays at one value."""
    return ((0.0, value),)


class Settings(BaseModel):
    """Base of all settings: immutable, no unknown fields, no infinities."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class SpacecraftConfig(Settings):
    """The spacecraft (section 2.5 of the paper)."""

    inertia: tuple[Vector, Vector, Vector] = ((60.0, 5.0, 1.0), (5.0, 50.0, 2.0), (1.0, 2.0, 70.0))
    """Inertia tensor in body axes, row by row [kg m^2]."""
    boresight: Vector = (1.0, 0.0, 0.0)
    """Unit vector of the telescope in body axes."""
    torque_limit: PositiveFloat = 2.0
    """Largest torque about each body axis [N m]."""

    @model_validator(mode="after")
    def _physical(self) -> Self:
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
        length = float(np.linalg.norm(self.boresight))
        if abs(length - 1.0) > 1e-6:
            raise ValueError(f"boresight must be a unit vector; {self.boresight} has length {length:.6g}")
        return self


class RewardConfig(Settings):
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


class ScenarioConfig(Settings):
    """What scenarios are drawn (the deviation range comes from the curriculum or the evaluation)."""

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

    @model_validator(mode="after")
    def _ordered(self) -> Self:
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
    step_seconds: PositiveFloat = 0.1
    """Time step; the torque is held over it [s]."""
    episode_seconds: PositiveFloat = 100.0
    """Length of a maneuver in evaluation [s]."""
    angle_convention: Literal["full", "half"] = "full"
    """phi is the full rotation angle, or half of it (the literal equation of the paper)."""

    @property
    def episode_steps(self) -> int:
        """Steps of a maneuver."""
        return round(self.episode_seconds / self.step_seconds)

    def with_rules(
        self, angle_convention: Literal["full", "half"] | None, infeasible_zone: Literal["resample", "shrink"] | None
    ) -> TaskConfig:
        """Judge the same task by another angle convention, or draw it by another rule; None keeps what is set."""
        changed = self.model_dump()
        if angle_convention is not None:
            changed["angle_convention"] = angle_convention
        if infeasible_zone is not None:
            changed["scenario"]["infeasible_zone"] = infeasible_zone
        return TaskConfig.model_validate(changed)

    @model_validator(mode="after")
    def _whole_steps(self) -> Self:
        _check_steps("episode_seconds", self.episode_seconds, self.step_seconds)
        return self


class EncodingConfig(Settings):
    """Multi-resolution input encoding: the networks also see tanh(x / scale) of parts of the observation."""

    attitude_scales: tuple[PositiveFloat, ...] = (0.005, 0.05)
    """Scales for the vector part of q_e."""
    rate_scales: tuple[PositiveFloat, ...] = (0.003, 0.03)
    """Scales for the body rates [rad/s]."""
    zone_margin_scales: tuple[PositiveFloat, ...] = (0.02, 0.1, 0.3)
    """Scales for the margin to the zone [rad]."""


NO_ENCODING = EncodingConfig(attitude_scales=(), rate_scales=(), zone_margin_scales=())


class NetworkConfig(Settings):
    """Shape of the policy and of each critic."""

    hidden_sizes: tuple[PositiveInt, ...] = (256, 256)
    """Units of each hidden layer (ReLU)."""
    encoding: EncodingConfig = EncodingConfig()
    """What the networks see besides the observation."""


class SacConfig(Settings):
    """Soft Actor-Critic."""

    batch_size: PositiveInt = 256
    """Transitions per update."""
    buffer_size: PositiveInt = 1_000_000
    """Transitions that the replay buffer holds."""
    n_step: PositiveInt = 1
    """Rewards summed before the critic's own estimate takes over."""
    soft_update: Fraction = 0.005
    """tau: share of the critic that its target takes over per update."""
    target_entropy: float = -3.0
    """Entropy that the automatic coefficient steers to."""
    initial_entropy_coefficient: PositiveFloat = 1.0
    """Entropy coefficient (alpha) at the start."""
    reward_scale: PositiveFloat = 1.0
    """Factor on the reward before it reaches the critic."""
    policy_average: Fraction = 1.0
    """Share of the policy that the evaluated, averaged policy takes over per update; 1 evaluates the last policy."""


class PhaseConfig(Settings):
    """One phase of the curriculum.  Ramps are lists of (fraction of the phase, value)."""

    updates: NonNegativeInt
    """Length of the phase in gradient updates."""
    min_angle_deg: Ramp = constant(0.0)
    """Smallest initial deviation [deg]."""
    max_angle_deg: Ramp = constant(180.0)
    """Largest initial deviation [deg]."""
    angle_bias: Ramp = constant(1.0)
    """Exponent p of angle = min + (max - min) u^p; 1 is uniform, above it small angles are drawn more often."""
    zone_weight: Ramp = constant(0.0)
    """Weight of the zone penalty."""
    zone_tightening_deg: Ramp = constant(0.0)
    """How much wider than it is the penalty sees the zone [deg]."""
    zone_steepness: Ramp = constant(1.0)
    """Factor on alpha, the decay of the zone penalty; larger keeps the penalty closer to the zone's edge."""
    effort_weight: Ramp = constant(0.0)
    """Cost per step of the squared action, beyond the paper's reward."""
    discount: Ramp = constant(0.99)
    """gamma, per environment step."""
    learning_rate: Ramp = constant(1e-4)
    """Learning rate of all networks."""

    @model_validator(mode="after")
    def _in_range(self) -> Self:
        for name, (low, high) in _RAMP_BOUNDS.items():
            for _, value in getattr(self, name):
                if not low <= value <= high:
                    raise ValueError(f"{name} must stay in [{low}, {high}]; got {value}")
        fractions = {fraction for ramp in (self.min_angle_deg, self.max_angle_deg) for fraction, _ in ramp}
        for fraction in sorted(fractions):
            low, high = (ramp_value(ramp, fraction) for ramp in (self.min_angle_deg, self.max_angle_deg))
            if low > high:
                raise ValueError(
                    f"min_angle_deg must not exceed max_angle_deg; at {fraction} of the phase they are {low} and {high}"
                )
        return self


_RAMP_BOUNDS = {
    "min_angle_deg": (0.0, 180.0),
    "max_angle_deg": (0.0, 180.0),
    "angle_bias": (1e-3, 1e3),
    "zone_weight": (0.0, 1e6),
    "zone_tightening_deg": (0.0, 90.0),
    "zone_steepness": (1e-3, 1e3),
    "effort_weight": (0.0, 1e6),
    "discount": (0.0, 0.99999),
    "learning_rate": (0.0, 1.0),
}


def ramp_value(ramp: Ramp, fraction: float) -> float:
    """Value of a ramp at a fraction of its phase."""
    fractions, values = zip(*ramp, strict=True)
    return float(np.interp(fraction, fractions, values))


class CurriculumConfig(Settings):
    """The two phases of training: without and with the zone penalty."""

    phase1: PhaseConfig
    """Turning fast and precisely, without a zone."""
    phase2: PhaseConfig
    """Turning around the zone; begins with the best agent of phase 1."""

    @property
    def updates(self) -> int:
        """Length of the whole training."""
        return self.phase1.updates + self.phase2.updates


class RefineConfig(Settings):
    """Last stage: polish the policy by first-order gradients through the dynamics, over whole maneuvers."""

    iterations: NonNegativeInt = 0
    """Gradient steps; 0 leaves the stage out."""
    scenarios: PositiveInt = 128
    """Maneuvers per gradient step."""
    horizon_seconds: PositiveFloat = 30.0
    """Length of each maneuver [s]."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate at the start; it falls to zero along a cosine."""
    max_gradient_norm: PositiveFloat = 0.03
    """Larger gradients are scaled down to this norm.  Nearly all are: a maneuver that hesitates in front of the zone
    has a huge gradient, which must not outvote the others."""
    min_angle_deg: DeviationDeg = 30.0
    """Smallest initial deviation [deg]."""
    max_angle_deg: DeviationDeg = 180.0
    """Largest initial deviation [deg]."""
    pointing_scales_deg: tuple[PositiveFloat, ...] = (0.1, 3.0, 50.0)
    """Scales of the pointing cost, sum of weight tanh(phi / scale) [deg]."""
    pointing_weights: tuple[NonNegativeFloat, ...] = (4.0, 6.0, 1.0)
    """Weight of each scale of the pointing cost, per step."""
    effort_weight: NonNegativeFloat = 5.0
    """Cost per step of the squared action: trades effort against time."""
    zone_weight: NonNegativeFloat = 2.0
    """Weight of the zone penalty."""
    zone_tightening_deg: NonNegativeFloat = 1.0
    """How much wider than it is the penalty sees the zone [deg]."""
    zone_steepness: PositiveFloat = 2.0
    """Factor on alpha, the decay of the zone penalty."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.min_angle_deg > self.max_angle_deg:
            raise ValueError(
                f"min_angle_deg must be at most max_angle_deg; got {self.min_angle_deg} and {self.max_angle_deg}"
            )
        if len(self.pointing_scales_deg) != len(self.pointing_weights):
            raise ValueError(
                "pointing_scales_deg and pointing_weights must have the same length; got"
                f" {self.pointing_scales_deg} and {self.pointing_weights}"
            )
        return self


class TrainConfig(Settings):
    """One training run."""

    preset: str = "custom"
    """Settings to begin from: fast, thorough or paper; every other flag changes one of them."""
    task: TaskConfig = TaskConfig()
    """What is learned."""
    network: NetworkConfig = NetworkConfig()
    """What learns it."""
    sac: SacConfig = SacConfig()
    """How it learns."""
    curriculum: CurriculumConfig
    """In what order it learns."""
    refine: RefineConfig = RefineConfig()
    """How the result is polished."""
    num_envs: PositiveInt = 1
    """Environments that run in parallel."""
    updates_per_step: PositiveInt = 1
    """Gradient updates for each step of all environments."""
    prefill_steps: NonNegativeInt = 100
    """Steps of all environments with random actions before the first update."""
    training_episode_seconds: PositiveFloat = 100.0
    """Training episodes are cut (truncated, not terminated) after this time [s]."""
    eval_every: PositiveInt = 10_000
    """Updates between evaluations and checkpoints; a phase ends with an evaluation in any case."""
    log_every: PositiveInt = 1000
    """Updates between lines of the log; also how long an interrupt may have to wait."""
    refine_log_every: PositiveInt = 20
    """Refinement iterations between lines of the log."""
    refine_eval_every: PositiveInt = 100
    """Refinement iterations between evaluations and checkpoints."""
    eval_cases: PositiveInt = 1000
    """Fixed scenarios of each evaluation."""
    eval_min_angle_deg: DeviationDeg = 80.0
    """Smallest initial deviation in evaluation [deg]."""
    eval_max_angle_deg: DeviationDeg = 180.0
    """Largest initial deviation in evaluation [deg]."""
    seed: Seed = 0
    """Seed of everything random in the run."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.curriculum.updates == 0:
            raise ValueError("curriculum must have at least one update in phase1.updates + phase2.updates; got 0")
        if self.curriculum.updates >= 2**31:
            raise ValueError(
                "curriculum must have less than 2^31 updates in phase1.updates + phase2.updates; got"
                f" {self.curriculum.updates}"
            )
        if self.refine.iterations and not self.curriculum.phase2.updates:
            raise ValueError(
                "refine.iterations must be 0 where curriculum.phase2.updates is 0: refinement polishes the agent of"
                f" phase 2; got {self.refine.iterations}"
            )
        if self.sac.batch_size > self.sac.buffer_size:
            raise ValueError(
                f"sac.batch_size must be at most sac.buffer_size; got {self.sac.batch_size} and {self.sac.buffer_size}"
            )
        if self.buffer_steps < self.sac.n_step:
            raise ValueError(
                f"sac.buffer_size must hold sac.n_step = {self.sac.n_step} steps of num_envs = {self.num_envs}"
                f" environments; got {self.sac.buffer_size}"
            )
        if self.prefill_steps < self.sac.n_step:
            raise ValueError(f"prefill_steps must be at least sac.n_step = {self.sac.n_step}; got {self.prefill_steps}")
        lengths = {
            "curriculum.phase1.updates": self.curriculum.phase1.updates,
            "curriculum.phase2.updates": self.curriculum.phase2.updates,
            "eval_every": self.eval_every,
            "log_every": self.log_every,
        }
        for name, value in lengths.items():
            if value % self.updates_per_step:
                raise ValueError(
                    f"{name} must be a multiple of updates_per_step = {self.updates_per_step}; got {value}"
                )
        _check_steps("training_episode_seconds", self.training_episode_seconds, self.task.step_seconds)
        _check_steps("refine.horizon_seconds", self.refine.horizon_seconds, self.task.step_seconds)
        if self.eval_min_angle_deg > self.eval_max_angle_deg:
            raise ValueError(
                "eval_min_angle_deg must be at most eval_max_angle_deg; got"
                f" {self.eval_min_angle_deg} and {self.eval_max_angle_deg}"
            )
        return self

    @property
    def length(self) -> int:
        """Length of the run: gradient updates, then refinement iterations."""
        return self.curriculum.updates + self.refine.iterations

    @property
    def training_episode_steps(self) -> int:
        """Steps after which a training episode is truncated."""
        return round(self.training_episode_seconds / self.task.step_seconds)

    @property
    def refine_steps(self) -> int:
        """Steps of a maneuver in refinement."""
        return round(self.refine.horizon_seconds / self.task.step_seconds)

    @property
    def buffer_steps(self) -> int:
        """Steps of all environments that the replay buffer holds."""
        return self.sac.buffer_size // self.num_envs
