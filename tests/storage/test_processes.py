"""What several processes agree on, and how they end."""

import signal
import socket

import jax
import numpy as np
import pytest
from support import tiny

from koz_jax.errors import KozError, PeerProcessError, SettingsError
from koz_jax.storage import processes, runtime

# Two processes, each with its own flags, numbers and errors; then one of them fails while the other still works.
AGREE = """
import sys, time
import numpy as np
from koz_jax.cli.exit_status import exit_status
from koz_jax.errors import KozError, SettingsError
from koz_jax.storage import processes, runtime
coordinator, me = sys.argv[2], int(sys.argv[6])
runtime.join(coordinator, 2, me)
assert processes.is_primary_process() == (me == 0)
time.sleep(2 * me)  # one may have much to compile before they exchange anything
for flags in ((0, 0), (0, 1), (1, 0), (1, 1)):
    assert processes.any_process(bool(flags[me])) == any(flags)
mine = {"a": np.arange(6.0).reshape(2, 3) + me, "b": np.int32(7 * me), "c": np.float32(np.nan)}
found = processes.broadcast_from_primary(mine)
np.testing.assert_array_equal(found["a"], np.arange(6.0, dtype=np.float32).reshape(2, 3))
assert found["b"] == 0 and found["b"].dtype == np.int32 and np.isnan(found["c"])

def fail():
    if me == 1:
        raise SettingsError("thesis: is in the way")

try:
    processes.all_or_none(fail)
except KozError as error:
    assert str(error).startswith(("processes: another process", "thesis: is")[me])
else:
    raise AssertionError("an error was lost")
assert processes.all_or_none(lambda: me) == me
processes.assert_equal_across_processes("settings", "alike")
try:
    processes.assert_equal_across_processes("settings", me)
except KozError as error:
    assert str(error).startswith(("processes: another process", "settings: must be the same in all processes")[me])
else:
    raise AssertionError("a difference was lost")
if me == 1:
    raise RuntimeError("nobody expects this")
sys.exit(exit_status(lambda: processes.any_process(False)))
"""


@pytest.mark.slow
def test_processes_agree_and_when_one_fails_all_end():
    # One of them is late, but by less than the half minute after which processes that are not connected give up: that
    # time is fixed in XLA.  That they are connected by then is what the next test is about.
    errors = tiny.ended(tiny.begin_two("-c", AGREE), 2, 1)
    assert "error: processes: another process has ended, or does not answer: " in errors[0]
    assert "Traceback" not in errors[0]
    assert "RuntimeError: nobody expects this" in errors[1]


def test_processes_that_join_are_connected_before_one_can_be_late(monkeypatch):
    calls = []
    monkeypatch.setattr(runtime.jax.distributed, "initialize", lambda *_: calls.append("found each other"))
    monkeypatch.setattr(runtime, "any_process", lambda _: calls.append("exchanged something"))
    monkeypatch.setattr(runtime.jax.config, "update", lambda *_: None)
    monkeypatch.setattr(runtime.sys, "excepthook", runtime.sys.excepthook)  # put back in the end
    runtime.join(f"127.0.0.1:{tiny.free_port()}", 2, 0)
    assert calls == ["found each other", "exchanged something"]


def test_one_process_agrees_with_itself():
    assert processes.is_primary_process()
    assert processes.any_process(True) and not processes.any_process(False)
    tree = {"a": np.arange(3), "b": jax.numpy.float32(2.5)}
    for name, leaf in processes.broadcast_from_primary(tree).items():
        np.testing.assert_array_equal(leaf, tree[name])
    with pytest.raises(SettingsError, match="thesis") as caught:
        processes.raise_in_all(SettingsError("thesis"))
    assert caught.value.ends_all_processes and not KozError("another").ends_all_processes
    with pytest.raises(DeprecationWarning, match="not of the processes"), processes.collective_errors():
        raise DeprecationWarning("not of the processes")
    with pytest.raises(PeerProcessError, match="another process has ended, or does not answer: Gloo: timed out"):
        with processes.collective_errors():
            raise ValueError("Gloo: timed out\nand so on")


ALONE = """
import sys, time
from koz_jax.cli.exit_status import exit_status
from koz_jax.errors import SettingsError
from koz_jax.storage import runtime

def work():
    runtime.join(sys.argv[2], 2, int(sys.argv[6]))
    if sys.argv[6] == "1":
        raise SettingsError("thesis: is in the way of this process alone")
    time.sleep(600)

sys.exit(exit_status(work))
"""


@pytest.mark.slow
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
        assert tiny.status("evaluate", *flags) == 2
        assert f"coordinator: {reason}" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("", 0))
        taken.listen()
        port = taken.getsockname()[1]
        busy = f"coordinator: port {port} cannot be listened on: Address already in use"
        with pytest.raises(SettingsError, match=busy):
            runtime.join(f"127.0.0.1:{port}", 2, 0)
    with pytest.raises(SettingsError, match=r"coordinator: there is no host 'nowhere\.invalid'"):
        runtime.join("nowhere.invalid:1234", 2, 1)
