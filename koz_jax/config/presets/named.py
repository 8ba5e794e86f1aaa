"""Named training configurations."""

from koz_jax.config.base import constant
from koz_jax.config.curriculum import CurriculumConfig, PhaseConfig
from koz_jax.config.learners.refinement import RefineConfig
from koz_jax.config.spread import SpreadConfig
from koz_jax.config.task import TaskConfig
from koz_jax.config.training import (
    NO_ENCODING,
    EncodingConfig,
    NetworkConfig,
    SacConfig,
    TrainConfig,
)
from koz_jax.config.uncertainty import UncertaintyConfig
from koz_jax.errors import SettingsError


def _paper() -> TrainConfig:
    """The hyperparameters of Table 2, and what Stable-Baselines3 does where the paper is silent.

    The paper does not say how long it trained.  Two million updates per phase take some hours on two cores.
    """
    return TrainConfig(
        preset="paper",
        network=NetworkConfig(hidden_sizes=(256, 256), encoding=NO_ENCODING),
        sac=SacConfig(
            batch_size=256,
            buffer_size=1_000_000,
            n_step=1,
            soft_update=0.005,
            target_entropy=-3.0,
            initial_entropy_coefficient=1.0,
            reward_scale=1.0,
            policy_average=1.0,
        ),
        curriculum=CurriculumConfig(
            phase1=PhaseConfig(
                updates=2_000_000,
                max_angle_deg=((0.0, 25.0), (0.75, 180.0)),
                learning_rate=constant(1e-4),
            ),
            phase2=PhaseConfig(
                updates=2_000_000,
                min_angle_deg=constant(80.0),
                max_angle_deg=((0.0, 80.0), (0.75, 180.0)),
                zone_weight=constant(1.0),
                learning_rate=constant(1e-4),
            ),
        ),
        num_envs=1,
        updates_per_step=1,
        prefill_steps=100,
        training_episode_seconds=100.0,
        eval_every=50_000,
        log_every=1_000,
    )


def _fast() -> TrainConfig:
    """Beats the paper's table after minutes on a CPU core: SAC finds the way around, refinement does the rest."""
    return TrainConfig(
        preset="fast",
        network=NetworkConfig(hidden_sizes=(128, 128)),
        sac=SacConfig(
            batch_size=128,
            buffer_size=512_000,
            n_step=3,
            initial_entropy_coefficient=0.1,
            reward_scale=0.05,
            policy_average=0.004,
        ),
        curriculum=CurriculumConfig(
            phase1=PhaseConfig(
                updates=16_000,
                max_angle_deg=((0.0, 10.0), (0.75, 180.0)),
                learning_rate=constant(1e-3),
            ),
            phase2=PhaseConfig(
                updates=32_000,
                min_angle_deg=constant(60.0),
                zone_weight=((0.0, 0.5), (0.1, 2.0)),
                zone_tightening_deg=constant(1.25),
                zone_steepness=constant(2.0),
                effort_weight=((0.0, 0.0), (0.3, 0.0), (1.0, 0.4)),
                learning_rate=((0.0, 1e-3), (0.5, 1e-3), (1.0, 5e-5)),
            ),
        ),
        refine=RefineConfig(
            iterations=500,
            scenarios=64,
            horizon_seconds=45.0,
            learning_rate=3e-3,
            max_gradient_norm=1.0,
            max_maneuver_gradient=0.1,
            violator_weight=8.0,
            # What stands still in front of the zone must gain by every degree that it comes nearer.
            pointing_scales_deg=(0.1, 3.0, 100.0),
            pointing_weights=(4.0, 6.0, 3.0),
            effort_weight=5.0,
        ),
        num_envs=512,
        updates_per_step=8,
        prefill_steps=20,
        training_episode_seconds=40.0,
        eval_every=16_000,
        log_every=2_000,
    )


def _longer(updates1: int, updates2: int) -> TrainConfig:
    """The fast preset with so many updates of larger batches in both phases, and effort weighed in earlier."""
    fast = _fast()
    phase1, phase2 = fast.curriculum.phase1, fast.curriculum.phase2
    weighed = {
        "updates": updates2,
        "effort_weight": ((0.0, 0.0), (0.1, 0.2), (0.5, 1.0)),
        "learning_rate": ((0.0, 5e-4), (0.5, 5e-4), (1.0, 2.5e-5)),
    }
    return fast.model_copy(
        update={
            "sac": fast.sac.model_copy(update={"batch_size": 256}),
            "curriculum": CurriculumConfig(
                phase1=phase1.model_copy(update={"updates": updates1, "learning_rate": constant(5e-4)}),
                phase2=phase2.model_copy(update=weighed),
            ),
            "eval_every": 10_000,
        }
    )


