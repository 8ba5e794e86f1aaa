"""What the tests of command lines share."""

from pathlib import Path

import pytest
from support import tiny

from koz_jax.runs.folder import RunFolder


@pytest.fixture
def empty_cwd(tmp_path, monkeypatch) -> Path:
    """An empty folder to work in."""
    (tmp_path / "cwd").mkdir()
    monkeypatch.chdir(tmp_path / "cwd")
    monkeypatch.setenv("COLUMNS", "300")  # so that no message is wrapped
    return tmp_path / "cwd"


@pytest.fixture(scope="session")
def run() -> RunFolder:
    """A finished run; read it, do not change it."""
    return tiny.finished_run()


@pytest.fixture
def agent(tmp_path) -> Path:
    """Folder of an agent that nobody trained."""
    tiny.untrained_agent().save(tmp_path / "agent")
    return tmp_path / "agent"
