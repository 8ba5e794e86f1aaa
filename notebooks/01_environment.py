# %% [markdown]
# # 1. The environment
#
# A spacecraft turns to a target attitude. Its telescope must not look into a bright cone, the *keep-out zone*, which
# sits right on the shortest path. This notebook looks at what the learner meets: dynamics, zone, observation, reward,
# and the curriculum.

# %%
import functools

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

from koz_jax import Reorientation, TaskConfig, fly_scenario, load_agent, preset
from koz_jax.figures import sphere
from koz_jax.learning import curriculum
from koz_jax.task import dynamics, reward, scenario
from koz_jax.task.dynamics import RigidBodyState
from koz_jax.task.observation_layout import LAYOUT, SLICES

plt.rcParams |= {"figure.figsize": (6.8, 2.8), "axes.grid": True, "grid.alpha": 0.4}

# %% [markdown]
# Every number of the task is a setting, validated once and in degrees; `Reorientation` is the environment made of them,
# in traced arrays and radians.

# %%
task = TaskConfig()
env = Reorientation.from_config(task)
print(task.model_dump_json(indent=1, include={"spacecraft", "scenario"}))

# %% [markdown]
# ## Dynamics
# One Runge-Kutta step of order 4 for one spacecraft; batches come from `vmap`, time from `scan`. Without torque, a
# tumbling body keeps its energy and its angular momentum in inertial axes:

# %%
tumbling = RigidBodyState(q_BN=jnp.array([1.0, 0.0, 0.0, 0.0]), omega_BN_B=jnp.array([0.3, -0.2, 0.4]))


def advance(body, _):
    """One step without torque, and the state it began in."""
    return dynamics.step(body, jnp.zeros(3), env.model.inertia_B, env.model.dt), body


_, bodies = jax.lax.scan(advance, tumbling, None, length=1000)
inertia = np.asarray(env.model.inertia_B)
momentum = np.linalg.norm(bodies.omega_BN_B @ inertia, axis=1)
energy = 0.5 * np.einsum("ti,ij,tj->t", bodies.omega_BN_B, inertia, bodies.omega_BN_B)

figure, (left, right) = plt.subplots(1, 2, layout="constrained")
seconds = np.arange(1000) * task.step_seconds
left.plot(seconds, bodies.omega_BN_B, label=["x", "y", "z"])
left.set(xlabel="time [s]", ylabel="rate [rad/s]")
left.margins(y=0.2)
left.legend(loc="upper right", ncols=3)
right.plot(seconds, 1e6 * (energy / energy[0] - 1), label="energy")
right.plot(seconds, 1e6 * (momentum / momentum[0] - 1), label="angular momentum")
right.set(xlabel="time [s]", ylabel="relative drift [1e-6]")
right.legend()
plt.show()

# %% [markdown]
# ## The zone
# The paper's test scenario starts 100° from the target. The zone's axis is where the telescope would look half-way
# along the shortest rotation. The shipped `phase1` agent has never heard of zones; `phase2` has:

# %%
drawn = scenario.paper_test()
flights = {name: fly_scenario(load_agent(name), drawn) for name in ("phase1", "phase2")}
seconds = np.arange(task.episode_steps + 1) * task.step_seconds
for name, (history, _) in flights.items():
    plt.plot(seconds, np.rad2deg(history.zone_margin), label=name)
plt.axhline(0.0, color="black", linewidth=1)
plt.gca().set(xlim=(0, 40), xlabel="time [s]", ylabel="margin to the zone [°]")
plt.legend()
plt.show()

# %%
history, result = flights["phase2"]
picture = sphere.draw(history, task, "phase2 on the paper's test scenario")
display(picture)

# %% [markdown]
# ## The observation
# Sixteen numbers, declared once; everything that needs their order takes it from `SLICES`.

# %%
start = env.reset(drawn)
observed = np.asarray(env.observe(start))
for name in LAYOUT:
    print(f"{name:17}", np.array2string(observed[SLICES[name]], precision=4))

# %% [markdown]
# ## The reward, term by term
# A history holds all states, so every step can be taken again, with every term of the reward, in one `vmap`.

# %%
states = jax.tree.map(lambda leaf: leaf[:-1], history.state)
actions = history.torque_B[:-1] / env.nominal_limits.box_B
terms = jax.vmap(env.step)(states, actions).terms

figure, (upper, lower) = plt.subplots(2, 1, figsize=(6.8, 4.2), layout="constrained", sharex=True)
for name, values in vars(terms).items():
    weighted = values * getattr(reward.PAPER_WEIGHTS, name)
    axes = upper if name in ("attitude", "settled") else lower
    axes.plot(seconds[1:], weighted, label=name)
upper.set(ylabel="reward per step")
lower.set(xlim=(0, 40), xlabel="time [s]", ylabel="reward per step")
for axes in (upper, lower):
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
print(f"sum over the maneuver: {float(result.reward):.1f}")

# %% [markdown]
# ## The curriculum
# What training looks like at a step is a pure function of the step: one `vmap` plots a whole training.

# %%
config = preset("fast")
updates = jnp.arange(0, config.curriculum.updates, 200)
at = jax.vmap(functools.partial(curriculum.difficulty, config.curriculum))(updates)

figure, ((angles, zone), (effort, rate)) = plt.subplots(2, 2, figsize=(6.8, 4.2), layout="constrained", sharex=True)
angles.fill_between(updates, np.rad2deg(at.min_angle), np.rad2deg(at.max_angle), alpha=0.4)
angles.set(ylabel="deviation drawn [°]")
zone.plot(updates, at.zone_weight)
zone.set(ylabel="weight of the zone")
effort.plot(updates, at.effort_weight)
effort.set(xlabel="updates", ylabel="weight of effort")
rate.plot(updates, at.learning_rate)
rate.set(xlabel="updates", ylabel="learning rate")
for axes in figure.axes:
    axes.axvline(config.curriculum.phase1.updates, color="black", linewidth=1, linestyle="--")
