"""Tuning: gains that were spoilt are found again, and settings that make no sense are refused."""

import dataclasses

import pytest

from koz_jax.cli import tune
from koz_jax.config.base import checked
from koz_jax.config.task import TaskConfig
from koz_jax.control import registry
from koz_jax.control.quaternion_feedback import QuaternionFeedback


@pytest.mark.slow
def test_tuning_finds_what_was_spoilt():
    """Gains far off are mended in a few rounds, and no round is worse than the one before."""
    asked = checked(tune.TuneFlags, name="pd", cases=8, candidates=8, rounds=3)
    spoilt = dataclasses.replace(
        registry.load_controller("pd", TaskConfig(episode_seconds=20.0)),
        controller=QuaternionFeedback(bandwidth=0.3, torque_share=0.1),
    )
    scores = [score for _, score in tune.search(spoilt, asked)]
    assert scores == sorted(scores)
    assert scores[-1] > scores[0] + 1.0


@pytest.mark.parametrize(
    "argv", [["pid"], ["pd", "--seed", "0"], ["pd", "--cases", "0"], ["pd", "--spread", "0"], ["random"]]
)
def test_tuning_refuses_bad_settings(argv, capsys):
    assert tune.main(argv) == 2
    assert argv[-1] in capsys.readouterr().err
