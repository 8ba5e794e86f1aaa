import jax
import numpy as np
import pytest

from koz_jax.agents.agent import load_agent
from koz_jax.agents.deeper import can_become, deepened
from koz_jax.task import observation_layout


def _network(network, *hidden_sizes):
    return network.model_copy(update={"hidden_sizes": hidden_sizes})


@pytest.mark.parametrize("name", ["phase2", "universal"])
def test_a_deeper_network_decides_as_it_did(name):
    shallow = load_agent(name).controller
    network = shallow.network
    sizes = network.hidden_sizes
    deep = deepened(shallow, _network(network, *sizes, sizes[-1], sizes[-1]))
    seen = jax.random.normal(jax.random.key(0), (200, observation_layout.size(network.observed_zones, network.scaled)))
    actions = np.asarray(shallow.act(seen))
    assert np.all(np.std(actions, axis=0) > 0.1)
    np.testing.assert_allclose(deep.act(seen), actions, atol=1e-6)


def test_it_has_further_layers_of_the_same_size_and_nothing_else():
    network = load_agent("universal").controller.network
    sizes = network.hidden_sizes
    assert can_become(network, network) and can_become(network, _network(network, *sizes, sizes[-1]))
    others = [(*sizes, sizes[-1] + 1), sizes[:-1], (sizes[0] + 1, *sizes[1:]), (sizes[0] + 1, *sizes)]
    assert not any(can_become(network, _network(network, *other)) for other in others)
    assert not can_become(_network(network, *sizes, sizes[-1]), network)
    assert not can_become(network, network.model_copy(update={"observed_zones": network.observed_zones + 1}))
