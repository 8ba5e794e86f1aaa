"""What the tests of training runs share."""

import shutil

import jax
import jax.core
import pytest
from support import tiny

from koz_jax.config.training import TrainConfig
from koz_jax.evaluation import cases
from koz_jax.learning import refinement, train_step
from koz_jax.runs.folder import RunFolder


@pytest.fixture(scope="session")
def run() -> RunFolder:
    """The undisturbed run; read it, do not change it."""
    return tiny.finished_run()


@pytest.fixture
def copied(run, tmp_path) -> RunFolder:
    """A copy of the undisturbed run, to be damaged."""
    shutil.copytree(run.path, tmp_path / "copy")
    return RunFolder(tmp_path / "copy")


@pytest.fixture
def no_compute(monkeypatch) -> None:
    """Make an error of whatever would be compiled."""
    init = train_step.init

    def only_shapes(config: TrainConfig, key: jax.Array) -> train_step.TrainState:
        return init(config, key) if isinstance(key, jax.core.Tracer) else pytest.fail("networks were made")

    monkeypatch.setattr(train_step, "init", only_shapes)
    monkeypatch.setattr(train_step, "train_chunk", lambda *_: pytest.fail("something was learned"))
    monkeypatch.setattr(refinement, "refine_chunk", lambda *_: pytest.fail("something was refined"))
    monkeypatch.setattr(cases, "fly_cases", lambda *_: pytest.fail("something was flown"))
