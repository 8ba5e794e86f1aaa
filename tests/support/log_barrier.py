"""The published potential and the rates of Lyapunov functions made of it, in float64 and by differences."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from koz_jax.config.maneuvers.maneuver_file import load_maneuver
from koz_jax.evaluation.maneuver import scenario as scenario_of
from koz_jax.task import rotations, state
from koz_jax.task.environment import model_from_config
from koz_jax.task.pointing_constraints import smallest_margin
from koz_jax.task.scenario import Scenario
from koz_jax.task.state import EnvState, Model
from support.states import actions, directions, quaternions, random_states
from support.tiny import MANEUVER_FILES

PUBLISHED = load_maneuver(MANEUVER_FILES["yang2021"])
YANG = model_from_config(PUBLISHED.task)

COUNT = 64


def several_instruments() -> EnvState:
    """Random states whose three constraints, one of them absent, have a boresight each."""
    at = random_states(COUNT, 31, rate=0.03)
    looks_B = directions(3 * COUNT, 40).reshape(COUNT, 3, 3)
    zones = at.scenario.constraints.replace(boresight_B=looks_B)
    return at.replace(scenario=at.scenario.replace(constraints=zones))


def one_by_one(at: EnvState) -> list[EnvState]:
    """States as NumPy has them."""
    host = jax.tree.map(np.asarray, at)
    return [jax.tree.map(lambda leaf, i=i: leaf[i], host) for i in range(COUNT)]


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    scalar = a[0] * b[0] - a[1:] @ b[1:]
    return np.array([scalar, *(a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:]))])


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    return multiply(multiply(q, np.array([0.0, *v])), q * np.array([1.0, -1.0, -1.0, -1.0]))[1:]


def turned(q: np.ndarray, vector_B: np.ndarray) -> np.ndarray:
    """An attitude turned by a rotation vector in body axes, without a jump in sign."""
    half = 0.5 * np.linalg.norm(vector_B)
    return multiply(q, np.array([np.cos(half), *(0.5 * np.sinc(half / np.pi) * vector_B)]))


def cosines(q: np.ndarray, scenario: Scenario) -> np.ndarray:
    """Cosines of the half angle, and of the angle to the axis, of each zone that there is.  Returns (zones, 2)."""
    zones = scenario.constraints
    stack = zip(np.asarray(zones.boresight_B), np.asarray(zones.axis_N), np.asarray(zones.half_angle), strict=True)
    return np.array([(np.cos(float(edge)), rotate(q, look) @ axis) for look, axis, edge in stack if edge > 0.0])


def value(q: np.ndarray, scenario: Scenario, away: float, barrier: float) -> float:
    """V, by angles."""
    edges, found = cosines(q, scenario).T
    weight = away - barrier * np.sum(np.log(0.5 * (edges - found)))
    return weight * float(np.sum((q - np.asarray(scenario.q_DN, float)) ** 2))


def slope(q: np.ndarray, scenario: Scenario, away: float, barrier: float) -> np.ndarray:
    """Twice the change of V with a turn about each axis."""
    ways = 1e-4 * np.eye(3)
    plus, minus = ([value(turned(q, sign * way), scenario, away, barrier) for way in ways] for sign in (1.0, -1.0))
    return np.subtract(plus, minus) / 1e-4


def is_clear(q: np.ndarray, scenario: Scenario) -> bool:
    """Whether no instrument looks into its zone, or close past it."""
    edges, found = cosines(q, scenario).T
    return bool(np.min(edges - found) > 0.05)


Lyapunov = Callable[[np.ndarray, np.ndarray, Scenario], tuple[float, float]]


def check_rates(controller: object, model: Model, lyapunov: Lyapunov) -> None:
    """In the controlled motion a function changes at the rate that its theory says, which is below zero.

    lyapunov: of attitude, rate and scenario, the function and that rate.  Where torques are cut, it need not hold.
    """
    inertia_B, box_B = np.asarray(model.inertia_B, float), np.asarray(state.nominal_limits(model).box_B, float)
    at = several_instruments()
    checked = 0
    for one, action in zip(one_by_one(at), actions(controller, at, model), strict=True):
        q, w = np.asarray(one.body.q_BN, float), np.asarray(one.body.omega_BN_B, float)
        if np.abs(action).max() == 1.0 or not is_clear(q, one.scenario):
            continue
        change_B = np.linalg.solve(inertia_B, box_B * action - np.cross(w, inertia_B @ w))
        after, before = (lyapunov(turned(q, h * w), w + h * change_B, one.scenario)[0] for h in (1e-4, -1e-4))
        expected = lyapunov(q, w, one.scenario)[1]
        assert expected < 0.0
        np.testing.assert_allclose((after - before) / 2e-4, expected, rtol=2e-3, atol=1e-5)
        checked += 1
    assert checked >= 12


def check_another_frame(controller: object, model: Model) -> None:
    """The same states, seen from other inertial axes, have the same actions."""
    turn = np.asarray(quaternions(1, 17)[0])
    at = several_instruments()

    def attitudes(q: jax.Array) -> jax.Array:
        return jnp.asarray(np.stack([multiply(turn, one) for one in np.asarray(q)]), jnp.float32)

    axes_N = at.scenario.constraints.axis_N
    seen_N = np.stack([[rotate(turn, axis) for axis in axes] for axes in np.asarray(axes_N)])
    constraints = at.scenario.constraints.replace(axis_N=jnp.asarray(seen_N, jnp.float32))
    scenario = at.scenario.replace(q_DN=attitudes(at.scenario.q_DN), constraints=constraints)
    seen = at.replace(body=at.body.replace(q_BN=attitudes(at.body.q_BN)), scenario=scenario)
    found = actions(controller, at, model)
    np.testing.assert_allclose(actions(controller, seen, model), found, atol=2e-3)
    assert np.abs(found).max() > 0.5


def fly_published(controller: object) -> tuple[np.ndarray, float, float]:
    """Yang's maneuver for 150 s: angle to the target [deg] at every step, smallest margin [deg], effort [N^2 m^2 s]."""
    scenario = scenario_of(PUBLISHED)
    angles, margins, efforts = _fly(controller, state.begin(scenario, YANG))
    return np.rad2deg(angles), float(np.rad2deg(np.min(margins))), float(np.sum(efforts))


@jax.jit
def _fly(controller: object, start: EnvState) -> tuple[jax.Array, jax.Array, jax.Array]:
    def advance(at: EnvState, _: None) -> tuple[EnvState, tuple[jax.Array, jax.Array, jax.Array]]:
        action, _ = controller.decide(at, YANG, None)  # pyright: ignore[reportAttributeAccessIssue]
        torque_B, _ = YANG.actuators.apply(action, None, at.body.omega_BN_B, YANG.inertia_B, YANG.dt)
        after = at.replace(body=state.propagate(at.body, torque_B, state.nominal(YANG), YANG.dt))
        angle = rotations.rotation_angle(state.attitude_error(after))
        margin = smallest_margin(after.body.q_BN, at.scenario.constraints)
        return after, (angle, margin, rotations.dot(torque_B, torque_B) * YANG.dt)

    return jax.lax.scan(advance, start, None, length=1500)[1]
