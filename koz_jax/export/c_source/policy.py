"""C99 source of a controller: no allocation, fixed loops, constants, nothing beyond libm."""

import numpy as np

from koz_jax.agents.numpy_policy import NumpyPolicy, exported_zone_count
from koz_jax.export.c_source import literals, network, observation, template, wheels
from koz_jax.export.c_source.wheels import WHEEL_FILES
from koz_jax.export.golden import EXAMPLE_CASE, Golden
from koz_jax.export.metadata import Metadata
from koz_jax.task.observation_layout import ACTION_SIZE, size

C_FILES = ("koz_math.h", "koz_policy.h", "koz_policy.c", "koz_selftest.c", "koz_example.c", "Makefile")

# 1e-5 of the action's range, which is 2.
_ACTION_TOLERANCE = "2e-5"
_OBSERVATION_TOLERANCE = "2e-5"

_EXAMPLE_ROWS = 20


def c_files(policy: NumpyPolicy, metadata: Metadata, vectors: Golden, example: np.ndarray) -> dict[str, bytes]:
    """Headers, source, self-test with golden vectors, example, and Makefile, by file name.

    example: the situation in which the example's maneuver starts, a row as in ``Golden``.
    """
    seen, spacecraft = metadata.network, metadata.task.spacecraft
    zones = exported_zone_count(seen, metadata.task.scenario, metadata.least_zones)
    wheel_count = len(spacecraft.wheels)
    replacements = {
        **observation.replacements(metadata, vectors),
        **wheels.replacements(spacecraft, vectors),
        "OBSERVATION_SIZE": str(size(seen.observed_zones, seen.scaled)),
        "ZONES": str(zones),
        "OBSERVED_ZONES": str(seen.observed_zones),
        "ACTION_SIZE": str(ACTION_SIZE),
        "STEP_SECONDS": literals.number(metadata.step_seconds),
        "CONFIG_SHA256": metadata.provenance.config_sha256 or "unknown",
        "TRAINING_SHA256": metadata.training_sha256,
        "WEIGHTS_SHA256": metadata.weights_sha256,
        "BORESIGHT": literals.of_each([literals.row(boresight_B) for boresight_B in metadata.boresights_B]),
        "WEIGHTS": network.weights(policy),
        "HELPERS": network.helpers(policy),
        "DECIDE": network.decide(policy),
        "COUNT": str(len(vectors.action)),
        "ACTION_TOLERANCE": _ACTION_TOLERANCE,
        "OBSERVATION_TOLERANCE": _OBSERVATION_TOLERANCE,
        "SITUATIONS": literals.situations(vectors.situation, zones, wheel_count),
        "SITUATION": literals.situation(example, zones, wheel_count),
        **_example(metadata),
        "OBSERVATIONS": literals.rows(vectors.observation),
        "ACTIONS": literals.rows(vectors.action),
    }
    return template.filled(C_FILES + (WHEEL_FILES if wheel_count else ()), metadata, replacements)


def _example(metadata: Metadata) -> dict[str, str]:
    """The rigid body of the example and its wheels, in double precision, and how long it flies."""
    task, spacecraft = metadata.task, metadata.task.spacecraft
    settled_deg = task.reward.settled_angle_deg / (1.0 if task.angle_convention == "full" else 0.5)
    looks = [literals.exact_row(boresight_B) for boresight_B in metadata.boresights_B]
    return {
        "EXAMPLE": f"case {EXAMPLE_CASE} of koz evaluate",
        "STEPS": str(task.episode_steps),
        "ROW_STEPS": str(max(1, task.episode_steps // _EXAMPLE_ROWS)),
        "SETTLED_DEG": repr(float(settled_deg)),
        "EXACT_BORESIGHT": literals.of_each(looks),
        "EXACT_INERTIA": literals.exact_matrix(spacecraft.inertia),
        "EXACT_INVERSE_INERTIA": literals.exact_matrix(np.linalg.inv(np.array(spacecraft.inertia))),
        "EXACT_WHEEL_AXES": literals.exact_matrix(wheel.axis for wheel in spacecraft.wheels),
        "EXACT_MAX_MOMENTUM": literals.exact_row(wheel.max_momentum for wheel in spacecraft.wheels),
    }
