"""Spacecraft and situations at random, for the tests of policies for any spacecraft."""

import dataclasses
from typing import NamedTuple

import jax
import numpy as np

import koz_jax
from koz_jax.agents.agent import Agent
from koz_jax.config.task import SpacecraftConfig, TaskConfig
from koz_jax.config.training import NetworkConfig
from koz_jax.task import state
from koz_jax.task.environment import model_from_config
from koz_jax.task.state import EnvState, Model
from support import tiny

SCALED = NetworkConfig.model_validate(
    {"hidden_sizes": (16, 16), "encoding": {"rate_scales": (0.016, 0.16)}, "scaled": True}
)


def agent(network: NetworkConfig = SCALED) -> Agent:
    """An untrained agent for any spacecraft, whose actions fill their range."""
    timid = tiny.untrained_agent(network=network)
    policy = jax.tree.map(lambda leaf: 2.0 * np.asarray(leaf), timid.controller.policy)
    return dataclasses.replace(timid, controller=timid.controller.replace(policy=policy))


class Situation(NamedTuple):
    """A spacecraft, and what is measured of it."""

    spacecraft: SpacecraftConfig
    step_seconds: float
    urgency: float
    q_BN: np.ndarray
    omega_BN_B: np.ndarray  # [rad/s]
    q_DN: np.ndarray
    zones: list[tuple[np.ndarray, float]]

    @property
    def model(self) -> Model:
        return model_from_config(TaskConfig(spacecraft=self.spacecraft)).replace(dt=np.float32(self.step_seconds))

    @property
    def state(self) -> EnvState:
        rate_deg, boresight = np.rad2deg(self.omega_BN_B), self.spacecraft.boresight
        told = koz_jax.maneuver(self.q_BN, self.q_DN, self.zones, boresight=boresight, rate_deg=rate_deg)
        return state.begin(told, self.model)


def direction(rng: np.random.Generator, entries: int = 3) -> np.ndarray:
    drawn = rng.normal(size=entries)
    return drawn / np.linalg.norm(drawn)


def spacecraft(rng: np.random.Generator, limited: bool = False) -> SpacecraftConfig:
    """A body of any size, strength, shape and instrument; limited: with a limit of its rate."""
    size, strength = 10.0 ** rng.uniform(-2.0, 4.0), 10.0 ** rng.uniform(-3.0, 2.0)
    second = rng.uniform(0.05, 1.0, 3)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    inertia = size * (turn * (np.sum(second) - second)) @ turn.T
    limits = strength * 2.0 ** rng.uniform(-0.5, 0.5, 3)
    body = SpacecraftConfig.model_validate(
        {
            "inertia": (0.5 * (inertia + inertia.T)).tolist(),
            "torque_limit": tuple(limits.tolist()),
            "boresight": direction(rng).tolist(),
        }
    )
    rate_deg = float(np.rad2deg(10.0 ** rng.uniform(-1.0, 1.0) / body.time_unit))
    return body.model_copy(update={"max_rate_deg": rate_deg}) if limited else body


def situations(count: int, seed: int, zones: int = 1) -> list[Situation]:
    """Spacecraft, each in a situation of its own; every second one has a limit of its rate."""
    rng = np.random.default_rng(seed)
    drawn = []
    for number in range(count):
        body = spacecraft(rng, limited=number % 2 == 1)
        drawn.append(
            Situation(
                spacecraft=body,
                step_seconds=body.time_unit * rng.uniform(0.005, 0.05),
                urgency=rng.uniform(),
                q_BN=direction(rng, 4),
                omega_BN_B=direction(rng) * 10.0 ** rng.uniform(-4.0, 0.3) / body.time_unit,
                q_DN=direction(rng, 4),
                zones=[(direction(rng), rng.uniform(5.0, 60.0)) for _ in range(zones)],
            )
        )
    return drawn
