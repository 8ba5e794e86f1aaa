"""What the tests share."""

import gc
import os
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path

# Numbers are compared with those of the CPU: also where a GPU is present, and in subprocesses.
os.environ["JAX_PLATFORMS"] = os.environ.get("KOZ_JAX_TEST_PLATFORM", "cpu")
# Every worker has a core, on which several threads of PyTorch would wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# Most of the time goes into compiling: without optimisation that takes less than half, though loops run slower.
_QUICK = ["--xla_backend_optimization_level=0"]
if version("jaxlib").startswith("0.10."):  # others end a process at the name of a flag that they do not know
    _QUICK += ["--xla_cpu_use_fusion_emitters=false", "--xla_cpu_parallel_codegen_split_count=1"]
if os.environ["JAX_PLATFORMS"] == "cpu":
    # Each once: what is compiled is kept by its flags as they are written.
    os.environ["XLA_FLAGS"] = " ".join(dict.fromkeys([*os.environ.get("XLA_FLAGS", "").split(), *_QUICK]))

import jax
import pytest
from hypothesis import settings

from koz_jax.storage import runtime
from koz_jax.task.environment import Reorientation

# For the other workers, for subprocesses, and for the next session.
runtime.keep_programs()

# What is traced is kept: to look through it for garbage every few hundred objects takes 6 % of the time.
gc.set_threshold(100_000, 50, 50)

# The first example of a property compiles; a deadline would measure that.
settings.register_profile("koz_jax", deadline=None, derandomize=True, max_examples=50)
settings.load_profile("koz_jax")


# A training run takes seconds: a test that needs one is slow.
_SLOW_FIXTURES = {"run", "copied"}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that have most slow tests, so that all workers are busy to the end."""
    for item in items:
        if _SLOW_FIXTURES.intersection(getattr(item, "fixturenames", ())):
            item.add_marker(pytest.mark.slow)
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


# Linux lets a process map 65,530 pieces of memory.  Every compiled program takes some, and past the limit XLA crashes.
_MANY_MAPPINGS = 40_000


@pytest.fixture(scope="module", autouse=True)
def few_programs() -> Iterator[None]:
    """Forget what was compiled after a file of tests, where a worker has come to hold much."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MANY_MAPPINGS:
        jax.clear_caches()
        gc.collect()


@pytest.fixture(scope="module")
def strict_shapes() -> Iterator[None]:
    """Refuse implicit broadcasting between ranks: code for one sample needs none."""
    with jax.numpy_rank_promotion("raise"):
        yield


@pytest.fixture(scope="session")
def env() -> Reorientation:
    """The paper's task: spacecraft, reward (full-angle convention), scenarios."""
    return Reorientation.from_config()
