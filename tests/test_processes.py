"""What several processes agree on, and how they end."""

import jax
import numpy as np
import pytest
import tiny

from koz_jax import processes
from koz_jax.errors import UserError

# Two processes, each with its own flags, numbers and errors; then one of them fails while the other still works.
AGREE = """
import sys, time
import numpy as np
from koz_jax import processes, runtime
from koz_jax.errors import UserError
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
if me == 1:
    raise RuntimeError("nobody expects this")
time.sleep(600)
"""


def test_processes_agree_and_one_that_fails_ends_at_once():
    first, second = tiny.begin_two("-c", AGREE)
    try:
        assert "RuntimeError: nobody expects this" in tiny.ended([second], 1)[0]
        assert first.poll() is None
    finally:
        first.kill()
        tiny.ended([first], -9)


def test_one_process_agrees_with_itself():
    assert processes.leads()
    assert processes.any_of(True) and not processes.any_of(False)
    tree = {"a": np.arange(3), "b": jax.numpy.float32(2.5)}
    for name, leaf in processes.from_first(tree).items():
        np.testing.assert_array_equal(leaf, tree[name])
    with pytest.raises(UserError, match="thesis"):
        processes.raise_together(UserError("thesis"))
