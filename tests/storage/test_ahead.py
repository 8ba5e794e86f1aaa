"""Compiling in the background: where it pays, once for each program, and never in the way of what is computed."""

import threading

import pytest

from koz_jax import devices
from koz_jax.storage import ahead, runtime


@pytest.fixture
def forced(monkeypatch):
    monkeypatch.setattr(devices, "on_gpu", lambda: True)
    monkeypatch.setattr(runtime, "keeps_programs", lambda: True)


def test_programs_are_compiled_beside_what_computes_and_waited_for_by_name(forced):
    may_go_on, done = threading.Event(), []

    def slow() -> None:
        may_go_on.wait(10.0)
        done.append("slow")

    with ahead.compiling({"slow": slow, "quick": lambda: done.append("quick")}) as await_program:
        await_program("quick")
        await_program("no such program")
        assert done == ["quick"]
        may_go_on.set()
        await_program("slow")
        assert done == ["quick", "slow"]


def test_what_cannot_be_compiled_is_left_to_who_calls_it(forced):
    def broken() -> None:
        raise RuntimeError("no")

    with ahead.compiling({"broken": broken}) as await_program:
        await_program("broken")


def test_an_error_in_between_does_not_wait(forced):
    may_end, ended = threading.Event(), []

    def endless() -> None:
        may_end.wait(20.0)
        ended.append(True)

    with pytest.raises(KeyError), ahead.compiling({"endless": endless}):
        raise KeyError
    assert not ended
    may_end.set()


@pytest.mark.parametrize(("on_gpu", "kept"), [(False, True), (True, False)])
def test_elsewhere_nothing_is_compiled_ahead(monkeypatch, on_gpu, kept):
    monkeypatch.setattr(devices, "on_gpu", lambda: on_gpu)
    monkeypatch.setattr(runtime, "keeps_programs", lambda: kept)
    with ahead.compiling({"never": lambda: pytest.fail("it was compiled")}) as await_program:
        await_program("never")
