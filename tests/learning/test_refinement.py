import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from koz_jax import devices
from koz_jax.config.learners.refinement import RefineConfig
from koz_jax.config.presets.named import preset
from koz_jax.config.training import TrainConfig
from koz_jax.control.policy import PolicyController, policy_network
from koz_jax.learning import refinement
from koz_jax.task import scenario
from koz_jax.task.actuators import TorqueBox
from koz_jax.task.reward import Outcome

CONFIG = TrainConfig.model_validate(
    preset("fast").model_dump()
    | {
        "network": {"hidden_sizes": (16, 16)},
        "refine": RefineConfig(iterations=40, scenarios=16, horizon_seconds=10.0).model_dump(),
    }
)
ENV = refinement.maneuver_environment(CONFIG)


@pytest.fixture(scope="module")
def policy():
    return policy_network(CONFIG.network).init(jax.random.key(0), jnp.zeros(16))


def outcome(angle=0.0, torque=0.0, margin=1.0):
    return Outcome(*map(jnp.float32, (angle, angle, torque, 0.0, margin, 0.0)))


KEYS = jax.random.split(jax.random.key(1), 16)


def mean_cost(policy, keys):
    controller = PolicyController(policy, CONFIG.network)
    return jnp.mean(jax.vmap(lambda key: refinement.fly_maneuver(controller, ENV, key, CONFIG).mean)(keys))


mean_cost_of, mean_gradient_of = jax.jit(mean_cost), jax.jit(jax.grad(mean_cost))


