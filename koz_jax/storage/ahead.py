"""Compile in the background what later stages need, while the first one computes.

On a GPU, where the processor has nothing else to do, and compiling takes longer than computing.  The programs go into
the cache of compiled programs (see ``runtime.keep_programs``), where those who need them find them.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor, wait

from koz_jax import devices
from koz_jax.storage import runtime

Compile = Callable[[], None]
Await = Callable[[str], None]  # returns when the program of this name is there, or could not be compiled


@contextlib.contextmanager
def compiling(programs: Mapping[str, Compile]) -> Iterator[Await]:
    """Compile programs by name, where that pays; yields what waits for one of them."""
    if not (programs and devices.on_gpu() and runtime.keeps_programs()):
        yield lambda name: None
        return
    pool = ThreadPoolExecutor(len(programs), "compile")
    under_way = {name: pool.submit(compile_one) for name, compile_one in programs.items()}

    def await_one(name: str) -> None:
        # What went wrong there goes wrong again, and is reported, where the program is called.
        if name in under_way:
            wait([under_way[name]])

    try:
        yield await_one
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
