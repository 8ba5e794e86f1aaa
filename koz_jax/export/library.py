"""Fly the exported C source from Python: compile it, load it, ask it.  Needs a C compiler; imports no jax."""

import ctypes
import re
import subprocess
import tempfile
from pathlib import Path

import numpy as np

from koz_jax.errors import SettingsError
from koz_jax.task.observation_layout import ACTION_SIZE

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")


class CLibrary:
    """The functions of an exported ``koz_policy.c`` over batches of rows."""

    def __init__(self, folder: Path | str, compiler: str = "cc") -> None:
        """Compile and load.

        folder: where ``koz export AGENT --to c`` has written.

        Raises:
            SettingsError: there is no exported source, or it cannot be compiled.

        """
        source, shield = Path(folder) / "koz_policy.c", Path(folder) / "koz_shield.c"
        if not source.is_file():
            raise SettingsError(f"folder: {folder} holds no koz_policy.c; koz export AGENT --to c makes one")
        with tempfile.TemporaryDirectory() as built:
            library = Path(built) / "koz_policy.so"
            sources = [str(path) for path in (source, shield) if path.is_file()]
            command = [compiler, *STRICT, "-O2", "-shared", "-fPIC", "-o", str(library), *sources, "-lm"]
            try:
                done = subprocess.run(command, capture_output=True, text=True, check=False)
            except OSError as error:
                raise SettingsError(f"compiler: {compiler!r} cannot be run: {error.strerror}") from None
            if done.returncode:
                raise SettingsError(f"compiler: {compiler!r} refuses {source}: {done.stderr.strip()}")
            self._functions = ctypes.CDLL(str(library))
        header = (Path(folder) / "koz_policy.h").read_text(encoding="utf-8")
        self.zones, self._observation_size = (
            int(re.findall(rf"#define {name} (\d+)", header)[0]) for name in ("KOZ_ZONES", "KOZ_OBSERVATION_SIZE")
        )
        for name in ("koz_observe", "koz_decide", "koz_torque"):
            getattr(self._functions, name).argtypes = (ctypes.c_void_p, ctypes.c_void_p)
            getattr(self._functions, name).restype = None
        self.has_shield = shield.is_file()
        if self.has_shield:
            self._functions.koz_shield.argtypes = (ctypes.c_void_p,) * 3
            self._functions.koz_shield.restype = None

    def observe(self, situations: np.ndarray) -> np.ndarray:
        """Observations (batch, entries) of situations (batch, 12 + 4 zones): ``koz_situation`` field by field."""
        return self._rows("koz_observe", situations, 12 + 4 * self.zones, self._observation_size)

    def decide(self, observations: np.ndarray) -> np.ndarray:
        """Actions (batch, 3) in [-1, 1] for observations (batch, entries)."""
        return self._rows("koz_decide", observations, self._observation_size, ACTION_SIZE)

    def torque(self, observations: np.ndarray) -> np.ndarray:
        """Torques (batch, 3) [N m] in body axes for observations (batch, entries)."""
        return self._rows("koz_torque", observations, self._observation_size, ACTION_SIZE)

    def shield(self, situations: np.ndarray, torques: np.ndarray) -> np.ndarray:
        """Torques (batch, 3) [N m] that the shield allows in place of the requested ones.

        Raises:
            SettingsError: it was exported without a shield, or an input has another shape.

        """
        if not self.has_shield:
            raise SettingsError("shield: this controller was exported without; --shield exports it")
        told = _rows_of("situations", situations, 12 + 4 * self.zones)
        requested = _rows_of("torques", torques, ACTION_SIZE)
        if len(told) != len(requested):
            raise SettingsError(f"torques: must be one for each of {len(told)} situations, got {len(requested)}")
        allowed = np.empty_like(requested)
        for row, torque, into in zip(told, requested, allowed, strict=True):
            self._functions.koz_shield(row.ctypes.data, torque.ctypes.data, into.ctypes.data)
        return allowed

    def _rows(self, name: str, inputs: np.ndarray, entries: int, size: int) -> np.ndarray:
        function = getattr(self._functions, name)
        rows = _rows_of(name, inputs, entries)
        outputs = np.empty((len(rows), size), np.float32)
        # Addresses of rows, because making a view of each would take longer than the controller does.
        source, target = rows.ctypes.data, outputs.ctypes.data
        for index in range(len(rows)):
            function(source + index * rows.strides[0], target + index * outputs.strides[0])
        return outputs


def _rows_of(name: str, given: np.ndarray, entries: int) -> np.ndarray:
    """Rows as C reads them; one that is too short would be read beyond its end."""
    rows = np.ascontiguousarray(given, np.float32)
    if rows.ndim != 2 or rows.shape[1] != entries:
        raise SettingsError(f"{name}: must have shape (batch, {entries}), got {rows.shape}")
    return rows
