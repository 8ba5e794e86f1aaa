"""What the tests share."""

from collections.abc import Iterator

import jax
import pytest
from hypothesis import settings

from koz_jax import runtime, task
from koz_jax.env import EnvParams
from koz_jax.task_config import TaskConfig

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
def params() -> EnvParams:
    """The paper's spacecraft and reward, full-angle convention."""
    return task.env_params(TaskConfig())
