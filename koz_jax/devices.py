"""What depends on the device that computes."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


def on_gpu() -> bool:
    """Whether programs run on a GPU unless told otherwise."""
    return jax.default_backend() == "gpu"


def in_float32(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Let a function compute products of matrices in float32 on a GPU too, whose default has three digits (TF32)."""

    @functools.wraps(function)
    def exact(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        if not on_gpu():
            return function(*args, **kwargs)
        with jax.default_matmul_precision("float32"):
            return function(*args, **kwargs)

    return exact
