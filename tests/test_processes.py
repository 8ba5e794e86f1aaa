"""What several processes agree on, and how they end."""

import signal
import socket

import jax
import numpy as np
import pytest
import tiny

from koz_jax import processes, runtime
from koz_jax.errors import UserError

# Two processes, each with its own flags, numbers and errors; then one of them fails while the other still works.
AGREE = """
import sys, time
import numpy as np
from koz_jax import processes, runtime
from koz_jax.errors import UserError, exit_status
coordinator, me = sys.argv[2], int(sys.argv[6])
runtime.join(coordinator, 2, me)
assert processes.leads() == (me == 0)
time.sleep(35 * me)  # one may have much to compile before they exchange anything
for flags in ((0, 0), (0, 1), (1, 0), (1, 1)):
    assert processes.any_of(bool(flags[me])) == any(flags)
found = processes.from_first({"a": np.arange(6.0).reshape(2, 3) + me, "b": np.int32(7 * me), "c": np.float32(np.nan)})
np.testing.assert_array_equal(found["a"], np.arange(6.0, dtype=np.float32).reshape(2, 3))
assert found["b"] == 0 and found["b"].dtype == np.int32 and np.isnan(found["c"])

def fail():
    if me == 1:
        raise UserError("thesis: is in the way")

try:
    processes.together(fail)
except UserError as error:
    assert str(error).startswith(("processes: another process", "thesis: is")[me])
else:
    raise AssertionError("an error was lost")
assert processes.together(lambda: me) == me
processes.require_same("settings", "alike")
try:
    processes.require_same("settings", me)
except UserError as error:
    assert str(error).startswith(("processes: another process", "settings: must be the same in all processes")[me])
else:
    raise AssertionError("a difference was lost")
if me == 1:
    raise RuntimeError("nobody expects this")
sys.exit(exit_status(lambda: processes.any_of(False)))
"""


def test_processes_agree_and_when_one_fails_all_end():
    errors = tiny.ended(tiny.begin_two("-c", AGREE), 2, 1)
    assert "error: processes: another process has ended, or does not answer: " in errors[0]
    assert "Traceback" not in errors[0]
    assert "RuntimeError: nobody expects this" in errors[1]


def test_one_process_agrees_with_itself():
    assert processes.leads()
    assert processes.any_of(True) and not processes.any_of(False)
    tree = {"a": np.arange(3), "b": jax.numpy.float32(2.5)}
    for name, leaf in processes.from_first(tree).items():
        np.testing.assert_array_equal(leaf, tree[name])
    with pytest.raises(UserError, match="thesis"):
        processes.raise_together(UserError("thesis"))


ALONE = """
import sys, time
from koz_jax import runtime
from koz_jax.errors import UserError, exit_status

def work():
    runtime.join(sys.argv[2], 2, int(sys.argv[6]))
    if sys.argv[6] == "1":
        raise UserError("thesis: is in the way of this process alone")
    time.sleep(600)

sys.exit(exit_status(work))
"""


def test_a_process_that_is_refused_alone_ends_at_once_and_sigterm_ends_the_other():
    first, second = tiny.begin_two("-c", ALONE)
    try:
        assert "error: thesis: is in the way" in tiny.ended([second], 2)[0]
        assert first.poll() is None
    finally:
        first.terminate()
        tiny.ended([first], -signal.SIGTERM)


def test_a_coordinator_that_cannot_be_is_refused(capsys):
    for coordinator, reason in (
        ("somewhere:99999", "its port must be from 1 to 65535"),
        ("somewhere", "must be host:port"),
    ):
        flags = ["--coordinator", coordinator, "--processes", 2, "--process", 1]
        assert tiny.status("eval_mc", *flags) == 2
        assert f"coordinator: {reason}" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"coordinator: port {port} cannot be listened on: Address already in use"):
            runtime.join(f"127.0.0.1:{port}", 2, 0)
    with pytest.raises(UserError, match=r"coordinator: there is no host 'nowhere\.invalid'"):
        runtime.join("nowhere.invalid:1234", 2, 1)
