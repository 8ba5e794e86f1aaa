import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import oracle

from koz_jax.task import observation, observation_layout
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.environment import Reorientation
from koz_jax.task.observation_layout import ABSENT_HALF_ANGLE
from koz_jax.task.pointing_constraints import PointingConstraint
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState

COUNT = 64
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])

observe = jax.jit(observation.observe)
observe_batch = jax.jit(jax.vmap(observation.observe))
reset = jax.jit(Reorientation.from_config().reset)


def _scenario(q, omega, q_target, axis, half_angle, boresight=oracle.BORESIGHT) -> Scenario:
    """Of one sample, or of a batch when every argument but the boresight has a leading axis."""
    q, omega, q_target, axis, half_angle = (jnp.asarray(x, jnp.float32) for x in (q, omega, q_target, axis, half_angle))
    boresight_B = jnp.broadcast_to(jnp.asarray(boresight, jnp.float32), axis.shape)
    zones = PointingConstraint(boresight_B[..., None, :], axis[..., None, :], half_angle[..., None])
    return Scenario(RigidBodyState(q, omega), q_target, zones)


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
    return jax.vmap(reset)(_scenario(**drawn)).replace(q_e0_previous=jnp.array(q_e0_previous))


def test_layout_is_the_order_of_equation_6_of_the_paper():
    assert list(observation_layout.LAYOUT.values()) == [4, 3, 3, 1, 1, 3, 1]
    assert list(observation_layout.LAYOUT) == [
        "q_e",
        "omega_BN_B",
        "boresight_B",
        "zone_margin",
        "zone_angle",
        "zone_direction_B",
        "q_e0_previous",
    ]


def test_slices_partition_the_sixteen_numbers():
    assert observation_layout.SIZE == 16
    indices = [
        i for name in observation_layout.LAYOUT for i in range(observation_layout.SIZE)[observation_layout.SLICES[name]]
    ]
    assert indices == list(range(16))


def test_observation_agrees_with_the_oracle(drawn, states):
    found = observe_batch(states)
    assert found.shape == (COUNT, 16)
    for i in range(COUNT):
        expected = oracle.observation(
            **{name: values[i] for name, values in drawn.items()}, q_e0_previous=float(states.q_e0_previous[i])
        )
        np.testing.assert_allclose(found[i], expected, atol=4e-6)


def test_boresight_of_the_instrument_is_what_is_observed(drawn, states):
    boresight = np.array([0.48, -0.6, 0.64])
    other = jax.vmap(reset)(_scenario(**drawn, boresight=boresight)).replace(q_e0_previous=states.q_e0_previous)
    found = observe_batch(other)
    for i in range(8):
        expected = oracle.observation(
            **{name: values[i] for name, values in drawn.items()},
            q_e0_previous=float(states.q_e0_previous[i]),
            boresight=boresight,
        )
        np.testing.assert_allclose(found[i], expected, atol=4e-6)


def test_rotating_the_inertial_frame_changes_nothing(drawn, states):
    rng = np.random.default_rng(1)
    before = observe_batch(states)
    for _ in range(4):
        turn = oracle.random_attitude(rng)
        turned = drawn | {
            "q": np.stack([oracle.product(turn, q) for q in drawn["q"]]),
            "q_target": np.stack([oracle.product(turn, q) for q in drawn["q_target"]]),
            "axis": oracle.rotation(turn).apply(drawn["axis"]),
        }
        after = jax.vmap(reset)(_scenario(**turned)).replace(q_e0_previous=states.q_e0_previous)
        np.testing.assert_allclose(observe_batch(after), before, atol=4e-6)


def test_direction_to_the_zone_is_zero_where_the_boresight_coincides_with_its_axis():
    found = observe(_state(IDENTITY, axis=oracle.BORESIGHT))
    np.testing.assert_array_equal(found[observation_layout.SLICES["zone_direction_B"]], 0.0)
    np.testing.assert_array_equal(found[observation_layout.SLICES["zone_angle"]], 0.0)
    np.testing.assert_array_equal(found[observation_layout.SLICES["zone_margin"]], -np.float32(0.3))
    assert np.all(np.isfinite(found))


def test_direction_to_the_zone_is_finite_where_only_rounding_separates_it_from_the_boresight():
    rng = np.random.default_rng(2)
    q = np.stack([oracle.random_attitude(rng) for _ in range(COUNT)])
    axis = oracle.rotation(q).apply(oracle.BORESIGHT)
    still, target, half_angle = np.zeros((COUNT, 3)), np.tile(IDENTITY, (COUNT, 1)), np.full(COUNT, 0.3)
    states = jax.vmap(reset)(_scenario(q, still, target, axis, half_angle))
    found = observe_batch(states)
    assert np.all(np.isfinite(found))
    assert np.all(np.linalg.norm(found[:, observation_layout.SLICES["zone_direction_B"]], axis=1) <= 1.0 + 1e-6)
    assert np.all(found[:, observation_layout.SLICES["zone_angle"]] < 1e-6)


def test_direction_to_the_zone_points_back_where_the_boresight_looks_away_from_it():
    found = observe(_state(IDENTITY, axis=-oracle.BORESIGHT))
    np.testing.assert_allclose(found[observation_layout.SLICES["zone_direction_B"]], -oracle.BORESIGHT, atol=1e-6)
    np.testing.assert_allclose(found[observation_layout.SLICES["zone_angle"]], np.pi, atol=1e-6)


