"""Layout of a run folder.

- ``config.json``: resolved configuration; written last when a run begins, so what has one has a checkpoint too
- ``command.txt``: the command line that began it, where there was one
- ``metrics.csv``: training curves; ``tensorboard/`` has the same, and ``timing.csv`` what depends on the machine
- ``checkpoints/``: the two newest whole training states, replay buffer included, named by the updates done; a third is
  there while it is being written
- ``lock``: held by the process that trains
- ``agents/``: best agents of the stages: ``phase1``, ``phase2``, and ``phase2-sac``, the latter before refinement
- ``snapshots/phase1``: whole training state at the end of the phase, to start other runs from
- ``evaluation.json``: Monte Carlo table of the finished run
"""

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from koz_jax.config.training import TrainConfig
from koz_jax.errors import DamagedFileError, SettingsError, explain
from koz_jax.storage import files
from koz_jax.storage.lock import LOCK, FolderLock

KEPT = 2  # checkpoints


@dataclasses.dataclass(frozen=True)
class RunFolder:
    """Paths of one run."""

    path: Path

    @property
    def config(self) -> Path:
        """Resolved configuration."""
        return self.path / "config.json"

    @property
    def command(self) -> Path:
        """The command line that began the run; there is none where it was begun from Python."""
        return self.path / "command.txt"

    def checkpoint(self, done: int) -> Path:
        """Whole training state after so many updates and refinement iterations."""
        return self.path / "checkpoints" / f"{done:010d}"

    def checkpoints(self) -> list[Path]:
        """All checkpoints, the newest first; also damaged ones."""
        found = (self.path / "checkpoints").glob("[0-9]*")
        return sorted((path for path in found if path.name.isdecimal()), key=lambda path: int(path.name), reverse=True)

    def prune(self, newest: int | None = None) -> None:
        """Remove checkpoints that are older than the last two, and those past ``newest``, which training has left."""
        kept = [path for path in self.checkpoints() if newest is None or int(path.name) <= newest][:KEPT]
        unfinished = (self.path / "checkpoints").glob(".*")  # of writes that were killed
        for path in [*unfinished, *self.checkpoints()]:
            if path not in kept:
                shutil.rmtree(path, ignore_errors=True)

    @property
    def size(self) -> int:
        """What the folder takes [bytes]."""
        return sum(path.stat().st_size for path in self.path.rglob("*") if path.is_file())

    def trim(self) -> int:
        """Remove what only a resume, or another run that starts from this one, needs.  Returns the bytes set free.

        Raises:
            SettingsError: the run is not finished, or under way.

        """
        length, found = self.read_config("run").length, self.checkpoints()
        if found and int(found[0].name) < length:
            raise SettingsError(
                f"run: {self.path} is not finished ({int(found[0].name)} of {length} updates and iterations); it needs"
                " its checkpoints to be resumed"
            )
        with FolderLock(self.path):
            before = self.size
            for folder in ("checkpoints", "snapshots"):
                shutil.rmtree(self.path / folder, ignore_errors=True)
            return before - self.size

    @property
    def evaluation(self) -> Path:
        """Monte Carlo table of the finished run."""
        return self.path / "evaluation.json"

    def agent(self, name: str) -> Path:
        """One of the run's agents; stages know the names of theirs."""
        return self.path / "agents" / name

    def snapshot(self, name: str) -> Path:
        """Whole training state at an intermediate point."""
        return self.path / "snapshots" / name

    @contextlib.contextmanager
    def begin(self) -> Iterator[None]:
        """Make and lock the folder of a new run, which has begun when ``config.json`` is written.

        On an error before that, nothing is left of it.

        Raises:
            SettingsError: there is something already (nothing is ever overwritten), or the folder cannot be made.

        """
        try:
            if self.path.exists() and not (self.path.is_dir() and self._is_unbegun()):
                raise SettingsError(
                    f"run: {self.path} exists already; resume it with --resume {self.path}, or choose another folder"
                )
            made = [path for path in (self.path, *self.path.parents) if not path.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SettingsError(f"run: {self.path} cannot be created: {error.strerror}") from None
        try:
            with FolderLock(self.path):
                yield from self._begin_locked()
        finally:
            for folder in made:
                with contextlib.suppress(OSError):  # it is in use, as it should be
                    folder.rmdir()

    def _begin_locked(self) -> Iterator[None]:
        if not self._is_unbegun():  # another trainer came and went
            raise SettingsError(f"run: {self.path} exists already; resume it with --resume {self.path}")
        try:
            shutil.rmtree(self.path / "checkpoints", ignore_errors=True)  # of a beginning that was killed
            for half_written in self._half_written():
                half_written.unlink()
            yield
        finally:
            if not self.config.exists():
                shutil.rmtree(self.path / "checkpoints", ignore_errors=True)
                (self.path / LOCK).unlink(missing_ok=True)

    def _is_unbegun(self) -> bool:
        """Whether the folder is empty, or holds only what a killed beginning left."""
        first = self.checkpoint(0)
        left_over = {LOCK, first.parent.name, first.name, f".{first.name}.new"}
        left_over |= {path.name for path in self._half_written()}
        places = [self.path, *([first.parent] if first.parent.is_dir() else [])]
        return all(path.name in left_over for place in places for path in place.iterdir())

    def _half_written(self) -> list[Path]:
        """What a kill left of the configuration that was being written."""
        return list(self.path.glob(f".{self.config.name}.*"))

    def write_config(self, config: TrainConfig) -> None:
        """Write the configuration of a run that has begun."""
        files.write_text(self.config, config.to_json())

    def write_command(self, command: str) -> None:
        """Write the command line that began the run, if there was one."""
        if command:
            files.write_text(self.command, command + "\n")

    def read_command(self) -> str:
        """Read the command line that began the run; empty where there was none."""
        try:
            return self.command.read_text(encoding="utf-8").strip()
        except (OSError, UnicodeDecodeError):
            return ""

    def read_config(self, name: str = "resume") -> TrainConfig:
        """Read the configuration of an existing run.  name: the setting that gave the folder, for the message."""
        if not os.path.isfile(self.config):
            raise SettingsError(f"{name}: {self.path} is not a run folder (it has no {self.config.name})")
        try:
            return TrainConfig.model_validate(files.read_json(self.config))
        except ValidationError as error:
            raise DamagedFileError(f"{self.config}: {explain(error)}") from None
