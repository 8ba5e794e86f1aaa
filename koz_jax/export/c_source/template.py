"""Templates of C source, and what every file of an export holds: its head, limits, and a number of its own."""

import hashlib
import importlib.resources
from collections.abc import Mapping

from koz_jax.config.base import Vector
from koz_jax.export.c_source import literals, variants
from koz_jax.export.c_source.variants import Variant
from koz_jax.export.metadata import Metadata, as_text


def filled(names: tuple[str, ...], metadata: Metadata, replacements: Mapping[str, str]) -> dict[str, bytes]:
    """Templates by name, with the text of their placeholders; later ones stand in the text of earlier ones, too."""
    variant = variants.of(metadata)
    common = {
        **variants.replacements(variant),
        "HEAD": _head(metadata),
        "EXPORT_ID": _export_id(metadata),
        **_limits(metadata.torque_limit),
    }
    return {name: _fill(name, {**replacements, **common}, variant).encode() for name in names}


def _limits(limit: float | Vector) -> dict[str, str]:
    """What templates say of the torque limits: a constant where all axes have the same, a macro of the axis else."""
    if not isinstance(limit, tuple):
        return {
            "LIMIT_DEFINITION": f"KOZ_TORQUE_LIMIT {literals.number(limit)} /* [N m] about each body axis */",
            "LIMIT_OF_I": "KOZ_TORQUE_LIMIT",
            "LARGEST_LIMIT": "KOZ_TORQUE_LIMIT",
        }
    x, y, z = (literals.number(each) for each in limit)
    choice = f"((axis) == 0 ? {x} : (axis) == 1 ? {y} : {z})"
    return {
        "LIMIT_DEFINITION": f"KOZ_TORQUE_LIMIT(axis) {choice} /* [N m] about a body axis */",
        "LIMIT_OF_I": "KOZ_TORQUE_LIMIT(i)",
        "LARGEST_LIMIT": literals.number(max(limit)),
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


def _fill(name: str, replacements: Mapping[str, str], variant: Variant) -> str:
    text = (importlib.resources.files("koz_jax.export") / "templates" / name).read_text(encoding="utf-8")
    for key, value in replacements.items():
        text = text.replace(f"@{key}@", value)
    return variants.lines_for(text, variant)
