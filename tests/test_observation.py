import jax
import jax.numpy as jnp
import numpy as np
import oracle
import pytest

from koz_jax import env, observation
from koz_jax.dynamics import RigidBodyState
from koz_jax.env import EnvState
from koz_jax.keep_out import NO_ZONE_HALF_ANGLE, KeepOutZone
from koz_jax.scenario import Scenario

pytestmark = pytest.mark.usefixtures("strict_shapes")

COUNT = 64
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])

observe = jax.jit(observation.observe)
observe_batch = jax.jit(jax.vmap(observation.observe, in_axes=(0, None)))
reset = jax.jit(env.reset)


def _scenario(q, omega, q_target, axis, half_angle) -> Scenario:
    """Of one sample, or of a batch when every argument has a leading axis."""
    single = np.asarray(q, np.float32), np.asarray(omega, np.float32), np.asarray(q_target, np.float32)
    zones = KeepOutZone(
        jnp.expand_dims(jnp.asarray(axis, jnp.float32), -2), jnp.expand_dims(jnp.asarray(half_angle, jnp.float32), -1)
    )
    return Scenario(RigidBodyState(jnp.array(single[0]), jnp.array(single[1])), jnp.array(single[2]), zones)


def _state(q, omega=(0.0, 0.0, 0.0), q_target=IDENTITY, axis=(0.0, 0.0, 1.0), half_angle=0.3) -> EnvState:
    return reset(_scenario(q, omega, q_target, axis, half_angle))


@pytest.fixture(scope="module")
def drawn() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "q": np.stack([oracle.random_attitude(rng) for _ in range(COUNT)]),
        "omega": rng.normal(scale=0.05, size=(COUNT, 3)),
        "q_target": np.stack([oracle.random_attitude(rng) for _ in range(COUNT)]),
        "axis": np.stack([oracle.random_direction(rng) for _ in range(COUNT)]),
        "half_angle": rng.uniform(0.2, 0.6, size=COUNT),
    }


@pytest.fixture(scope="module")
def states(drawn) -> EnvState:
    q_e0_previous = np.linspace(-1.0, 1.0, COUNT).astype(np.float32)
    return jax.vmap(env.reset)(_scenario(**drawn)).replace(q_e0_previous=jnp.array(q_e0_previous))


def test_layout_is_the_order_of_equation_6_of_the_paper():
    assert list(observation.LAYOUT.values()) == [4, 3, 3, 1, 1, 3, 1]
    assert list(observation.LAYOUT) == [
        "q_e",
        "omega_BN_B",
        "boresight_B",
        "zone_margin",
        "zone_angle",
        "zone_direction_B",
        "q_e0_previous",
    ]


def test_slices_partition_the_sixteen_numbers():
    assert observation.SIZE == 16
    indices = [i for name in observation.LAYOUT for i in range(observation.SIZE)[observation.SLICES[name]]]
    assert indices == list(range(16))


def test_observation_agrees_with_the_oracle(params, drawn, states):
    found = observe_batch(states, params)
    assert found.shape == (COUNT, 16)
    for i in range(COUNT):
        expected = oracle.observation(
            **{name: values[i] for name, values in drawn.items()}, q_e0_previous=float(states.q_e0_previous[i])
        )
        np.testing.assert_allclose(found[i], expected, atol=4e-6)


def test_boresight_of_the_spacecraft_is_what_is_observed(params, drawn, states):
    boresight = np.array([0.48, -0.6, 0.64])
    craft = params.spacecraft.replace(boresight_B=jnp.array(boresight, jnp.float32))
    found = observe_batch(states, params.replace(spacecraft=craft))
    for i in range(8):
        expected = oracle.observation(
            **{name: values[i] for name, values in drawn.items()},
            q_e0_previous=float(states.q_e0_previous[i]),
            boresight=boresight,
        )
        np.testing.assert_allclose(found[i], expected, atol=4e-6)


def test_rotating_the_inertial_frame_changes_nothing(params, drawn, states):
    rng = np.random.default_rng(1)
    before = observe_batch(states, params)
    for _ in range(4):
        turn = oracle.random_attitude(rng)
        turned = drawn | {
            "q": np.stack([oracle.product(turn, q) for q in drawn["q"]]),
            "q_target": np.stack([oracle.product(turn, q) for q in drawn["q_target"]]),
            "axis": oracle.rotation(turn).apply(drawn["axis"]),
        }
        after = jax.vmap(env.reset)(_scenario(**turned)).replace(q_e0_previous=states.q_e0_previous)
        np.testing.assert_allclose(observe_batch(after, params), before, atol=4e-6)


def test_direction_to_the_zone_is_zero_where_the_boresight_coincides_with_its_axis(params):
    found = observe(_state(IDENTITY, axis=oracle.BORESIGHT), params)
    np.testing.assert_array_equal(found[observation.SLICES["zone_direction_B"]], 0.0)
    np.testing.assert_array_equal(found[observation.SLICES["zone_angle"]], 0.0)
    np.testing.assert_array_equal(found[observation.SLICES["zone_margin"]], -np.float32(0.3))
    assert np.all(np.isfinite(found))


