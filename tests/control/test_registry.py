"""Controllers by name."""

import pytest

from koz_jax.config.task import TaskConfig
from koz_jax.control import registry
from koz_jax.errors import SettingsError

NAMES = tuple(registry.BUILT_IN)


@pytest.mark.parametrize("name", NAMES)
def test_registry_knows_every_controller(name):
    agent = registry.load_controller(name)
    assert (agent.name, agent.task) == (name, TaskConfig())
    other = TaskConfig(episode_seconds=5.0)
    assert registry.load_controller(name, other).task == other


def test_registry_refuses_what_it_does_not_know():
    with pytest.raises(SettingsError) as raised:
        registry.load_controller("pid")
    assert all(name in str(raised.value) for name in ("controller", "pid", *NAMES))
