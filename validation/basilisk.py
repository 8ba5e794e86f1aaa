"""Fly the exported C controller in Basilisk, a simulator that shares no code with koz_jax, over the same cases.

Basilisk pins other packages, so it lives in an environment of its own, where koz_jax is only a folder on the path:

    python -m venv .venv-bsk && .venv-bsk/bin/pip install bsk==2.12.1 pydantic
    python validation/draw_cases.py --agent phase2 --cases 1000 --out build/basilisk
    PYTHONPATH=. .venv-bsk/bin/python validation/basilisk.py build/basilisk

1. Torque-free motion: Basilisk's spacecraft (RK4 on MRPs, ten steps where koz_jax takes one) beside the integrator of
   koz_jax in float64, from the same random tumbles; largest difference in attitude and in rate over 100 s.
2. The cases: Basilisk integrates, the compiled C code observes and decides every 0.1 s, the torque acts as an external
   torque in between, and the verdicts are computed here in float64.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from Basilisk.simulation import extForceTorque, spacecraft  # pyright: ignore[reportMissingImports]
from Basilisk.utilities import RigidBodyKinematics, SimulationBaseClass, macros  # pyright: ignore[reportMissingImports]

from koz_jax.export.library import CLibrary

_SUBSTEPS = 10
_ALLOWED_RADIANS = 1e-6
_ALLOWED_POINTS = 0.5


class Fleet:
    """Spacecraft that tumble independently of each other in one Basilisk simulation."""

    def __init__(self, q_BN: np.ndarray, omega_BN_B: np.ndarray, inertia: np.ndarray, step_seconds: float) -> None:
        """q_BN: (n, 4); omega_BN_B: (n, 3) [rad/s]; inertia: (3, 3) [kg m^2]; step_seconds: what ``advance`` takes."""
        self._step = macros.sec2nano(step_seconds)
        self._now = 0
        self._sim = SimulationBaseClass.SimBaseClass()
        process = self._sim.CreateNewProcess("process")
        process.addTask(self._sim.CreateNewTask("task", macros.sec2nano(step_seconds / _SUBSTEPS)))
        self._bodies, self._thrusters = [], []
        for number, (q, omega) in enumerate(zip(q_BN.astype(float), omega_BN_B.astype(float), strict=True)):
            body = spacecraft.Spacecraft()
            body.ModelTag = f"body{number}"
            body.hub.mHub = 100.0
            body.hub.IHubPntBc_B = inertia.tolist()
            body.hub.sigma_BNInit = RigidBodyKinematics.EP2MRP(q / np.linalg.norm(q)).reshape(3, 1).tolist()
            body.hub.omega_BN_BInit = omega.reshape(3, 1).tolist()
            thruster = extForceTorque.ExtForceTorque()
            thruster.ModelTag = f"torque{number}"
            body.addDynamicEffector(thruster)
            self._sim.AddModelToTask("task", body)
            self._sim.AddModelToTask("task", thruster)
            self._bodies.append(body)
            self._thrusters.append(thruster)
        self._sim.InitializeSimulation()
        self._q_BN = q_BN.astype(float)
        self.advance(0)

    def advance(self, steps: int = 1) -> None:
        """Fly on with the torque held."""
        self._now += steps * self._step
        self._sim.ConfigureStopTime(self._now)
        self._sim.ExecuteSimulation()

    def torque(self, torque_B: np.ndarray) -> None:
        """Set the torques (n, 3) [N m] from now on."""
        for thruster, torque in zip(self._thrusters, torque_B.astype(float), strict=True):
            thruster.extTorquePntB_B = torque.reshape(3, 1).tolist()

    def state(self) -> tuple[np.ndarray, np.ndarray]:
        """Attitudes (n, 4), continuous in time, and rates (n, 3) [rad/s]."""
        states = [body.scStateOutMsg.read() for body in self._bodies]
        sigma = np.array([state.sigma_BN for state in states])
        squared = np.sum(sigma**2, axis=1, keepdims=True)
        q_BN = np.concatenate([1.0 - squared, 2.0 * sigma], axis=1) / (1.0 + squared)
        # MRPs know attitudes only, quaternions have a sign: keep it from one instant to the next.
        q_BN *= np.where(np.sum(q_BN * self._q_BN, axis=1, keepdims=True) < 0.0, -1.0, 1.0)
        self._q_BN = q_BN
        return q_BN, np.array([state.omega_BN_B for state in states])


def relative(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """conjugate(a) (x) b, row by row.  a, b: (n, 4).  Returns (n, 4)."""
    scalar = np.sum(a * b, axis=1, keepdims=True)
    vector = a[:, :1] * b[:, 1:] - b[:, :1] * a[:, 1:] - np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([scalar, vector], axis=1)


def angle(q: np.ndarray) -> np.ndarray:
    """Full rotation angle.  q: (n, 4).  Returns (n,) [rad] in [0, 2 pi]."""
    return 2.0 * np.arctan2(np.linalg.norm(q[:, 1:], axis=1), q[:, 0])


def separation(q_BN: np.ndarray, boresight_B: np.ndarray, axis_N: np.ndarray) -> np.ndarray:
    """Angles between the telescope and the zones' axes (n, zones, 3).  Returns (n, zones) [rad]."""
    looking_N = np.array([RigidBodyKinematics.EP2C(q).T @ boresight_B for q in q_BN])[:, None]
    return np.arctan2(np.linalg.norm(np.cross(looking_N, axis_N), axis=2), np.sum(looking_N * axis_N, axis=2))


