"""What the tests of training runs share: a signal at a given moment, and runs that must be the same to the last bit."""

import contextlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from koz_jax.agents.agent import load_agent
from koz_jax.runs import checkpoint
from koz_jax.runs.checkpoint import RunState
from koz_jax.runs.folder import RunFolder
from koz_jax.runs.progress import Progress
from koz_jax.storage import archive
from support.tiny import CONFIG


@contextlib.contextmanager
def signal_after(done: int, number: signal.Signals) -> Iterator[None]:
    """Send this process a signal when a run has done so much."""
    advance = Progress.advance

    def advance_and_signal(bar: Progress, at: int) -> None:
        advance(bar, at)
        if at == done:
            signal.raise_signal(number)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Progress, "advance", advance_and_signal)
        yield


def state_of(folder: Path) -> RunState:
    """A saved state of ``CONFIG``."""
    return archive.load_tree(folder, checkpoint.template(CONFIG))


def assert_same_tree(found: Any, expected: Any) -> None:
    for (path, one), (_, other) in zip(
        jax.tree_util.tree_leaves_with_path(found), jax.tree_util.tree_leaves_with_path(expected), strict=True
    ):
        keys = isinstance(one, jax.Array) and jax.dtypes.issubdtype(one.dtype, jax.dtypes.prng_key)  # pyright: ignore
        if keys:
            one, other = jax.random.key_data(one), jax.random.key_data(other)
        np.testing.assert_array_equal(one, other, err_msg=jax.tree_util.keystr(path), strict=True)


def assert_same_run(found: RunFolder, expected: RunFolder) -> None:
    """Same to the last bit."""
    assert_same_tree(state_of(found.checkpoints()[0]), state_of(expected.checkpoints()[0]))
    assert_same_tree(state_of(found.snapshot("phase1")), state_of(expected.snapshot("phase1")))
    assert (found.path / "metrics.csv").read_bytes() == (expected.path / "metrics.csv").read_bytes()
    for name in ("phase1", "phase2"):
        one, other = (load_agent(folder.agent(name)) for folder in (found, expected))
        assert_same_tree(one.controller, other.controller)
        assert one.provenance.updates == other.provenance.updates