def test_no_zone_looks_like_a_margin_of_at_least_half_a_turn(drawn):
    found = observe(_state(drawn["q"][0], half_angle=ABSENT_HALF_ANGLE))
    assert np.all(np.isfinite(found))
    assert np.all(found[observation_layout.SLICES["zone_margin"]] >= np.float32(np.pi))


def test_at_the_start_the_previous_scalar_part_is_the_present_one(drawn):
    found = observe(_state(drawn["q"][0], q_target=drawn["q_target"][0]))
    assert found[observation_layout.SLICES["q_e0_previous"]][0] == found[observation_layout.SLICES["q_e"]][0]


@pytest.mark.parametrize("axis", [oracle.BORESIGHT, -oracle.BORESIGHT])
def test_gradient_of_the_observation_is_finite_where_the_boresight_is_along_the_axis(axis):
    state = _state(IDENTITY, axis=axis)

    def observed(q: jax.Array) -> jax.Array:
        return observation.observe(state.replace(body=state.body.replace(q_BN=q)))

    assert np.all(np.isfinite(jax.jit(jax.jacobian(observed))(jnp.array(IDENTITY, jnp.float32))))


def _crowded(drawn, zones: int) -> EnvState:
    """The first sample of the draw, with so many zones around it."""
    rng = np.random.default_rng(7)
    axes = np.stack([oracle.random_direction(rng) for _ in range(zones)])
    flown = _scenario(drawn["q"][0], drawn["omega"][0], drawn["q_target"][0], axes[0], 0.3)
    half_angles = jnp.asarray(rng.uniform(0.2, 0.5, zones), jnp.float32)
    boresights_B = jnp.tile(flown.constraints.boresight_B, (zones, 1))
    several = PointingConstraint(boresights_B, jnp.asarray(axes, jnp.float32), half_angles)
    return reset(flown.replace(constraints=several))


def _only(state: EnvState, zone: int) -> EnvState:
    """The same state with one of its zones alone."""
    alone = jax.tree.map(lambda leaf: leaf[zone : zone + 1], state.scenario.constraints)
    return state.replace(scenario=state.scenario.replace(constraints=alone))


ZONE_PARTS = ("zone_margin", "zone_angle", "zone_direction_B")


@pytest.mark.slow
def test_several_zones_are_seen_nearest_first_each_as_if_it_were_alone(drawn):
    state = _crowded(drawn, 4)
    found, where = observation.observe(state, 3), observation_layout.slices(3)
    assert found.shape == (observation_layout.size(3),) == (26,)
    alone = [observe(_only(state, zone)) for zone in range(4)]
    alone.sort(key=lambda seen: float(seen[observation_layout.SLICES["zone_margin"]][0]))
    np.testing.assert_allclose(found[:16], alone[0], atol=1e-6)
    for number, seen in enumerate(alone[1:3], start=2):
        for name in ZONE_PARTS:
            np.testing.assert_allclose(
                found[where[f"{number}_{name}"]], seen[observation_layout.SLICES[name]], atol=1e-6
            )


def test_the_order_of_the_zones_does_not_matter(drawn):
    state = _crowded(drawn, 3)
    turned = state.replace(
        scenario=state.scenario.replace(constraints=jax.tree.map(lambda leaf: leaf[::-1], state.scenario.constraints))
    )
    np.testing.assert_array_equal(observation.observe(turned, 3), observation.observe(state, 3))


def test_places_for_zones_that_are_not_there_read_far_away(drawn):
    state = _only(_crowded(drawn, 2), 0)
    found, where = observation.observe(state, 3), observation_layout.slices(3)
    np.testing.assert_allclose(found[:16], observe(state), atol=1e-6)
    for number in (2, 3):
        values = [found[where[f"{number}_{name}"]] for name in ZONE_PARTS]
        np.testing.assert_allclose(np.concatenate(values), [np.pi, np.pi, 0.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.slow
def test_of_two_instruments_the_one_nearest_to_its_zone_is_seen(drawn):
    """The first 16 numbers are those of the pair with the smallest margin, boresight included; the rest follow."""
    state = _crowded(drawn, 2)
    other_B = jnp.array([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0]])
    zones = state.scenario.constraints.replace(boresight_B=other_B)
    state = state.replace(scenario=state.scenario.replace(constraints=zones))
    where, seen_first = observation_layout.slices(2), set()
    for turn in jax.random.normal(jax.random.key(0), (16, 4)):
        q_BN = turn / jnp.linalg.norm(turn)
        at = state.replace(body=state.body.replace(q_BN=q_BN))
        found, alone = observation.observe(at, 2), [observe(_only(at, number)) for number in range(2)]
        margins = [float(seen[where["zone_margin"]][0]) for seen in alone]
        first, second = np.argsort(margins)
        np.testing.assert_allclose(found[:16], alone[first], atol=1e-6)
        np.testing.assert_array_equal(found[where["boresight_B"]], other_B[first])
        for name in ZONE_PARTS:
            np.testing.assert_allclose(found[where[f"2_{name}"]], alone[second][where[name]], atol=1e-6)
        seen_first.add(int(first))
    assert seen_first == {0, 1}
