"""C99 source of a shield: no allocation, fixed loops, constants, nothing beyond libm."""

import jax.numpy as jnp
import numpy as np

from koz_jax.agents.numpy_policy import exported_zone_count
from koz_jax.config.shield import ShieldConfig
from koz_jax.control.shield import brake_path, guide, rate_limit
from koz_jax.control.shield import filter as shield
from koz_jax.export.c_source import literals, template
from koz_jax.export.metadata import Metadata
from koz_jax.export.shield_golden import ShieldGolden
from koz_jax.task import dynamics, environment, pointing_constraints
from koz_jax.task.state import Model

SHIELD_FILES = ("koz_shield.h", "koz_shield.c", "koz_shield_selftest.c")

_TORQUE_TOLERANCE = "1e-3"


def shield_files(metadata: Metadata, config: ShieldConfig, vectors: ShieldGolden) -> dict[str, bytes]:
    """Header, source and self-test of a shield for the spacecraft of an exported policy, by file name."""
    model = environment.model_from_config(metadata.task)
    made = shield.from_config(config, model)
    zones = exported_zone_count(metadata.network, metadata.task.scenario, metadata.least_zones)
    wheels = len(metadata.task.spacecraft.wheels)
    replacements = {
        "MARGIN_DEG": f"{np.rad2deg(made.margin):.4g}",
        "MAX_RATE_DEG": _largest_rate(model, wheels),
        "CONE_RATE_DEG": f"{config.cone_rate_deg:g}",
        "GUIDE_RATE_DEG": f"{np.rad2deg(made.guide.rate):.4g}",
        **{f"STATED_{name.upper()}": f"{error:g}" for name, error in config.error_bounds.model_dump().items()},
        "SAMPLES": str(made.brake.samples),
        "COUNT": str(len(vectors.allowed)),
        "TOLERANCE": _TORQUE_TOLERANCE,
        "SITUATIONS": literals.situations(vectors.situation, zones, wheels),
        "REQUESTED": literals.rows(vectors.requested),
        "ALLOWED": literals.rows(vectors.allowed),
        "SAFE": ", ".join(str(int(safe)) for safe in vectors.safe),
        **_shield_constants(made, model, metadata),
    }
    return template.filled(SHIELD_FILES, metadata, replacements)


def _largest_rate(model: Model, wheels: int) -> str:
    """What the shield keeps the rate below, in words."""
    limit = None if model.max_rate is None else f"{np.rad2deg(model.max_rate):.4g} deg/s"
    if wheels:
        return "what wheels can stop" + (f", and {limit}" if limit else "")
    return limit or "what torques allow"


def _shield_constants(made: shield.Shield, model: Model, metadata: Metadata) -> dict[str, str]:
    """What the source of a shield holds, by placeholder."""
    brake = made.brake
    looks = [pointing_constraints.absent(1, jnp.array(boresight_B)) for boresight_B in metadata.boresights_B]
    speeds = [float(brake_path.situation(look, model).speed[0]) for look in looks]
    numbers = {
        "MARGIN": made.margin,
        "ATTITUDE_ERROR": made.attitude_error,
        "BRAKE_TORQUE": brake.torque,
        "INERTIA_ERROR": brake.inertia_error,
        "DISTURBANCE": brake.disturbance,
        "RATE_ERROR": brake.rate_error,
        "CONE_RATE": brake.cone_rate,
        "APPROACH": brake.approach,
        "SOON": brake.soon,
        "SMALLEST_MOMENT": brake.smallest_moment,
        "LARGEST_MOMENT": brake.largest_moment,
        "GUIDE_MARGIN": made.guide.margin,
        "GUIDE_RATE": made.guide.rate,
        "GUIDE_SECONDS": made.guide.seconds,
        "GUIDE_TILT": made.guide.tilt,
        "GUIDE_AHEAD": guide.AHEAD,
        "SLOW_STEPS": shield.SLOW_STEPS,
        "RAISE": shield.RAISE,
        "SQUARED_RATE": 1.0 if made.rate_limit is None else made.rate_limit.squared,
        "RATE_RESERVE": 0.0 if made.rate_limit is None else made.rate_limit.error,
        "RATE_ROUNDING": rate_limit.ROUNDING,
    }
    shares = {"REQUEST_SHARES": shield.REQUEST_SHARES, "GUIDE_SHARES": shield.GUIDE_SHARES}
    return {
        "INERTIA": literals.matrix(model.inertia_B),
        "INVERSE_INERTIA": literals.matrix(dynamics.inverse(model.inertia_B)),
        "RATE_FORM": literals.matrix(jnp.zeros((3, 3)) if made.rate_limit is None else made.rate_limit.form_B),
        **{f"{name}_COUNT": str(len(values)) for name, values in shares.items()},
        **{name: literals.row(values) for name, values in shares.items()},
        **{name: literals.number(float(value)) for name, value in numbers.items()},
        "SPEED_PER_MOMENTUM": literals.number(speeds[0]) if len(speeds) == 1 else literals.braced(speeds),
    }
