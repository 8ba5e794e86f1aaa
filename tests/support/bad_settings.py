"""Generated command lines, most of them wrong: each must be refused by the name of what is wrong, or be accepted."""

import contextlib
import dataclasses
import io
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from hypothesis import Phase, given, seed, settings
from hypothesis import strategies as st

from koz_jax.cli.evaluate import EvaluateFlags
from koz_jax.cli.train import TrainFlags
from koz_jax.config.base import Settings
from koz_jax.config.presets.named import preset
from koz_jax.evaluation import cases, monte_carlo
from koz_jax.runs import checkpoint, seeds
from support import tiny


class AcceptedError(Exception):
    """A command line was accepted: its work was about to begin."""


def _names(part: Settings, prefix: str = "--") -> Iterator[str]:
    for name, field in type(part).model_fields.items():
        flag = prefix + (field.alias or name).replace("_", "-")
        value = getattr(part, name)
        yield from _names(value, f"{flag}.") if isinstance(value, Settings) else [flag]


TRAIN_FLAGS = [*_names(preset("fast")), *_names(TrainFlags())]
EVAL_FLAGS = [*_names(EvaluateFlags())]

WORDS = [
    *("nan", "inf", "-inf", "-1", "0", "0.0", "-0.0", "1", "2", "1.5", "90", "180", "360", "1e-30", "1e30", "1e400"),
    *("2147483647", "2147483648", "4294967295", "4294967296", "99999999999999999999", "abc", "", " ", "None", "True"),
    *("full", "half", "shrink", "resample", "fast", "phase2", "-", "--", "0x10", "1_000", "½", "\x00", "a/b", "."),
]
VALUES = st.one_of(st.sampled_from(WORDS), st.floats().map(str), st.integers().map(str), st.text(max_size=5))
# Most flags take one value; wrong numbers of values are tried too.
CHANGE = st.tuples(st.integers(0, 999), st.one_of(*[st.tuples(VALUES).map(list)] * 4, st.lists(VALUES, max_size=4)))
NOISE = st.sampled_from([[], [], [], [], ["surplus"], ["--colour", "red"], ["--num-env", "4"], ["-x"], ["--"]])
LINES = st.tuples(st.integers(0, 4), st.lists(CHANGE, min_size=1, max_size=3), NOISE)


@dataclasses.dataclass(frozen=True)
class Line:
    """A generated command line."""

    command: str
    argv: list[str]
    flags: list[str]  # that were changed
    surplus: list[str]  # words that may be too many: some flags take none


def _line(drawn: Any) -> Line:
    kind, changes, noise = drawn
    command, flags = ("eval_mc", EVAL_FLAGS) if kind == 0 else ("train", TRAIN_FLAGS)
    chosen = [(flags[index % len(flags)], values) for index, values in changes]
    argv = [] if kind == 0 else [*tiny.FLAGS, "--run", "run"]
    return Line(
        command,
        argv + [word for flag, values in chosen for word in (flag, *values)] + noise,
        [flag for flag, _ in chosen],
        noise + [word for _, values in chosen for word in values],
    )


def _plain(text: str) -> str:
    return re.sub(r"[\s│]", "", text).replace("-", "_").lower()


def _is_named(line: Line, message: str) -> bool:
    """Whether a refusal names a flag that was changed, or a word that was too many."""
    message = _plain(message)
    named = any(_plain(flag).strip("_").split(".")[-1] in message for flag in line.flags)
    return named or ("unrecognizedoptions" in message and any(_plain(word) in message for word in line.surplus))


def _outcome(line: Line) -> str:
    """What a command line comes to: "refused", "accepted", or what was wrong about how it was refused."""
    errors = io.StringIO()
    before = set(os.listdir())
    try:
        with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
            status = tiny.status(line.command, *line.argv)
        outcome = "refused" if status == 2 else f"status {status}"
    except AcceptedError:
        outcome = "accepted"
    except BaseException as error:
        outcome = f"traceback {error!r}"
    if outcome == "refused" and not _is_named(line, errors.getvalue()):
        outcome = f"refused without a name: {errors.getvalue()[:300]}"
    left = set(os.listdir()) - before
    if left and outcome != "accepted":  # such as --figures, whose folder is made when all else is checked
        outcome = f"left {sorted(left)} behind"
    for name in left:
        shutil.rmtree(name)
    return outcome if outcome in ("refused", "accepted") else f"{outcome} from {line.command} {line.argv[-12:]}"


@dataclasses.dataclass(frozen=True)
class Tried:
    """What became of the command lines."""

    text: str
    sound: bool  # each was refused well, or accepted
    accepted: list[Line]


def refusals(count: int, work: Path) -> Tried:
    """Try command lines in an empty folder; the work of those that are accepted is not begun."""
    outcomes: list[str] = []
    accepted: list[Line] = []

    @seed(6)
    @settings(max_examples=count, database=None, deadline=None, phases=[Phase.generate], derandomize=False)
    @given(LINES)
    def attempt(drawn: Any) -> None:
        line = _line(drawn)
        outcomes.append(_outcome(line))
        if outcomes[-1] == "accepted":
            accepted.append(line)

    def accept(*_: Any, **__: Any) -> None:
        raise AcceptedError

    empty = work / "empty"
    empty.mkdir()
    with contextlib.ExitStack() as stack:
        stack.enter_context(contextlib.chdir(empty))
        stack.enter_context(mock.patch.dict(os.environ, {"COLUMNS": "300"}))
        begins = [(checkpoint, "begin"), (seeds, "train_all"), (monte_carlo, "run_cases"), (cases, "fly_case")]
        for module, name in begins:
            stack.enter_context(mock.patch.object(module, name, accept))
        attempt()
    wrong = [outcome for outcome in outcomes if outcome not in ("refused", "accepted")]
    text = f"{len(outcomes)}: {outcomes.count('refused')} refused by name, {len(accepted)} accepted; {len(wrong)} wrong"
    return Tried("\n  ".join([text, *wrong[:5]]), not wrong, accepted)
