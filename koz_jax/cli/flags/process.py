"""Flags of commands that several processes can work on together.  Imports no jax."""

from __future__ import annotations

import re
from typing import Self

from pydantic import model_validator

from koz_jax.config.base import Settings


class ProcessFlags(Settings):
    """Which of several processes this is."""

    coordinator: str | None = None
    """Work together with other processes, on this machine or on others that see the same files: the address
    (host:port) of the first of them.  All get the same command, but for --process."""
    processes: int = 1
    """How many processes there are."""
    process: int = 0
    """The number of this one; number 0 writes the results."""

    @model_validator(mode="after")
    def _can_be(self) -> Self:
        if self.coordinator is None:
            for name in ("processes", "process"):
                value = getattr(self, name)
                if value != ProcessFlags.model_fields[name].default:
                    raise ValueError(f"{name}: needs --coordinator, got {value} without it")
        elif not re.fullmatch(r"[^\s:]+:[0-9]{1,5}", self.coordinator):
            raise ValueError(f"coordinator: must be host:port, got {self.coordinator!r}")
        elif not 1 <= int(self.coordinator.rpartition(":")[2]) <= 65535:
            raise ValueError(f"coordinator: its port must be from 1 to 65535, got {self.coordinator!r}")
        if self.processes < 1:
            raise ValueError(f"processes: must be 1 or more, got {self.processes}")
        if not 0 <= self.process < self.processes:
            raise ValueError(f"process: must be from 0 to processes - 1 = {self.processes - 1}, got {self.process}")
        return self

    def join(self) -> None:
        """Find the other processes, if there are any.  Call before anything touches a device.

        Raises:
            SettingsError: they are not found.

        """
        if self.coordinator is not None:
            from koz_jax.storage import runtime

            runtime.join(self.coordinator, self.processes, self.process)
