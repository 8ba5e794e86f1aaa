"""Ctrl-C and SIGTERM ask a run to stop at the next safe point; a second one aborts at once."""

import contextlib
import os
import signal
import threading
from types import FrameType
from typing import Self

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class GracefulShutdown:
    """While active, the first signal only sets ``requested``."""

    def __init__(self) -> None:
        """No stop has been requested yet."""
        self.requested = False
        self._previous: dict[int, object] = {}

    def __enter__(self) -> Self:
        # Python delivers signals to the main thread, and only it may set handlers.
        if threading.current_thread() is threading.main_thread():
            self._previous = {number: signal.signal(number, self._on_signal) for number in _SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]

    def _on_signal(self, number: int, _: FrameType | None) -> None:
        self.requested = True
        for restored in _SIGNALS:
            signal.signal(restored, signal.SIG_DFL)
        name = signal.Signals(number).name
        # Not print: the signal may have come while sys.stderr was being written to, which may not be entered again.
        with contextlib.suppress(OSError):
            os.write(2, f"\n{name}: finishing the chunk, then checkpointing; again to abort at once\n".encode())