@pytest.mark.slow
def test_the_gradient_is_that_of_the_whole_maneuver(policy):
    key_direction = jax.random.key(2)
    leaves, tree = jax.tree.flatten(policy)
    direction = jax.tree.unflatten(
        tree,
        [
            jax.random.normal(k, leaf.shape)
            for k, leaf in zip(jax.random.split(key_direction, len(leaves)), leaves, strict=True)
        ],
    )

    def along(step):
        return mean_cost_of(jax.tree.map(lambda p, d: p + step * d, policy, direction), KEYS)

    step = 3e-4
    measured = (along(step) - along(-step)) / (2 * step)
    assert abs(measured) > 1e-2
    slopes = jax.tree.map(jnp.vdot, mean_gradient_of(policy, KEYS), direction)
    np.testing.assert_allclose(sum(jax.tree.leaves(slopes)), measured, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("on_gpu", [False, True])
def test_gradients_of_maneuvers_that_no_bound_clips_have_the_mean_of_the_whole(policy, on_gpu, monkeypatch):
    """Taken over the actions first and the weights after, they are the gradient of the mean cost."""
    monkeypatch.setattr(devices, "on_gpu", lambda: on_gpu)
    unclipped = CONFIG.refine.model_copy(update={"max_maneuver_gradient": 1e9})

    @jax.jit
    def by_maneuver(policy):
        config = CONFIG.model_copy(update={"refine": unclipped})
        return refinement._clipped_gradient(config, ENV, policy, KEYS, None)

    cost, gradient = by_maneuver(policy)
    np.testing.assert_allclose(cost, mean_cost_of(policy, KEYS), rtol=1e-5)
    expected = mean_gradient_of(policy, KEYS)
    largest = max(float(jnp.max(jnp.abs(leaf))) for leaf in jax.tree.leaves(expected))
    for one, other in zip(jax.tree.leaves(gradient), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4 * largest)


@pytest.mark.slow
def test_a_maneuver_that_enters_a_zone_has_so_much_more_say(policy):
    """Every gradient here is above its bound, so that its size is the bound."""
    bound, weight = 1e-6, 8.0
    refine = CONFIG.refine.model_copy(update={"max_maneuver_gradient": bound, "violator_weight": weight})
    config = CONFIG.model_copy(update={"refine": refine})
    tumbling = jax.tree.map(lambda leaf: 4.0 * leaf, policy)

    @jax.jit
    def of_one(key):
        flown = refinement.fly_maneuver(PolicyController(tumbling, config.network), ENV, key, config)
        _, gradient = refinement._clipped_gradient(config, ENV, tumbling, key[None], None)
        return flown.entered, optax.tree.norm(gradient)

    entered, sizes = map(np.asarray, zip(*map(of_one, KEYS), strict=True))
    assert 0 < np.sum(entered) < len(KEYS)
    np.testing.assert_allclose(sizes, np.where(entered, weight * bound, bound), rtol=1e-3)


@pytest.mark.slow
def test_the_gradient_is_finite_at_rest_on_the_target():
    start = ENV.reset(scenario.paper_test())
    at_rest = start.replace(
        body=start.body.replace(q_BN=start.scenario.q_DN, omega_BN_B=jnp.zeros(3)), angle=jnp.zeros(())
    )

    def cost(action):
        return refinement.step_cost(ENV.step(at_rest, action).outcome, ENV, CONFIG.refine)

    assert np.all(np.isfinite(jax.jit(jax.grad(cost))(jnp.zeros(3))))


@pytest.mark.slow
@pytest.mark.parametrize("optimizer", ["adam", "muon"])
def test_refinement_lowers_the_cost_on_maneuvers_it_has_not_seen(optimizer, policy):
    config = CONFIG.model_copy(update={"refine": CONFIG.refine.model_copy(update={"optimizer": optimizer})})
    batches = jax.random.split(jax.random.key(99), (4, len(KEYS)))
    state = refinement.init(config, jax.tree.map(jnp.copy, policy))
    refined, _ = refinement.refine_chunk(config, state, jnp.int32(40))
    after, before = (np.mean([mean_cost_of(one, keys) for keys in batches]) for one in (refined.policy, policy))
    assert after < 0.98 * before


@pytest.mark.slow
def test_chunks_of_any_length_are_one_refinement(policy):
    whole, parts = (refinement.init(CONFIG, jax.tree.map(jnp.copy, policy)) for _ in range(2))
    whole, _ = refinement.refine_chunk(CONFIG, whole, jnp.int32(5))
    for length in (2, 3):
        parts, _ = refinement.refine_chunk(CONFIG, parts, jnp.int32(length))
    for one, other in zip(jax.tree.leaves(whole.policy), jax.tree.leaves(parts.policy), strict=True):
        np.testing.assert_array_equal(one, other)
    assert int(whole.iterations) == int(parts.iterations) == 5


def test_the_zone_costs_what_the_papers_penalty_does_outside_and_more_the_deeper_inside():
    margins = jnp.linspace(-0.2, 0.3, 101)
    costs = jax.vmap(refinement.zone_cost, in_axes=(0, None, None))(margins, jnp.float32(66.0), jnp.float32(0.0))
    outside = np.asarray(margins) > 0
    np.testing.assert_allclose(costs[outside], np.exp(-66.0 * np.asarray(margins)[outside]), rtol=1e-5)
    assert np.all(np.diff(costs) < 0)


@pytest.mark.parametrize("worse", [outcome(angle=1e-4), outcome(torque=0.1), outcome(margin=0.0)])
def test_nothing_costs_less_than_resting_on_the_target_far_from_the_zone(worse):
    best = refinement.step_cost(outcome(), ENV, CONFIG.refine)
    assert refinement.step_cost(worse, ENV, CONFIG.refine) > best


def test_effort_is_counted_in_shares_of_the_strength_of_the_actuators():
    """The same share of a stronger box costs the same; for unequal limits the share is of their mean square."""
    stronger = ENV.replace(model=ENV.model.replace(actuators=TorqueBox(jnp.full(3, 6.0))))
    unequal = ENV.replace(model=ENV.model.replace(actuators=TorqueBox(jnp.array([1.0, 2.0, 3.0]))))
    strength = float(np.sqrt((1.0 + 4.0 + 9.0) / 3.0))
    costs = [
        float(refinement.step_cost(outcome(torque=0.5 * u), env, CONFIG.refine))
        for u, env in ((2.0, ENV), (6.0, stronger), (strength, unequal))
    ]
    free = float(refinement.step_cost(outcome(), ENV, CONFIG.refine))
    np.testing.assert_allclose(costs, costs[0], rtol=1e-5)
    assert costs[0] - free == pytest.approx(0.25 * CONFIG.refine.effort_weight, rel=1e-3)
