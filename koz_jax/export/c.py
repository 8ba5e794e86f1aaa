"""C99 source of a controller, and of its shield: no allocation, fixed loops, constants, nothing beyond libm."""

import hashlib
import importlib.resources

import jax.numpy as jnp
import numpy as np

from koz_jax.agents.numpy_policy import NumpyPolicy, exported_zone_count
from koz_jax.config.base import Vector
from koz_jax.config.shield import ShieldConfig
from koz_jax.control.shield import brake_path, guide, rate_limit
from koz_jax.control.shield import filter as shield
from koz_jax.export import c_instruments, c_network, c_observation, c_text
from koz_jax.export.golden import EXAMPLE_CASE, Golden
from koz_jax.export.metadata import Metadata, as_text
from koz_jax.export.shield_golden import ShieldGolden
from koz_jax.task import dynamics, environment, pointing_constraints
from koz_jax.task.observation_layout import ACTION_SIZE, size
from koz_jax.task.state import Model

C_FILES = ("koz_math.h", "koz_policy.h", "koz_policy.c", "koz_selftest.c", "koz_example.c", "Makefile")
SHIELD_FILES = ("koz_shield.h", "koz_shield.c", "koz_shield_selftest.c")

# 1e-5 of the action's range, which is 2.
_ACTION_TOLERANCE = "2e-5"
_OBSERVATION_TOLERANCE = "2e-5"
_TORQUE_TOLERANCE = "1e-3"

_EXAMPLE_ROWS = 20


def c_files(policy: NumpyPolicy, metadata: Metadata, vectors: Golden, example: np.ndarray) -> dict[str, bytes]:
    """Headers, source, self-test with golden vectors, example, and Makefile, by file name.

    example: the situation in which the example's maneuver starts, a row as in ``Golden``.
    """
    network, instruments = metadata.network, len(metadata.boresights_B)
    replacements = {
        **c_observation.replacements(metadata, vectors),
        **c_instruments.replacements(instruments),
        "HEAD": _head(metadata),
        "OBSERVATION_SIZE": str(size(network.observed_zones, network.scaled)),
        "ZONES": str(exported_zone_count(network, metadata.task.scenario)),
        "OBSERVED_ZONES": str(network.observed_zones),
        "ACTION_SIZE": str(ACTION_SIZE),
        **_limits(metadata.torque_limit),
        "STEP_SECONDS": c_text.number(metadata.step_seconds),
        "CONFIG_SHA256": metadata.provenance.config_sha256 or "unknown",
        "TRAINING_SHA256": metadata.training_sha256,
        "EXPORT_ID": _export_id(metadata),
        "WEIGHTS_SHA256": metadata.weights_sha256,
        "BORESIGHT": c_text.of_each([c_text.row(boresight_B) for boresight_B in metadata.boresights_B]),
        "WEIGHTS": c_network.weights(policy),
        "HELPERS": c_network.helpers(policy),
        "DECIDE": c_network.decide(policy),
        "COUNT": str(len(vectors.action)),
        "ACTION_TOLERANCE": _ACTION_TOLERANCE,
        "OBSERVATION_TOLERANCE": _OBSERVATION_TOLERANCE,
        "SITUATIONS": c_text.situations(vectors.situation, instruments),
        "SITUATION": c_text.situation(example, instruments),
        **_example(metadata),
        "OBSERVATIONS": c_text.rows(vectors.observation),
        "ACTIONS": c_text.rows(vectors.action),
    }
    return {name: _fill(name, replacements, instruments).encode() for name in C_FILES}


