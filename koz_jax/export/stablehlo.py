"""StableHLO of a controller, through ``jax.export``."""

from typing import Any

import jax
import jax.export
import jax.numpy as jnp
from jax.export import Exported

from koz_jax.agents.agent import Agent
from koz_jax.errors import missing_extra
from koz_jax.export.metadata import Metadata, as_text
from koz_jax.task.observation_layout import size

_PLATFORMS = ("cpu", "cuda", "rocm", "tpu")


def stablehlo_files(agent: Agent, metadata: Metadata) -> dict[str, bytes]:
    """Three files by name.

    - ``koz_policy.mlir``: the program as text, observation (entries,) to action (3,), for any compiler of StableHLO.
      The metadata are at its head.
    - ``koz_policy.jax_export``: for ``jax.export.deserialize``, observations (batch, entries) to actions (batch, 3),
      on all platforms.  It has no room for metadata; its ``fun_name`` holds the hash of the training's settings.
    - ``koz_policy.json``: the metadata.

    Raises:
        MissingExtraError: a package that serialisation needs is not installed.

    """
    entries = size(metadata.network.observed_zones, metadata.network.scaled)
    (batch,) = jax.export.symbolic_shape("batch")
    try:
        serialised = _exported(agent, metadata, (batch, entries), _PLATFORMS).serialize()
    except ImportError as error:
        raise missing_extra(error, "flatbuffers", "stablehlo") from None
    head = "".join(f"// {line}".rstrip() + "\n" for line in as_text(metadata).splitlines())
    return {
        "koz_policy.mlir": (head + _exported(agent, metadata, (entries,), ("cpu",)).mlir_module()).encode(),
        "koz_policy.jax_export": bytes(serialised),
        "koz_policy.json": (metadata.to_json(indent=2) + "\n").encode(),
    }


def _exported(agent: Agent, metadata: Metadata, shape: tuple[Any, ...], platforms: tuple[str, ...]) -> Exported:
    def decide(observed: jax.Array) -> jax.Array:
        return agent.controller.act(observed)

    decide.__name__ = f"koz_policy_{metadata.training_sha256[:16]}"
    return jax.export.export(jax.jit(decide), platforms=platforms)(jax.ShapeDtypeStruct(shape, jnp.float32))
