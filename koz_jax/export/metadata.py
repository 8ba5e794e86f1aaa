"""What every exported file says about itself: the observation's definition, limits, hashes, origin."""

import hashlib
import json
import textwrap
from collections.abc import Iterable, Sequence

from koz_jax.agents.numpy_policy import NumpyPolicy
from koz_jax.agents.record import Provenance, Record
from koz_jax.config.base import Settings, Vector
from koz_jax.config.task import ScenarioConfig, TaskConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.config.version import version
from koz_jax.errors import SettingsError
from koz_jax.export import wheels_text
from koz_jax.task.any_spacecraft import constants
from koz_jax.task.observation_layout import layout, meaning, slices


class Entry(Settings):
    """One part of the observation."""

    name: str
    start: int
    size: int
    meaning: str


_ACTION = "three numbers in [-1, 1]; times torque_limit that is the torque in body axes [N m], held for a step"
_SCALED_ACTION = (
    "three numbers in [-1, 1], an angular acceleration in the policy's axes; the matrix torque_per_action times them,"
    " clipped to plus or minus torque_limit about each body axis, is the torque in body axes [N m], held for a step"
)


class Scaling(Settings):
    """How a policy for any spacecraft sees and moves the one that it was exported for."""

    time_unit: float
    """T = sqrt(J / u) [s]."""
    inertia_unit: float
    """J [kg m^2], a third of the trace of the inertia."""
    torque_unit: float
    """u [N m], the root mean square of the torque limits."""
    axes: tuple[Vector, Vector, Vector]
    """The policy's axes, rows in body components: v_P = axes v_B."""
    seen: dict[str, tuple[float, ...]]
    """Parts of the observation that are the same all the time; but reach and rate_limit of a spacecraft with wheels,
    which are those of the start, at rest."""
    times_per_rate: tuple[Vector, Vector, Vector]
    """[s^2] The inertia over the torque limit of each axis: takes a rate [rad/s] in body axes to the times [s] in which
    the limits stop it, for stopping and turning; of a spacecraft with wheels, the limits at rest."""
    torque_per_action: tuple[Vector, Vector, Vector]
    """[N m] Takes an action to a torque in body axes."""
    urgency: float
    """Urgency where none is set, from 0 (thrifty) to 1 (as fast as the torque allows); the observation holds twice that
    minus 1."""


class Instrument(Settings):
    """An instrument after the first, and how a policy for any spacecraft sees and moves what it is nearest for."""

    boresight_B: Vector
    scaling: Scaling


class Metadata(Settings):
    """What a user of an exported controller must know; goes to and from JSON."""

    name: str
    koz_jax_version: str
    observation: tuple[Entry, ...]
    action: str = _ACTION
    torque_limit: float | Vector  # [N m] about each body axis: one number for all, or one for each
    step_seconds: float
    boresight_B: tuple[float, float, float]
    training_sha256: str
    weights_sha256: str
    network: NetworkConfig
    task: TaskConfig
    provenance: Provenance
    scaling: Scaling | None = None
    """Of a policy for any spacecraft."""
    wheels: str = ""
    """What depends on the momentum of reaction wheels; empty where there are none."""
    further_instruments: tuple[Instrument, ...] = ()
    """Those whose zones are told by the numbers 1, 2, ...; number 0 is ``boresight_B``, with ``scaling``."""
    least_zones: int = 0
    """C is told of so many zones at least, also where the policy sees fewer."""

    @property
    def boresights_B(self) -> tuple[Vector, ...]:
        """Boresights of all instruments, in body axes, by their numbers."""
        return (self.boresight_B, *(instrument.boresight_B for instrument in self.further_instruments))

    def to_json(self, indent: int | None = None) -> str:
        """What exported files hold."""
        unused = {
            name for name in ("scaling", "wheels", "further_instruments", "least_zones") if not getattr(self, name)
        }
        return self.model_dump_json(indent=indent, exclude=unused)


def describe(
    policy: NumpyPolicy,
    task: TaskConfig | None = None,
    urgency: float = 0.5,
    further_boresights: Sequence[Vector] = (),
    least_zones: int = 0,
) -> Metadata:
    """Metadata of a policy.

    Args:
        policy: who is exported.
        task: with the spacecraft that it is exported for, by default its own.
        urgency: where none is set, of a policy that sees one.
        further_boresights: unit vectors (3,) in body axes, of the spacecraft's instruments after the first.
        least_zones: zones that C is told of at least.

    Raises:
        SettingsError: the spacecraft has gyros, or several instruments and the policy is not for any spacecraft.

    """
    record = policy.record
    task = task or record.task
    zones, scaled = record.network.observed_zones, record.network.scaled
    _check(policy.name, scaled, task, len(further_boresights))
    where = slices(zones, scaled)
    limits = task.spacecraft.torque_limits
    return Metadata(
        name=policy.name,
        koz_jax_version=version(),
        observation=tuple(
            Entry(name=name, start=where[name].start, size=size, meaning=meaning(name, scaled))
            for name, size in layout(zones, scaled).items()
        ),
        action=_SCALED_ACTION if scaled else _ACTION,
        torque_limit=limits[0] if len({*limits}) == 1 else limits,
        step_seconds=task.step_seconds,
        boresight_B=task.spacecraft.boresight,
        training_sha256=training_sha256(record),
        weights_sha256=weights_sha256(policy),
        network=record.network,
        task=task,
        provenance=record.provenance,
        scaling=_scaling(task, urgency, task.spacecraft.boresight) if scaled else None,
        wheels=wheels_text.meaning_of(task.spacecraft.wheels, scaled),
        further_instruments=tuple(
            Instrument(boresight_B=boresight, scaling=_scaling(task, urgency, boresight))
            for boresight in further_boresights
        ),
        least_zones=least_zones,
    )


