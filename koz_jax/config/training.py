"""Settings of training, declared and validated once.  Imports no jax: a bad setting costs no compute.

All classes are frozen and hashable (they are static arguments of jitted functions) and go to and from JSON.
Angles are in degrees here, where people write them, and in radians everywhere else.
"""

from __future__ import annotations

import hashlib
from typing import Literal, Self

from pydantic import model_validator

from koz_jax.config.base import (
    DeviationDeg,
    Fraction,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Seed,
    Settings,
    ZoneCount,
    check_steps,
)
from koz_jax.config.curriculum import CurriculumConfig
from koz_jax.config.goal import GoalConfig
from koz_jax.config.learners.deterministic import DdpgConfig, Td3Config
from koz_jax.config.learners.refinement import RefineConfig
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig


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
    observed_zones: ZoneCount = 1
    """Zones in the observation, the nearest first."""
    scaled: bool = False
    """See any spacecraft in units and axes of its own, and command angular acceleration; scales of rates are then in
    1/T, T = sqrt(J / u).  Otherwise the policy is of one spacecraft, as the paper's."""


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


class ShieldingConfig(Settings):
    """Training under the shield, so that the agent learns to live with it."""

    enabled: bool = False
    """Put the shield between policy and actuators, in training and in its evaluations."""
    intervention_cost: NonNegativeFloat = 0.0
    """Cost per step of the norm of what the shield changes of the action; 0 does not penalise it."""
    shield: ShieldConfig = ShieldConfig()
    """The shield."""

    @property
    def in_force(self) -> ShieldConfig | None:
        """The shield that the agent flies under, if it does."""
        return self.shield if self.enabled else None


class TrainConfig(Settings):
    """One training run."""

    preset: str = "custom"
    """Settings to begin from: fast, thorough, universal or paper; every other flag changes one of them."""
    task: TaskConfig = TaskConfig()
    """What is learned."""
    network: NetworkConfig = NetworkConfig()
    """What learns it."""
    learner: Literal["sac", "td3", "ddpg"] = "sac"
    """Who learns: Soft Actor-Critic, or what it is compared with, which shares the settings of ``sac`` that it has."""
    sac: SacConfig = SacConfig()
    """How it learns."""
    td3: Td3Config = Td3Config()
    """How TD3 learns."""
    ddpg: DdpgConfig = DdpgConfig()
    """How DDPG learns."""
    curriculum: CurriculumConfig
    """In what order it learns."""
    refine: RefineConfig = RefineConfig()
    """How the result is polished."""
    shielding: ShieldingConfig = ShieldingConfig()
    """Whether it learns under the shield."""
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
    until: tuple[GoalConfig, ...] = ()
    """End the last stage as soon as its best agent reaches all of these in evaluation, such as success=99.95 [%]
    settling=20 [s] effort=60 [N2 m2 s]."""
    seed: Seed = 0
    """Seed of everything random in the run."""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.length == 0:
            raise ValueError(
                "curriculum must have at least one update in phase1.updates + phase2.updates, or refine at least one"
                " iteration; got 0"
            )
        if self.curriculum.updates >= 2**31:
            raise ValueError(
                "curriculum must have less than 2^31 updates in phase1.updates + phase2.updates; got"
                f" {self.curriculum.updates}"
            )
        if self.refine.iterations and self.curriculum.updates and not self.curriculum.phase2.updates:
            raise ValueError(
                "refine.iterations must be 0 where curriculum has phase1.updates but no phase2.updates: refinement"
                f" polishes the agent of phase 2; got {self.refine.iterations}"
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
        check_steps("training_episode_seconds", self.training_episode_seconds, self.task.step_seconds)
        check_steps("refine.horizon_seconds", self.refine.horizon_seconds, self.task.step_seconds)
        if self.eval_min_angle_deg > self.eval_max_angle_deg:
            raise ValueError(
                "eval_min_angle_deg must be at most eval_max_angle_deg; got"
                f" {self.eval_min_angle_deg} and {self.eval_max_angle_deg}"
            )
        return self

    @model_validator(mode="after")
    def _can_be_shielded(self) -> Self:
        if self.shielding.in_force:
            self.shielding.in_force.check(self.task.spacecraft.brake_limits)
            self.shielding.in_force.check_cones(self.task.scenario.cone_rate_deg)
        return self

    @model_validator(mode="after")
    def _can_be_summed(self) -> Self:
        if self.learner == "ddpg" and self.ddpg.zone_priority * self.sac.buffer_size >= 2**31:
            raise ValueError(f"ddpg.zone_priority must be below 2^31 / sac.buffer_size; got {self.ddpg.zone_priority}")
        return self

    def to_json(self) -> str:
        """What ``config.json`` of a run holds; of what came late, only what is not as it was before."""
        unused = {"td3", "ddpg"} - {self.learner}
        if self.learner == "sac":
            unused.add("learner")
        if not self.until:
            unused.add("until")
        return self.model_dump_json(indent=2, exclude=unused) + "\n"

    @property
    def sha256(self) -> str:
        """Hash of all settings: that of the file ``config.json``."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()

    @property
    def length(self) -> int:
        """Length of the run: gradient updates, then refinement iterations."""
        return self.curriculum.updates + self.refine.iterations

    @property
    def refines_alone(self) -> bool:
        """Whether it only polishes an agent that there is already."""
        return self.curriculum.updates == 0

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