def _thorough() -> TrainConfig:
    """The shipped agents of the paper's spacecraft come from it."""
    refine = RefineConfig(iterations=3000, scenarios=256)
    return _longer(40_000, 360_000).model_copy(update={"preset": "thorough", "refine": refine, "eval_cases": 4000})


# An agent for any spacecraft draws another one for every maneuver, with instruments, rate limit and urgency.
_ANY = SpreadConfig(
    spacecraft=True,
    zones=(1, 4),
    instruments=3,
    keep_in=0.2,
    step_shares=(0.016, 0.06),
    # To far above what a maneuver needs: an agent without a limit is at the end of what it knows.
    max_rate_deg=(2.0, 150.0),
    urgency=(0.0, 1.0),
    errors=UncertaintyConfig(inertia_error=0.1, disturbance_torque=0.01, attitude_noise_deg=0.01, rate_noise_deg=0.001),
    delay_steps=(0, 2),
)


def _universal() -> TrainConfig:
    """An agent for any spacecraft, by far the longest training: sized for a GPU, hours on a CPU."""
    longer = _longer(32_000, 64_000)
    refine = RefineConfig(
        horizon_seconds=45.0,
        optimizer="muon",
        learning_rate=3e-3,
        effort_weight=3.46,
        urgency_factor=14.0,
        rate_weight=20.0,
        change_weight=5.0,
        max_maneuver_gradient=0.1,
        state_gradient=(1.0, 300.0),
        max_gradient_norm=1.0,
        scenarios=96,
        iterations=7000,
    )
    return longer.model_copy(
        update={
            "preset": "universal",
            "task": TaskConfig(spread=_ANY),
            "eval_cases": 400,
            "refine_eval_every": 500,
            "network": NetworkConfig(
                hidden_sizes=(256, 256),
                encoding=EncodingConfig(rate_scales=(0.016, 0.16)),
                observed_zones=4,
                scaled=True,
            ),
            "refine": refine,
        }
    )


def _short() -> TrainConfig:
    """The fast preset in three quarters of its time, for a first look and for notebooks."""
    fast = _fast()
    phase1, shorter = (
        phase.model_copy(update={"updates": updates})
        for phase, updates in ((fast.curriculum.phase1, 12_000), (fast.curriculum.phase2, 24_000))
    )
    return fast.model_copy(
        update={
            "preset": "short",
            "curriculum": fast.curriculum.model_copy(update={"phase1": phase1, "phase2": shorter}),
            # Its agent is slow when refinement begins, and what does not arrive in time only saves effort.
            "refine": fast.refine.model_copy(update={"iterations": 300, "effort_weight": 4.5}),
            "num_envs": 256,
            "eval_every": 12_000,
            "eval_cases": 200,
            "refine_log_every": 20,
            "refine_eval_every": 100,
        }
    )


def _smoke() -> TrainConfig:
    """Everything that a training does, in seconds: to see whether it runs, not to learn."""
    short = _short()
    phase1, phase2 = (
        phase.model_copy(update={"updates": 800}) for phase in (short.curriculum.phase1, short.curriculum.phase2)
    )
    return short.model_copy(
        update={
            "preset": "smoke",
            "curriculum": short.curriculum.model_copy(update={"phase1": phase1, "phase2": phase2}),
            "refine": short.refine.model_copy(update={"iterations": 10, "scenarios": 8}),
            "eval_every": 400,
            "log_every": 200,
            "refine_eval_every": 10,
        }
    )


PRESETS = {config.preset: config for config in (_fast(), _short(), _smoke(), _thorough(), _universal(), _paper())}


def preset(name: str) -> TrainConfig:
    """A preset by name."""
    if name not in PRESETS:
        raise SettingsError(f"preset: unknown preset {name!r}; allowed: {', '.join(PRESETS)}")
    return PRESETS[name]