def with_absent_zones(axis_N: np.ndarray, half_angle: np.ndarray, zones: int) -> tuple[np.ndarray, np.ndarray]:
    """Fill up to as many zones as the controller wants to be told of.  axis_N: (n, some, 3); half_angle: (n, some)."""
    count, some = half_angle.shape
    absent = np.tile([1.0, 0.0, 0.0], (count, zones - some, 1)), np.full((count, zones - some), -np.pi)
    return np.concatenate([axis_N, absent[0]], axis=1), np.concatenate([half_angle, absent[1]], axis=1)


def compare_tumbles(data: dict[str, np.ndarray]) -> bool:
    """Torque-free motion beside that of koz_jax in float64."""
    ours_q, ours_omega = data["tumble_q_BN"], data["tumble_omega_BN_B"]
    fleet = Fleet(ours_q[:, 0], ours_omega[:, 0], data["inertia"], float(data["step_seconds"]))
    attitude = rate = 0.0
    for step in range(ours_q.shape[1]):
        if step:
            fleet.advance()
        q_BN, omega = fleet.state()
        apart = relative(ours_q[:, step], q_BN)
        attitude = max(attitude, float(2.0 * np.max(np.linalg.norm(apart[:, 1:], axis=1))))
        rate = max(rate, float(np.max(np.abs(omega - ours_omega[:, step]))))
    turned = np.rad2deg(np.max(np.linalg.norm(ours_omega[:, 0], axis=1)))
    seconds = (ours_q.shape[1] - 1) * float(data["step_seconds"])
    print(
        f"torque-free, {len(ours_q)} tumbles of up to {turned:.1f} deg/s over {seconds:g} s: attitude within"
        f" {attitude:.1e} rad, rate within {rate:.1e} rad/s"
    )
    return attitude < _ALLOWED_RADIANS and rate < _ALLOWED_RADIANS


def compare_cases(data: dict[str, np.ndarray], controller: CLibrary) -> bool:
    """All cases under the exported controller, with verdicts made here."""
    start = time.perf_counter()
    dt, steps = float(data["step_seconds"]), int(data["steps"])
    fleet = Fleet(data["q_BN"], data["omega_BN_B"], data["inertia"], dt)
    axis_N, half_angle = with_absent_zones(data["zone_axis_N"], data["zone_half_angle"], controller.zones)
    margins, errors, effort = [], [], np.zeros(len(half_angle))
    memory = None
    for step in range(steps + 1):
        q_BN, omega = fleet.state()
        errors.append(angle(relative(data["q_DN"].astype(float), q_BN)))
        margins.append(np.min(separation(q_BN, data["boresight_B"], axis_N) - half_angle, axis=1))
        if step == steps:
            break
        # As a star tracker hands it over: what the controller makes of it does not depend on the sign.
        measured = q_BN * np.where(q_BN[:, :1] < 0.0, -1.0, 1.0)
        told = np.concatenate([measured, omega, data["q_DN"], axis_N.reshape(len(q_BN), -1), half_angle], axis=1)
        observation, memory = controller.observe(told, controller.start(told) if memory is None else memory)
        torque_B = controller.torque(observation)
        fleet.torque(torque_B)
        fleet.advance()
        effort += np.sum(torque_B.astype(float) ** 2, axis=1) * dt
    print(f"{len(half_angle)} cases in Basilisk: {time.perf_counter() - start:.0f} s")
    return _verdict(data, np.array(errors), np.array(margins), effort)


def _verdict(data: dict[str, np.ndarray], errors: np.ndarray, margins: np.ndarray, effort: np.ndarray) -> bool:
    """errors, margins: (steps + 1, cases) [rad]; effort: (cases,) [N^2 m^2 s]."""
    outside = errors > data["settled_angle"]
    settled, violated = ~outside[-1], np.min(margins, axis=0) <= 0.0
    # Steps after which the error stays within the accuracy.
    last = np.where(outside.any(axis=0), len(outside) - np.argmax(outside[::-1], axis=0), 0)
    theirs_time = np.where(settled, last * float(data["step_seconds"]), np.nan)
    ours = 100.0 * np.mean(data["settled"] & ~data["violated"])
    theirs = 100.0 * np.mean(settled & ~violated)
    differing = np.sum((settled != data["settled"]) | (violated != data["violated"]))
    rows = (
        ("success [%]", ours, theirs),
        ("not settled [%]", 100.0 * np.mean(~data["settled"]), 100.0 * np.mean(~settled)),
        ("violated [%]", 100.0 * np.mean(data["violated"]), 100.0 * np.mean(violated)),
        ("settling time [s]", np.nanmean(data["settling_time"]), np.nanmean(theirs_time)),
        ("effort [N^2 m^2 s]", np.mean(data["control_effort"]), np.mean(effort)),
    )
    print(f"{'':20}{'koz_jax':>12}{'Basilisk':>12}")
    for name, of_ours, of_theirs in rows:
        print(f"{name:20}{of_ours:12.3f}{of_theirs:12.3f}")
    print(f"verdicts that differ: {differing} of {len(settled)}")
    margin = np.rad2deg(np.max(np.abs(np.min(margins, axis=0) - data["min_margin"])))
    print(f"largest difference of a smallest margin: {margin:.1e} deg")
    return abs(ours - theirs) <= _ALLOWED_POINTS


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path, help="where validation/draw_cases.py has written")
    folder = parser.parse_args().folder
    with np.load(folder / "cases.npz", allow_pickle=False) as file:
        data = dict(file)
    agreed = [compare_tumbles(data), compare_cases(data, CLibrary(folder))]
    print("agreed" if all(agreed) else "NOT AGREED")
    return 0 if all(agreed) else 1


if __name__ == "__main__":
    sys.exit(main())
