"""What tests of exports to C share.  A file says what is ``exported``: its contents by name."""

from pathlib import Path

import pytest

from koz_jax.export.files import write_files
from koz_jax.export.library import CLibrary


@pytest.fixture(scope="module")
def folder(exported, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("c")
    write_files(path, exported)
    return path


@pytest.fixture(scope="module")
def library(folder) -> CLibrary:
    return CLibrary(folder)
