"""What the tests share."""

import os
from collections.abc import Iterator

# Numbers are compared with those of the CPU: also where a GPU is present, and in subprocesses.
os.environ["JAX_PLATFORMS"] = os.environ.get("KOZ_JAX_TEST_PLATFORM", "cpu")

import jax
import pytest
from hypothesis import settings

from koz_jax.storage import runtime
from koz_jax.task.environment import Reorientation

# For the other workers, for subprocesses, and for the next session.
runtime.keep_programs()

# The first example of a property compiles; a deadline would measure that.
settings.register_profile("koz_jax", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("koz_jax")


@pytest.fixture(scope="module")
def strict_shapes() -> Iterator[None]:
    """Refuse implicit broadcasting between ranks: code for one sample needs none."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(scope="session")
def env() -> Reorientation:
    """The paper's task: spacecraft, reward (full-angle convention), scenarios."""
    return Reorientation.from_config()
