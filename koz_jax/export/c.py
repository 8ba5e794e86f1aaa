"""C99 source of a controller, and of its shield: no allocation, fixed loops, constants, nothing beyond libm."""

import importlib.resources
from collections.abc import Iterable

import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from koz_jax.agents.numpy_policy import NumpyPolicy, exported_zone_count
from koz_jax.config.base import Vector
from koz_jax.config.shield import ShieldConfig
from koz_jax.config.task import TaskConfig
from koz_jax.control.shield import brake_path, guide
from koz_jax.control.shield import filter as shield
from koz_jax.export.golden import EXAMPLE_CASE, Golden
from koz_jax.export.metadata import Metadata, as_text, describe
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


def c_files(policy: NumpyPolicy, vectors: Golden, example: np.ndarray) -> dict[str, bytes]:
    """Headers, source, self-test with golden vectors, example, and Makefile, by file name.

    example: (11 + 4 zones,) the situation in which the example's maneuver starts.
    """
    metadata = describe(policy)
    network = metadata.network
    replacements = {
        "HEAD": _head(metadata),
        "OBSERVATION_SIZE": str(size(network.observed_zones)),
        "ZONES": str(exported_zone_count(network, metadata.task.scenario)),
        "OBSERVED_ZONES": str(network.observed_zones),
        "ACTION_SIZE": str(ACTION_SIZE),
        **_limits(metadata.torque_limit),
        "STEP_SECONDS": _number(metadata.step_seconds),
        "CONFIG_SHA256": metadata.provenance.config_sha256 or "unknown",
        "TRAINING_SHA256": metadata.training_sha256,
        "EXPORT_ID": _export_id(metadata),
        "WEIGHTS_SHA256": metadata.weights_sha256,
        "BORESIGHT": _row(metadata.boresight_B),
        "WEIGHTS": "\n\n".join(_weights(policy)),
        "RELU": _RELU if len(policy.layers) > 1 else "",
        "DECIDE": "\n".join(f"    {line}" for line in _decide(policy)),
        "COUNT": str(len(vectors.action)),
        "ACTION_TOLERANCE": _ACTION_TOLERANCE,
        "OBSERVATION_TOLERANCE": _OBSERVATION_TOLERANCE,
        "SITUATIONS": _situations(vectors.situation, policy),
        "MEMORIES": ",\n".join(f"    {{{_braced(q_e)}}}" for q_e in vectors.memory),
        "SITUATION": _situations(example[None], policy).strip(),
        **_example(metadata.task),
        "OBSERVATIONS": _rows(vectors.observation),
        "ACTIONS": _rows(vectors.action),
    }
    return {name: _fill(name, replacements).encode() for name in C_FILES}


def shield_files(policy: NumpyPolicy, config: ShieldConfig, vectors: ShieldGolden) -> dict[str, bytes]:
    """Header, source and self-test of a shield for the spacecraft of a policy, by file name."""
    metadata = describe(policy)
    model = environment.model_from_config(metadata.task)
    made = shield.from_config(config, model)
    replacements = {
        "HEAD": _head(metadata),
        "EXPORT_ID": _export_id(metadata),
        "MARGIN_DEG": f"{np.rad2deg(made.margin):.4g}",
        "GUIDE_RATE_DEG": f"{np.rad2deg(made.guide.rate):.4g}",
        **{f"STATED_{name.upper()}": f"{error:g}" for name, error in config.error_bounds.model_dump().items()},
        **_limits(metadata.torque_limit),
        "SAMPLES": str(made.brake.samples),
        "COUNT": str(len(vectors.allowed)),
        "TOLERANCE": _TORQUE_TOLERANCE,
        "SITUATIONS": _situations(vectors.situation, policy),
        "REQUESTED": _rows(vectors.requested),
        "ALLOWED": _rows(vectors.allowed),
        "SAFE": ", ".join(str(int(safe)) for safe in vectors.safe),
        **_shield_constants(made, model, metadata),
    }
    return {name: _fill(name, replacements).encode() for name in SHIELD_FILES}