def _check(name: str, scaled: bool, task: TaskConfig, further: int) -> None:
    """Refuse what exports do not know."""
    if task.spacecraft.gyros:
        raise SettingsError("spacecraft.gyros: are not exported yet; allowed are torque_limit and wheels")
    if further and not scaled:
        raise SettingsError(
            f"further_boresights: must be none for {name}, which was trained for one spacecraft with one instrument,"
            f" got {further}"
        )


def _scaling(task: TaskConfig, urgency: float, boresight: Vector) -> Scaling:
    own = constants.of(task.spacecraft, task.step_seconds, boresight)
    return Scaling.model_validate(
        {
            "time_unit": own.time,
            "inertia_unit": own.inertia,
            "torque_unit": own.torque,
            "axes": own.axes.tolist(),
            "seen": {name: own.seen[name].tolist() for name in layout(scaled=True) if name in own.seen},
            "times_per_rate": own.times_per_rate.tolist(),
            "torque_per_action": own.torque_per_action.tolist(),
            "urgency": urgency,
        }
    )


def training_sha256(record: Record) -> str:
    """Hash of what determined the training: network, task, and the command, commit, seed and length of the run."""
    content = record.model_dump(mode="json", exclude={"provenance": {"table"}})
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def weights_sha256(policy: NumpyPolicy) -> str:
    """Hash of the exported weights: kernel, bias and gain of each layer as little-endian float32."""
    digest = hashlib.sha256()
    for layer in policy.layers:
        digest.update(layer.kernel.astype("<f4").tobytes())
        digest.update(layer.bias.astype("<f4").tobytes())
        if layer.gain is not None:
            digest.update(layer.gain.astype("<f4").tobytes())
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
        *(_scaling_text(metadata.scaling) if metadata.scaling else ()),
        *([metadata.wheels] if metadata.wheels else []),
        *_instruments_text(metadata.further_instruments),
        f"Limits: torque {_torque(metadata.torque_limit)}; time step {metadata.step_seconds:g} s;"
        f" boresight {list(metadata.boresight_B)} in body axes; inertia {[list(r) for r in task.spacecraft.inertia]}"
        f" kg m^2; {_training(metadata.network, task.scenario)}.",
        "",
        f"Trained by: {origin.command or 'unknown'} (commit {origin.commit or 'unknown'}, seed {origin.seed}).",
        f"Hash of the training run's config.json: {origin.config_sha256 or 'unknown'}",
        f"Hash of network, task and origin: {metadata.training_sha256}",
        f"Hash of the weights: {metadata.weights_sha256}",
    ]
    wrapped = (piece for line in lines for piece in textwrap.wrap(line, 110, subsequent_indent="    ") or [""])
    return "\n".join(wrapped).replace("\\", "/").replace("*/", "* /").replace("/*", "/ *")


def _scaling_text(scaling: Scaling) -> list[str]:
    return [
        f"Units of this spacecraft: T = sqrt(J / u) = {scaling.time_unit:.6g} s, J = {scaling.inertia_unit:.6g} kg m^2,"
        f" u = {scaling.torque_unit:.6g} N m. The policy's axes have x along the boresight; their rows in body"
        f" components: {_matrix(scaling.axes)}. torque_per_action: {_matrix(scaling.torque_per_action)} N m."
        f" times_per_rate, the inertia over the torque limits: {_matrix(scaling.times_per_rate)} s^2."
        f" Constant parts of the observation: {_seen(scaling)}. Urgency u01 in [0, 1] is seen as 2 u01 - 1.",
    ]


def _instruments_text(further: Sequence[Instrument]) -> list[str]:
    if not further:
        return []
    each = (
        f"Instrument {number}: boresight [{_row(instrument.boresight_B)}] in body axes; axes"
        f" {_matrix(instrument.scaling.axes)}; torque_per_action {_matrix(instrument.scaling.torque_per_action)} N m;"
        f" constant parts {_seen(instrument.scaling)}."
        for number, instrument in enumerate(further, 1)
    )
    return [
        "The policy's axes are those of the nearest zone's instrument. Axes, torque_per_action and constant parts above"
        " are of instrument 0.",
        *each,
    ]


def _row(values: Iterable[float]) -> str:
    return ", ".join(f"{value:.6g}" for value in values)


def _matrix(rows: Iterable[Vector]) -> str:
    return "[" + ", ".join(f"[{_row(row)}]" for row in rows) + "]"


def _seen(scaling: Scaling) -> str:
    return "; ".join(f"{name} {_row(values)}" for name, values in scaling.seen.items())


def _training(network: NetworkConfig, scenario: ScenarioConfig) -> str:
    if network.scaled:
        # The scenario is that of its evaluation: which zones its training drew is not in the record.
        nearest = "zone" if network.observed_zones == 1 else f"{network.observed_zones} zones"
        return f"trained for any spacecraft, sees the nearest {nearest}"
    return (
        f"trained for {_count(scenario)} of {scenario.min_half_angle_deg:g} to {scenario.max_half_angle_deg:g} deg half"
        f" angle and maneuvers that start {_start(scenario)}"
    )


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
