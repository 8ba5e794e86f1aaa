"""Process-wide settings of jax for the command lines; libraries and notebooks are left alone."""

import os
from pathlib import Path

import jax


def configure() -> None:
    """Use every CPU core as a device for evaluation, and keep compiled programs from one run to the next.

    Call before anything touches a device.
    """
    jax.config.update(
        "jax_num_cpu_devices", len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    )
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        root = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
        jax.config.update("jax_compilation_cache_dir", str(root / "koz_jax" / "compiled"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)
