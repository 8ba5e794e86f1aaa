import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support import oracle

from koz_jax.task import rotations

multiply = jax.jit(rotations.multiply)
conjugate = jax.jit(rotations.conjugate)
rotate = jax.jit(rotations.rotate)
rotation_angle = jax.jit(rotations.rotation_angle)
angle_between = jax.jit(rotations.angle_between)
from_axis_angle = jax.jit(rotations.from_axis_angle)
normalize = jax.jit(rotations.normalize)
cross = jax.jit(rotations.cross)
dot = jax.jit(rotations.dot)
norm = jax.jit(rotations.norm)
norm_gradient = jax.jit(jax.grad(rotations.norm))

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0], np.float32)

# Rounding of a product of a few float32 numbers of size 1.
ATOL = 1e-6
# XLA flushes subnormal numbers to zero.
TINY = float(np.finfo(np.float32).tiny)


def _vectors(size: int, least: float = 0.0) -> st.SearchStrategy[np.ndarray]:
    component = st.floats(-1.0, 1.0, width=32)
    arrays = st.lists(component, min_size=size, max_size=size).map(lambda v: np.array(v, np.float32))
    return arrays.filter(lambda v: float(np.linalg.norm(v)) >= least)


def _units(size: int) -> st.SearchStrategy[np.ndarray]:
    return _vectors(size, least=0.1).map(lambda v: v / np.linalg.norm(v))


attitudes, directions, vectors = _units(4), _units(3), _vectors(3)
turns = st.floats(0.0, 6.25, width=32)


@pytest.mark.slow
@given(attitudes, attitudes, attitudes)
def test_product_is_associative(a, b, c):
    np.testing.assert_allclose(multiply(multiply(a, b), c), multiply(a, multiply(b, c)), atol=ATOL)


@given(attitudes)
def test_identity_is_neutral_and_the_conjugate_is_the_inverse(q):
    np.testing.assert_allclose(multiply(IDENTITY, q), q, rtol=0, atol=TINY)
    np.testing.assert_allclose(multiply(q, IDENTITY), q, rtol=0, atol=TINY)
    np.testing.assert_allclose(multiply(q, conjugate(q)), IDENTITY, atol=ATOL)
    np.testing.assert_allclose(multiply(conjugate(q), q), IDENTITY, atol=ATOL)


@given(attitudes, attitudes)
def test_conjugate_reverses_a_product(a, b):
    np.testing.assert_allclose(conjugate(multiply(a, b)), multiply(conjugate(b), conjugate(a)), atol=ATOL)


@given(_vectors(4), _vectors(4))
def test_norm_of_a_product_is_the_product_of_norms(a, b):
    np.testing.assert_allclose(
        np.linalg.norm(multiply(a, b)), np.linalg.norm(a) * np.linalg.norm(b), rtol=1e-5, atol=ATOL
    )


@given(attitudes, attitudes)
def test_product_is_the_composition_of_rotations(a, b):
    composed = oracle.rotation(np.asarray(multiply(a, b)))
    assert (composed.inv() * (oracle.rotation(a) * oracle.rotation(b))).magnitude() < 1e-6


@given(attitudes, vectors)
def test_rotate_agrees_with_scipy(q, v):
    np.testing.assert_allclose(rotate(q, v), oracle.rotation(q).apply(v), atol=2e-6)


@given(attitudes, vectors)
def test_rotate_is_the_sandwich_product(q, v):
    sandwich = multiply(multiply(q, np.concatenate([[np.float32(0.0)], v])), conjugate(q))
    np.testing.assert_allclose(rotate(q, v), sandwich[1:], atol=2e-6)


@given(attitudes, vectors)
def test_both_signs_of_a_quaternion_rotate_alike(q, v):
    np.testing.assert_allclose(rotate(q, v), rotate(-q, v), rtol=0, atol=TINY)


@given(attitudes, vectors)
def test_conjugate_rotates_back(q, v):
    np.testing.assert_allclose(rotate(conjugate(q), rotate(q, v)), v, atol=2e-6)


@given(vectors, vectors)
def test_vector_products_agree_with_numpy(a, b):
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), atol=ATOL)
    np.testing.assert_allclose(dot(a, b), a @ b, atol=ATOL)
    np.testing.assert_allclose(norm(a), np.linalg.norm(a), rtol=1e-6, atol=1e-18)  # squares below 1e-36 may be flushed


@given(directions, turns)
def test_axis_and_angle_agree_with_scipy(axis, angle):
    q = np.asarray(from_axis_angle(axis, np.float32(angle)))
    expected = oracle.Rotation.from_rotvec(np.float64(angle) * axis.astype(np.float64))
    assert (oracle.rotation(q).inv() * expected).magnitude() < 2e-6
    np.testing.assert_allclose(np.linalg.norm(q), 1.0, atol=ATOL)


@given(directions, turns)
def test_rotation_angle_undoes_axis_and_angle_up_to_a_full_turn(axis, angle):
    np.testing.assert_allclose(rotation_angle(from_axis_angle(axis, np.float32(angle))), angle, atol=2e-6)


