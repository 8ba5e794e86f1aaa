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
        names = ("KOZ_ZONES", "KOZ_OBSERVATION_SIZE", "KOZ_WHEELS")
        self.zones, self._observation_size, self.wheels = (_defined(name, header) for name in names)
        self._several = "#define KOZ_INSTRUMENTS" in header
        self._situation_size = 11 + (5 if self._several else 4) * self.zones + self.wheels
        # q_e, an urgency where the policy sees one, what wheels leave, and which instrument where there are several.
        self._memory_size = 4 + ("#define KOZ_URGENCY" in header) + 3 * bool(self.wheels) + self._several
        self._remembers = self._several or self.wheels > 0
        self.has_shield = shield.is_file()
        self._declare()

    def _declare(self) -> None:
        """Tell ctypes what the functions take; all but two return nothing."""
        pointers = {"start": 2, "observe": 3, "decide": 2, "torque": 3 if self._remembers else 2, "fault": 1}
        pointers |= {"shield": 3, "is_safe": 1} if self.has_shield else {}
        pointers |= {"wheel_torques": 3} if self.wheels else {}
        for name, count in pointers.items():
            function = getattr(self._functions, f"koz_{name}")
            function.argtypes, function.restype = (ctypes.c_void_p,) * count, None
        self._functions.koz_fault.restype = ctypes.c_char_p
        if self.has_shield:
            self._functions.koz_is_safe.restype = ctypes.c_int

    def faults(self, situations: np.ndarray) -> list[str | None]:
        """What is wrong with each situation (batch, 11 + 4 zones): ``koz_situation`` field by field; None: nothing.

        Here and below, the momentum of each wheel comes next where there are wheels, and the number of each zone's
        instrument last where there are several.
        """
        told = self._situations(situations)
        found = [self._functions.koz_fault(row.ctypes.data) for row in told]
        return [None if fault is None else fault.decode() for fault in found]

    def start(self, situations: np.ndarray) -> np.ndarray:
        """Begin maneuvers in these situations (batch, 11 + 4 zones).

        Returns memories for ``observe``, ``koz_memory`` field by field: (batch, 4); then the urgency of a policy for
        any spacecraft, three torque limits [N m] where there are wheels, and the number of the nearest zone's
        instrument where there are several.
        """
        told = self._situations(situations)
        memories = np.empty((len(told), self._memory_size), np.float32)
        self._each("koz_start", memories, told)
        return self._told(memories)

    def observe(self, situations: np.ndarray, memories: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Observations (batch, entries) of situations (batch, 11 + 4 zones), and the memories from then on.

        situations: ``koz_situation`` field by field; memories: of ``start``, or of the step before.
        """
        told = self._situations(situations)
        kept = self._memories(memories).copy()
        _check_as_many("memories", kept, told)
        observations = np.empty((len(told), self._observation_size), np.float32)
        self._each("koz_observe", kept, told, observations)
        return observations, self._told(kept)

    def decide(self, observations: np.ndarray) -> np.ndarray:
        """Actions (batch, 3) in [-1, 1] for observations (batch, entries)."""
        return self._answer("koz_decide", observations)

    def torque(self, observations: np.ndarray, memories: np.ndarray | None = None) -> np.ndarray:
        """Torques (batch, 3) [N m] in body axes for observations (batch, entries).

        memories: of wheels or several instruments, as ``observe`` returned them with the observations.

        Raises:
            SettingsError: there are wheels or several instruments and no memories, or an input has another shape.

        """
        if not self._remembers:
            return self._answer("koz_torque", observations)
        if memories is None:
            raise SettingsError(
                "memories: must be those of the observations where there are wheels or several instruments, got None"
            )
        kept = self._memories(memories)
        _check_as_many("memories", kept, observations, "observations")
        return self._answer("koz_torque", observations, kept)

    def wheel_torques(self, situations: np.ndarray, torques: np.ndarray) -> np.ndarray:
        """Torques (batch, wheels) [N m] that each wheel gives the body where torques (batch, 3) [N m] are to turn it.

        Raises:
            SettingsError: it was exported for a spacecraft without wheels, or an input has another shape.

        """
        if not self.wheels:
            raise SettingsError("wheel_torques: this controller is of a spacecraft without wheels")
        return self._answer_torques("koz_wheel_torques", situations, torques, self.wheels)

    def shield(self, situations: np.ndarray, torques: np.ndarray) -> np.ndarray:
        """Torques (batch, 3) [N m] that the shield allows in place of the requested ones.

        Raises:
            SettingsError: it was exported without a shield, or an input has another shape.

        """
        self._check_shield()
        return self._answer_torques("koz_shield", situations, torques, ACTION_SIZE)

    def is_safe(self, situations: np.ndarray) -> np.ndarray:
        """Whether what the shield guarantees holds from situations on.  Returns (batch,) bool.

        Raises:
            SettingsError: it was exported without a shield, or an input has another shape.

        """
        self._check_shield()
        told = self._situations(situations)
        return np.array([bool(self._functions.koz_is_safe(row.ctypes.data)) for row in told], bool)

    def _check_shield(self) -> None:
        if not self.has_shield:
            raise SettingsError("shield: this controller was exported without; --shield exports it")

    def _answer_torques(self, name: str, situations: np.ndarray, torques: np.ndarray, entries: int) -> np.ndarray:
        told, requested = self._situations(situations), _rows_of("torques", torques, ACTION_SIZE)
        _check_as_many("torques", requested, told)
        answers = np.empty((len(told), entries), np.float32)
        self._each(name, told, requested, answers)
        return answers

    def _answer(self, name: str, observations: np.ndarray, *before: np.ndarray) -> np.ndarray:
        asked = _rows_of("observations", observations, self._observation_size)
        answers = np.empty((len(asked), ACTION_SIZE), np.float32)
        self._each(name, *before, asked, answers)
        return answers

    def _situations(self, given: np.ndarray) -> np.ndarray:
        return _rows_of("situations", given, self._situation_size, self.zones if self._several else 0)

    def _memories(self, given: np.ndarray) -> np.ndarray:
        return _rows_of("memories", given, self._memory_size, int(self._several))

    def _told(self, memories: np.ndarray) -> np.ndarray:
        """Memories of C as plain numbers."""
        if self._several:
            memories[:, -1:] = memories[:, -1:].copy().view(np.int32)
        return memories

    def _each(self, name: str, *tables: np.ndarray) -> None:
        """Call a function for each row of some tables."""
        function = getattr(self._functions, name)
        # Addresses of rows, because making a view of each would take longer than the controller does.
        places = [(table.ctypes.data, table.strides[0]) for table in tables]
        for index in range(len(tables[0])):
            function(*(start + index * stride for start, stride in places))


def _defined(name: str, header: str) -> int:
    """The number that a header defines by a name; 0 where it does not."""
    return sum(map(int, re.findall(rf"#define {name} (\d+)", header)))


def _rows_of(name: str, given: np.ndarray, entries: int, integers: int = 0) -> np.ndarray:
    """Rows as C reads them, the last entries as int; one that is too short would be read beyond its end."""
    rows = np.ascontiguousarray(given, np.float32)
    if rows.ndim != 2 or rows.shape[1] != entries:
        raise SettingsError(f"{name}: must have shape (batch, {entries}), got {rows.shape}")
    if integers:
        rows = np.concatenate([rows[:, :-integers], rows[:, -integers:].astype(np.int32).view(np.float32)], axis=1)
    return rows


def _check_as_many(name: str, given: np.ndarray, others: np.ndarray, what: str = "situations") -> None:
    if len(given) != len(others):
        raise SettingsError(f"{name}: must be one for each of {len(others)} {what}, got {len(given)}")