def _shield_constants(made: shield.Shield, model: Model, metadata: Metadata) -> dict[str, str]:
    """What the source of a shield holds, by placeholder."""
    brake, boresight_B = made.brake, jnp.array(metadata.boresight_B)
    numbers = {
        "MARGIN": made.margin,
        "ATTITUDE_ERROR": made.attitude_error,
        "BRAKE_TORQUE": brake.torque,
        "INERTIA_ERROR": brake.inertia_error,
        "DISTURBANCE": brake.disturbance,
        "RATE_ERROR": brake.rate_error,
        "SMALLEST_MOMENT": brake.smallest_moment,
        "LARGEST_MOMENT": brake.largest_moment,
        "SPEED_PER_MOMENTUM": brake_path.situation(pointing_constraints.absent(1, boresight_B), model).speed[0],
        "GUIDE_RATE": made.guide.rate,
        "GUIDE_SECONDS": made.guide.seconds,
        "GUIDE_TILT": made.guide.tilt,
        "GUIDE_AHEAD": guide.AHEAD,
        "SLOW_STEPS": shield.SLOW_STEPS,
        "RAISE": shield.RAISE,
    }
    shares = {"REQUEST_SHARES": shield.REQUEST_SHARES, "GUIDE_SHARES": shield.GUIDE_SHARES}
    return {
        "INERTIA": _matrix(model.inertia_B),
        "INVERSE_INERTIA": _matrix(dynamics.inverse(model.inertia_B)),
        **{f"{name}_COUNT": str(len(values)) for name, values in shares.items()},
        **{name: _row(values) for name, values in shares.items()},
        **{name: _number(float(value)) for name, value in numbers.items()},
    }