def test_direction_to_the_zone_is_finite_where_only_rounding_separates_it_from_the_boresight(params):
    rng = np.random.default_rng(2)
    q = np.stack([oracle.random_attitude(rng) for _ in range(COUNT)])
    axis = oracle.rotation(q).apply(oracle.BORESIGHT)
    still, target, half_angle = np.zeros((COUNT, 3)), np.tile(IDENTITY, (COUNT, 1)), np.full(COUNT, 0.3)
    states = jax.vmap(env.reset)(_scenario(q, still, target, axis, half_angle))
    found = observe_batch(states, params)
    assert np.all(np.isfinite(found))
    assert np.all(np.linalg.norm(found[:, observation.SLICES["zone_direction_B"]], axis=1) <= 1.0 + 1e-6)
    assert np.all(found[:, observation.SLICES["zone_angle"]] < 1e-6)


def test_direction_to_the_zone_points_back_where_the_boresight_looks_away_from_it(params):
    found = observe(_state(IDENTITY, axis=-oracle.BORESIGHT), params)
    np.testing.assert_allclose(found[observation.SLICES["zone_direction_B"]], -oracle.BORESIGHT, atol=1e-6)
    np.testing.assert_allclose(found[observation.SLICES["zone_angle"]], np.pi, atol=1e-6)


def test_no_zone_looks_like_a_margin_of_at_least_half_a_turn(params, drawn):
    found = observe(_state(drawn["q"][0], half_angle=NO_ZONE_HALF_ANGLE), params)
    assert np.all(np.isfinite(found))
    assert np.all(found[observation.SLICES["zone_margin"]] >= np.float32(np.pi))


def test_at_the_start_the_previous_scalar_part_is_the_present_one(params, drawn):
    found = observe(_state(drawn["q"][0], q_target=drawn["q_target"][0]), params)
    assert found[observation.SLICES["q_e0_previous"]][0] == found[observation.SLICES["q_e"]][0]


@pytest.mark.parametrize("axis", [oracle.BORESIGHT, -oracle.BORESIGHT])
def test_gradient_of_the_observation_is_finite_where_the_boresight_is_along_the_axis(params, axis):
    state = _state(IDENTITY, axis=axis)

    def observed(q: jax.Array) -> jax.Array:
        return observation.observe(state.replace(body=state.body.replace(q_BN=q)), params)

    assert np.all(np.isfinite(jax.jit(jax.jacobian(observed))(jnp.array(IDENTITY, jnp.float32))))


def _crowded(drawn, zones: int) -> EnvState:
    """The first sample of the draw, with so many zones around it."""
    rng = np.random.default_rng(7)
    axes = np.stack([oracle.random_direction(rng) for _ in range(zones)])
    flown = _scenario(drawn["q"][0], drawn["omega"][0], drawn["q_target"][0], axes[0], 0.3)
    several = KeepOutZone(jnp.asarray(axes, jnp.float32), jnp.asarray(rng.uniform(0.2, 0.5, zones), jnp.float32))
    return reset(flown.replace(zones=several))


def _only(state: EnvState, zone: int) -> EnvState:
    """The same state with one of its zones alone."""
    alone = jax.tree.map(lambda leaf: leaf[zone : zone + 1], state.scenario.zones)
    return state.replace(scenario=state.scenario.replace(zones=alone))


ZONE_PARTS = ("zone_margin", "zone_angle", "zone_direction_B")


def test_several_zones_are_seen_nearest_first_each_as_if_it_were_alone(drawn, params):
    state = _crowded(drawn, 4)
    found, where = observation.observe(state, params, 3), observation.slices(3)
    assert found.shape == (observation.size(3),) == (26,)
    alone = [observe(_only(state, zone), params) for zone in range(4)]
    alone.sort(key=lambda seen: float(seen[observation.SLICES["zone_margin"]][0]))
    np.testing.assert_allclose(found[:16], alone[0], atol=1e-6)
    for number, seen in enumerate(alone[1:3], start=2):
        for name in ZONE_PARTS:
            np.testing.assert_allclose(found[where[f"{number}_{name}"]], seen[observation.SLICES[name]], atol=1e-6)


def test_the_order_of_the_zones_does_not_matter(drawn, params):
    state = _crowded(drawn, 3)
    turned = state.replace(
        scenario=state.scenario.replace(zones=jax.tree.map(lambda leaf: leaf[::-1], state.scenario.zones))
    )
    np.testing.assert_array_equal(observation.observe(turned, params, 3), observation.observe(state, params, 3))


def test_places_for_zones_that_are_not_there_read_far_away(drawn, params):
    state = _only(_crowded(drawn, 2), 0)
    found, where = observation.observe(state, params, 3), observation.slices(3)
    np.testing.assert_allclose(found[:16], observe(state, params), atol=1e-6)
    for number in (2, 3):
        values = [found[where[f"{number}_{name}"]] for name in ZONE_PARTS]
        np.testing.assert_allclose(np.concatenate(values), [np.pi, np.pi, 0.0, 0.0, 0.0], atol=1e-6)
