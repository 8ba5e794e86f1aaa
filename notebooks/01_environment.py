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

from koz_jax import curriculum, dynamics, env, fly_scenario, load_agent, preset, reward, scenario, task
from koz_jax.dynamics import RigidBodyState
from koz_jax.figures import sphere
from koz_jax.observation import LAYOUT, SLICES
from koz_jax.task_config import TaskConfig

plt.rcParams |= {"figure.figsize": (8, 3), "figure.dpi": 80, "axes.grid": True, "grid.alpha": 0.4}

# %% [markdown]
# Every number of the task is a setting, validated once and in degrees; `env_params` turns it into traced arrays.

# %%
task_config = TaskConfig()
params = task.env_params(task_config)
print(task_config.model_dump_json(indent=1, include={"spacecraft", "scenario"}))

# %% [markdown]
# ## Dynamics
# One Runge-Kutta step of order 4 for one spacecraft; batches come from `vmap`, time from `scan`. Without torque, a
# tumbling body keeps its energy and its angular momentum in inertial axes:

# %%
tumbling = RigidBodyState(q_BN=jnp.array([1.0, 0.0, 0.0, 0.0]), omega_BN_B=jnp.array([0.3, -0.2, 0.4]))


def advance(body, _):
    """One step without torque, and the state it began in."""
    return dynamics.step(body, jnp.zeros(3), params.spacecraft, params.dt), body


_, bodies = jax.lax.scan(advance, tumbling, None, length=1000)
inertia = np.asarray(params.spacecraft.inertia_B)
momentum = np.linalg.norm(bodies.omega_BN_B @ inertia, axis=1)
energy = 0.5 * np.einsum("ti,ij,tj->t", bodies.omega_BN_B, inertia, bodies.omega_BN_B)

figure, (left, right) = plt.subplots(1, 2, layout="constrained")
seconds = np.arange(1000) * task_config.step_seconds
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
seconds = np.arange(task_config.episode_steps + 1) * task_config.step_seconds
for name, (history, _) in flights.items():
    plt.plot(seconds, np.rad2deg(history.zone_margin), label=name)
plt.axhline(0.0, color="black", linewidth=1)
plt.gca().set(xlim=(0, 40), xlabel="time [s]", ylabel="margin to the zone [°]")
plt.legend()
plt.show()

# %%
history, result = flights["phase2"]
picture = sphere.draw(history, task_config, "phase2 on the paper's test scenario")
picture.set_dpi(70)
display(picture)

# %% [markdown]
# ## The observation
# Sixteen numbers, declared once; everything that needs their order takes it from `SLICES`.

# %%
for name in LAYOUT:
    print(f"{name:17}", np.array2string(np.asarray(history.observation[0, SLICES[name]]), precision=4))

# %% [markdown]
# ## The reward, term by term
# A history holds all states, so the outcome of every step, and from it every term of the reward, is one `vmap` away.

# %%
states = jax.tree.map(lambda leaf: leaf[:-1], history.state)
actions = history.torque_B[:-1] / params.spacecraft.torque_limit
_, outcomes = jax.vmap(env.step, in_axes=(0, 0, None))(states, actions, params)
terms = jax.vmap(reward.terms, in_axes=(0, None, None))(outcomes, params.reward, params.spacecraft.torque_limit)

figure, (upper, lower) = plt.subplots(2, 1, figsize=(8, 4.5), layout="constrained", sharex=True)
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

figure, ((angles, zone), (effort, rate)) = plt.subplots(2, 2, figsize=(8, 4.5), layout="constrained", sharex=True)
angles.fill_between(updates, np.rad2deg(at.min_angle), np.rad2deg(at.max_angle), alpha=0.4)
angles.set(ylabel="deviation drawn [°]")
zone.plot(updates, at.zone_weight)
zone.set(ylabel="weight of the zone penalty")
effort.plot(updates, at.effort_weight)
effort.set(xlabel="updates", ylabel="weight of effort")
rate.plot(updates, at.learning_rate)
rate.set(xlabel="updates", ylabel="learning rate")
for axes in figure.axes:
    axes.axvline(config.curriculum.phase1.updates, color="black", linewidth=1, linestyle="--")