def _example(task: TaskConfig) -> dict[str, str]:
    """The rigid body of the example, in double precision, and how long it flies."""
    inertia = np.array(task.spacecraft.inertia)
    settled_deg = task.reward.settled_angle_deg / (1.0 if task.angle_convention == "full" else 0.5)
    exact = {"INERTIA": inertia, "INVERSE_INERTIA": np.linalg.inv(inertia)}
    return {
        "EXAMPLE": f"case {EXAMPLE_CASE} of koz evaluate",
        "STEPS": str(task.episode_steps),
        "ROW_STEPS": str(max(1, task.episode_steps // _EXAMPLE_ROWS)),
        "SETTLED_DEG": repr(float(settled_deg)),
        "EXACT_BORESIGHT": _exact_row(task.spacecraft.boresight),
        **{f"EXACT_{name}": ", ".join(f"{{{_exact_row(row)}}}" for row in rows) for name, rows in exact.items()},
    }


def _limits(limit: float | Vector) -> dict[str, str]:
    """What templates say of the torque limits: a constant where all axes have the same, a macro of the axis else."""
    if not isinstance(limit, tuple):
        return {
            "LIMIT_DEFINITION": f"KOZ_TORQUE_LIMIT {_number(limit)} /* [N m] about each body axis */",
            "LIMIT_OF_I": "KOZ_TORQUE_LIMIT",
            "LARGEST_LIMIT": "KOZ_TORQUE_LIMIT",
            "LARGEST_TORQUE": "sqrtf(3.0f) * KOZ_TORQUE_LIMIT",
            "SHARE_OF_I": "",
            "SHARE": " / KOZ_TORQUE_LIMIT",
        }
    x, y, z = (_number(each) for each in limit)
    choice = f"((axis) == 0 ? {x} : (axis) == 1 ? {y} : {z})"
    return {
        "LIMIT_DEFINITION": f"KOZ_TORQUE_LIMIT(axis) {choice} /* [N m] about a body axis */",
        "LIMIT_OF_I": "KOZ_TORQUE_LIMIT(i)",
        "LARGEST_LIMIT": _number(max(limit)),
        "LARGEST_TORQUE": _number(float(np.linalg.norm(limit))),
        "SHARE_OF_I": " / KOZ_TORQUE_LIMIT(i)",
        "SHARE": "",
    }


def _export_id(metadata: Metadata) -> str:
    """A number that files of one controller share, for the preprocessor."""
    return f"0x{metadata.training_sha256[:8]}"


def _head(metadata: Metadata) -> str:
    return "\n".join(f" * {line}".rstrip() for line in as_text(metadata).splitlines())


def _fill(name: str, replacements: dict[str, str]) -> str:
    text = (importlib.resources.files("koz_jax.export") / "templates" / name).read_text(encoding="utf-8")
    for key, value in replacements.items():
        text = text.replace(f"@{key}@", value)
    return text


def _number(value: float) -> str:
    """The shortest float32 constant that reads back as the same bits."""
    return f"{np.float32(value)!s}f"  # without !s it would have the digits of a float64


def _row(values: Iterable[float]) -> str:
    return ", ".join(_number(value) for value in values)


def _exact_row(values: Iterable[float]) -> str:
    return ", ".join(repr(float(value)) for value in values)


def _rows(table: np.ndarray) -> str:
    return ",\n".join(f"    {_braced(row)}" for row in table)


def _matrix(rows: ArrayLike) -> str:
    return ", ".join(_braced(row) for row in np.asarray(rows))


def _situations(rows: np.ndarray, policy: NumpyPolicy) -> str:
    zones = exported_zone_count(policy.record.network, policy.record.task.scenario)
    return ",\n".join(_situation(row, zones) for row in rows)


def _situation(row: np.ndarray, zones: int) -> str:
    q_BN, omega, q_DN, axes, half_angles = np.split(row, np.cumsum([4, 3, 4, 3 * zones]))
    attitude = ", ".join(_braced(part) for part in (q_BN, omega, q_DN))
    axis_rows = ", ".join(_braced(axis) for axis in axes.reshape(zones, 3))
    return f"    {{{attitude}, {{{axis_rows}}}, {_braced(half_angles)}}}"


def _braced(values: Iterable[float]) -> str:
    return f"{{{_row(values)}}}"


def _weights(policy: NumpyPolicy) -> Iterable[str]:
    for number, layer in enumerate(policy.layers):
        inputs, outputs = layer.kernel.shape
        kernel = ",\n".join(f"    {_row(row)}" for row in layer.kernel)
        yield f"static const float kernel_{number}[{inputs} * {outputs}] = {{\n{kernel}\n}};"
        yield f"static const float bias_{number}[{outputs}] = {{{_row(layer.bias)}}};"


_RELU = """static void relu(float *x, int size)
{
    int i;
    for (i = 0; i < size; i++) x[i] = x[i] < 0.0f ? 0.0f : x[i];
}

"""


def _decide(policy: NumpyPolicy) -> Iterable[str]:
    """Body of ``koz_decide``: encode, layer by layer, tanh."""
    shapes = [layer.kernel.shape for layer in policy.layers]
    for number, (inputs, _) in enumerate(shapes):
        yield f"float x{number}[{inputs}];"
    yield "int i;"
    yield "for (i = 0; i < KOZ_OBSERVATION_SIZE; i++) x0[i] = observation[i];"
    at = size(policy.record.network.observed_zones)
    for start, stop, scale in policy.views:
        seen = f"x0[{at} + i] = tanhf(observation[{start} + i] / {_number(scale)});"
        yield f"for (i = 0; i < {stop - start}; i++) {seen}"
        at += stop - start
    for number, (inputs, outputs) in enumerate(shapes):
        last = number == len(shapes) - 1
        into = "action" if last else f"x{number + 1}"
        yield f"dense(x{number}, {inputs}, kernel_{number}, bias_{number}, {outputs}, {into});"
        if not last:
            yield f"relu({into}, {outputs});"
    yield "for (i = 0; i < KOZ_ACTION_SIZE; i++) action[i] = tanhf(action[i]);"