def shield_files(metadata: Metadata, config: ShieldConfig, vectors: ShieldGolden) -> dict[str, bytes]:
    """Header, source and self-test of a shield for the spacecraft of an exported policy, by file name."""
    model = environment.model_from_config(metadata.task)
    made = shield.from_config(config, model)
    instruments = len(metadata.boresights_B)
    replacements = {
        **c_instruments.replacements(instruments),
        "HEAD": _head(metadata),
        "EXPORT_ID": _export_id(metadata),
        "MARGIN_DEG": f"{np.rad2deg(made.margin):.4g}",
        "MAX_RATE_DEG": "what torques allow" if model.max_rate is None else f"{np.rad2deg(model.max_rate):.4g} deg/s",
        "CONE_RATE_DEG": f"{config.cone_rate_deg:g}",
        "GUIDE_RATE_DEG": f"{np.rad2deg(made.guide.rate):.4g}",
        **{f"STATED_{name.upper()}": f"{error:g}" for name, error in config.error_bounds.model_dump().items()},
        **_limits(metadata.torque_limit),
        "SAMPLES": str(made.brake.samples),
        "COUNT": str(len(vectors.allowed)),
        "TOLERANCE": _TORQUE_TOLERANCE,
        "SITUATIONS": c_text.situations(vectors.situation, instruments),
        "REQUESTED": c_text.rows(vectors.requested),
        "ALLOWED": c_text.rows(vectors.allowed),
        "SAFE": ", ".join(str(int(safe)) for safe in vectors.safe),
        **_shield_constants(made, model, metadata),
    }
    return {name: _fill(name, replacements, instruments).encode() for name in SHIELD_FILES}


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
        "SOON_STEPS": brake_path.SOON_STEPS,
        "SMALLEST_MOMENT": brake.smallest_moment,
        "LARGEST_MOMENT": brake.largest_moment,
        "GUIDE_RATE": made.guide.rate,
        "GUIDE_SECONDS": made.guide.seconds,
        "GUIDE_TILT": made.guide.tilt,
        "GUIDE_AHEAD": guide.AHEAD,
        "SLOW_STEPS": shield.SLOW_STEPS,
        "RAISE": shield.RAISE,
        "SQUARED_RATE": 1.0 if made.rate_limit is None else made.rate_limit.squared,
        "RATE_ROUNDING": rate_limit.ROUNDING,
    }
    shares = {"REQUEST_SHARES": shield.REQUEST_SHARES, "GUIDE_SHARES": shield.GUIDE_SHARES}
    return {
        "INERTIA": c_text.matrix(model.inertia_B),
        "INVERSE_INERTIA": c_text.matrix(dynamics.inverse(model.inertia_B)),
        "RATE_FORM": c_text.matrix(jnp.zeros((3, 3)) if made.rate_limit is None else made.rate_limit.form_B),
        **{f"{name}_COUNT": str(len(values)) for name, values in shares.items()},
        **{name: c_text.row(values) for name, values in shares.items()},
        **{name: c_text.number(float(value)) for name, value in numbers.items()},
        "SPEED_PER_MOMENTUM": c_text.number(speeds[0]) if len(speeds) == 1 else c_text.braced(speeds),
    }


def _example(metadata: Metadata) -> dict[str, str]:
    """The rigid body of the example, in double precision, and how long it flies."""
    task = metadata.task
    inertia = np.array(task.spacecraft.inertia)
    settled_deg = task.reward.settled_angle_deg / (1.0 if task.angle_convention == "full" else 0.5)
    exact = {"INERTIA": inertia, "INVERSE_INERTIA": np.linalg.inv(inertia)}
    return {
        "EXAMPLE": f"case {EXAMPLE_CASE} of koz evaluate",
        "STEPS": str(task.episode_steps),
        "ROW_STEPS": str(max(1, task.episode_steps // _EXAMPLE_ROWS)),
        "SETTLED_DEG": repr(float(settled_deg)),
        "EXACT_BORESIGHT": c_text.of_each([c_text.exact_row(boresight_B) for boresight_B in metadata.boresights_B]),
        **{f"EXACT_{name}": ", ".join(f"{{{c_text.exact_row(row)}}}" for row in rows) for name, rows in exact.items()},
    }


def _limits(limit: float | Vector) -> dict[str, str]:
    """What templates say of the torque limits: a constant where all axes have the same, a macro of the axis else."""
    if not isinstance(limit, tuple):
        return {
            "LIMIT_DEFINITION": f"KOZ_TORQUE_LIMIT {c_text.number(limit)} /* [N m] about each body axis */",
            "LIMIT_OF_I": "KOZ_TORQUE_LIMIT",
            "LARGEST_LIMIT": "KOZ_TORQUE_LIMIT",
            "LARGEST_TORQUE": "sqrtf(3.0f) * KOZ_TORQUE_LIMIT",
            "SHARE_OF_I": "",
            "SHARE": " / KOZ_TORQUE_LIMIT",
        }
    x, y, z = (c_text.number(each) for each in limit)
    choice = f"((axis) == 0 ? {x} : (axis) == 1 ? {y} : {z})"
    return {
        "LIMIT_DEFINITION": f"KOZ_TORQUE_LIMIT(axis) {choice} /* [N m] about a body axis */",
        "LIMIT_OF_I": "KOZ_TORQUE_LIMIT(i)",
        "LARGEST_LIMIT": c_text.number(max(limit)),
        "LARGEST_TORQUE": c_text.number(float(np.linalg.norm(limit))),
        "SHARE_OF_I": " / KOZ_TORQUE_LIMIT(i)",
        "SHARE": "",
    }


def _export_id(metadata: Metadata) -> str:
    """A number that files of one controller share, for the preprocessor."""
    if metadata.scaling is None:
        return f"0x{metadata.training_sha256[:8]}"
    content = metadata.training_sha256 + metadata.task.model_dump_json()
    content += "".join(instrument.model_dump_json() for instrument in metadata.further_instruments)
    return f"0x{hashlib.sha256(content.encode()).hexdigest()[:8]}"


def _head(metadata: Metadata) -> str:
    return "\n".join(f" * {line}".rstrip() for line in as_text(metadata).splitlines())


def _fill(name: str, replacements: dict[str, str], instruments: int) -> str:
    text = (importlib.resources.files("koz_jax.export") / "templates" / name).read_text(encoding="utf-8")
    for key, value in replacements.items():
        text = text.replace(f"@{key}@", value)
    return c_instruments.lines_for(text, instruments)