@given(attitudes)
def test_rotation_angle_of_opposite_signs_add_to_a_full_turn(q):
    angle, other = float(rotation_angle(q)), float(rotation_angle(-q))
    assert 0.0 <= angle <= np.float32(2 * np.pi)
    np.testing.assert_allclose(angle + other, 2 * np.pi, atol=ATOL)
    np.testing.assert_allclose(min(angle, other), oracle.rotation(q).magnitude(), atol=2e-6)


@pytest.mark.parametrize("near", [0.0, np.pi, 2 * np.pi])
def test_rotation_angle_is_accurate_to_1e_6_rad(near):
    offsets = np.geomspace(1e-8, 1e-2, 61)
    angles = near + offsets if near < np.pi else near - offsets
    axis = oracle.random_direction(np.random.default_rng(0))
    exact = np.concatenate([np.cos(angles / 2)[:, None], np.sin(angles / 2)[:, None] * axis], axis=1)
    np.testing.assert_allclose(jax.vmap(rotation_angle)(exact.astype(np.float32)), angles, rtol=0, atol=1e-6)


def test_small_rotation_angles_keep_their_relative_accuracy():
    angles = np.geomspace(1e-8, 1e-2, 61)
    q = np.stack([np.cos(angles / 2), np.sin(angles / 2), 0 * angles, 0 * angles], axis=1)
    np.testing.assert_allclose(jax.vmap(rotation_angle)(q.astype(np.float32)), angles, rtol=1e-6)


def test_pointing_error_between_arbitrary_attitudes_is_accurate_to_1e_6_rad_near_zero():
    rng = np.random.default_rng(1)
    angles = np.geomspace(1e-6, 1e-2, 200)
    target = np.stack([oracle.random_attitude(rng) for _ in angles])
    axes = np.stack([oracle.random_direction(rng) for _ in angles])
    attitude = np.stack(
        [
            oracle.product(q, np.array([np.cos(a / 2), *(np.sin(a / 2) * axis)]))
            for q, a, axis in zip(target, angles, axes, strict=True)
        ]
    )
    target, attitude = target.astype(np.float32), attitude.astype(np.float32)
    # Rounding the inputs to float32 moves the attitudes themselves; the exact answer is that of the rounded ones.
    exact = [
        oracle.rotation_angle(oracle.product(oracle.conjugate(d), q))
        for d, q in zip(target.astype(np.float64), attitude.astype(np.float64), strict=True)
    ]
    found = jax.vmap(lambda d, q: rotation_angle(multiply(conjugate(d), q)))(target, attitude)
    np.testing.assert_allclose(found, exact, rtol=0, atol=1e-6)


@pytest.mark.parametrize("near", [0.0, np.pi])
def test_angle_between_vectors_is_accurate_to_1e_6_rad(near):
    rng = np.random.default_rng(2)
    offsets = np.concatenate([[0.0], np.geomspace(1e-8, 1e-2, 200)])
    angles = np.abs(near - offsets)
    a = np.stack([oracle.random_direction(rng) for _ in angles])
    across = np.cross(a, np.stack([oracle.random_direction(rng) for _ in angles]))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    b = np.cos(angles)[:, None] * a + np.sin(angles)[:, None] * across
    found = jax.vmap(angle_between)(a.astype(np.float32), b.astype(np.float32))
    np.testing.assert_allclose(found, angles, rtol=0, atol=1e-6)


@given(directions, directions)
def test_angle_between_is_symmetric_and_supplementary(a, b):
    assert angle_between(a, b) == angle_between(b, a)
    np.testing.assert_allclose(angle_between(a, b) + angle_between(a, -b), np.pi, atol=ATOL)
    np.testing.assert_allclose(angle_between(a, b), oracle.angle_between(a, b), atol=ATOL)


@given(attitudes, directions, directions)
def test_angle_between_does_not_depend_on_the_frame(q, a, b):
    np.testing.assert_allclose(angle_between(rotate(q, a), rotate(q, b)), angle_between(a, b), atol=4e-6)


@given(_vectors(4, least=1e-3))
def test_normalize_gives_the_unit_vector_of_the_same_direction(v):
    unit = np.asarray(normalize(v))
    np.testing.assert_allclose(np.linalg.norm(unit), 1.0, atol=ATOL)
    np.testing.assert_allclose(unit * np.linalg.norm(v), v, atol=ATOL)


# Refinement differentiates through whole maneuvers, which pass through the points where a norm has a kink.


@pytest.mark.parametrize("size", [3, 4])
def test_gradient_of_the_norm_is_zero_at_zero(size):
    np.testing.assert_array_equal(jax.grad(rotations.norm)(np.zeros(size, np.float32)), 0.0)


@given(_vectors(3, least=1e-3))
def test_gradient_of_the_norm_is_the_unit_vector(v):
    np.testing.assert_allclose(norm_gradient(v), v.astype(np.float64) / np.linalg.norm(v.astype(np.float64)), atol=1e-5)


def test_gradients_of_the_angles_are_finite_at_zero_and_at_half_a_turn():
    x = np.array([1.0, 0.0, 0.0], np.float32)
    for q in (IDENTITY, -IDENTITY, np.array([0.0, 0.0, 1.0, 0.0], np.float32)):
        assert np.all(np.isfinite(jax.grad(rotations.rotation_angle)(q)))
    for b in (x, -x):
        assert np.all(np.isfinite(np.array(jax.grad(rotations.angle_between, argnums=(0, 1))(x, b))))
