"""What every exported file says about itself: the observation's definition, limits, hashes, origin."""

import hashlib
import json
import textwrap

from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.agents.record import Provenance, Record
from koz_jax.config.base import Settings, Vector
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.config.version import version
from koz_jax.task.observation_layout import layout, meaning, slices


class Entry(Settings):
    """One part of the observation."""

    name: str
    start: int
    size: int
    meaning: str


class Metadata(Settings):
    """What a user of an exported controller must know; goes to and from JSON."""

    name: str
    koz_jax_version: str
    observation: tuple[Entry, ...]
    action: str = "three numbers in [-1, 1]; times torque_limit that is the torque in body axes [N m], held for a step"
    torque_limit: float | Vector  # [N m] about each body axis: one number for all, or one for each
    step_seconds: float
    boresight_B: tuple[float, float, float]
    training_sha256: str
    weights_sha256: str
    network: NetworkConfig
    task: TaskConfig
    provenance: Provenance


def describe(policy: NumpyPolicy) -> Metadata:
    """Metadata of a policy."""
    record = policy.record
    zones = record.network.observed_zones
    where = slices(zones)
    limits = record.task.spacecraft.torque_limits
    return Metadata(
        name=policy.name,
        koz_jax_version=version(),
        observation=tuple(
            Entry(name=name, start=where[name].start, size=size, meaning=meaning(name))
            for name, size in layout(zones).items()
        ),
        torque_limit=limits[0] if len({*limits}) == 1 else limits,
        step_seconds=record.task.step_seconds,
        boresight_B=record.task.spacecraft.boresight,
        training_sha256=training_sha256(record),
        weights_sha256=weights_sha256(policy),
        network=record.network,
        task=record.task,
        provenance=record.provenance,
    )


def training_sha256(record: Record) -> str:
    """Hash of what determined the training: network, task, and the command, commit, seed and length of the run."""
    content = record.model_dump(mode="json", exclude={"provenance": {"table"}})
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def weights_sha256(policy: NumpyPolicy) -> str:
    """Hash of the exported weights: kernel and bias of each layer as little-endian float32."""
    digest = hashlib.sha256()
    for layer in policy.layers:
        digest.update(layer.kernel.astype("<f4").tobytes())
        digest.update(layer.bias.astype("<f4").tobytes())
    return digest.hexdigest()


def as_text(metadata: Metadata) -> str:
    """For the head of a text file: lines without anything that could end a comment."""
    task, origin = metadata.task, metadata.provenance
    lines = [
        f"Keep-out-zone attitude controller '{metadata.name}', exported by koz_jax {metadata.koz_jax_version}.",
        "",
        f"Observation: {sum(entry.size for entry in metadata.observation)} numbers; quaternions are scalar-first, and"
        " q_BN takes body components to inertial ones.",
        *(_entry_text(entry) for entry in metadata.observation),
        f"Action: {metadata.action}.",
        f"Limits: torque {_torque(metadata.torque_limit)}; time step {metadata.step_seconds:g} s;"
        f" boresight {list(metadata.boresight_B)} in body axes; inertia {[list(r) for r in task.spacecraft.inertia]}"
        f" kg m^2; trained for {_count(task.scenario)} of {task.scenario.min_half_angle_deg:g} to"
        f" {task.scenario.max_half_angle_deg:g} deg half angle and maneuvers that start {_start(task.scenario)}.",
        "",
        f"Trained by: {origin.command or 'unknown'} (commit {origin.commit or 'unknown'}, seed {origin.seed}).",
        f"Hash of the training run's config.json: {origin.config_sha256 or 'unknown'}",
        f"Hash of network, task and origin: {metadata.training_sha256}",
        f"Hash of the weights: {metadata.weights_sha256}",
    ]
    wrapped = (piece for line in lines for piece in textwrap.wrap(line, 110, subsequent_indent="    ") or [""])
    return "\n".join(wrapped).replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")


def _count(scenario: ScenarioConfig) -> str:
    if scenario.max_zones == 1:
        return "one zone"
    return f"{scenario.min_zones} to {scenario.max_zones} zones"


def _torque(limit: float | Vector) -> str:
    if isinstance(limit, tuple):
        return f"{limit[0]:g}, {limit[1]:g} and {limit[2]:g} N m about the body axes"
    return f"{limit:g} N m about each body axis"


def _start(scenario: ScenarioConfig) -> str:
    if scenario.max_rate_deg == 0:
        return "at rest"
    return f"at up to {scenario.max_rate_deg:g} deg/s about each axis"


def _entry_text(entry: Entry) -> str:
    where = f"[{entry.start}]" if entry.size == 1 else f"[{entry.start}..{entry.start + entry.size - 1}]"
    return f"  {where:8} {entry.name}: {entry.meaning}"
