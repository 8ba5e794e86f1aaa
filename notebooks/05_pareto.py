# %% [markdown]
# # 5. Time against effort
#
# A fast turn costs torque. How much is a choice of the mission, so the agent `universal` takes it at flight time, as
# one number from 0 (thrifty) to 1 (as fast as the actuators allow). This notebook draws what it buys: the front
# between time and effort on the paper's task, beside a planner that knows everything in advance, and two limits that
# hold where no zone is in the way.

# %%
import matplotlib.pyplot as plt
import numpy as np

from koz_jax import TaskConfig, fly_case, load_agent, load_controller, monte_carlo
from koz_jax.evaluation.summary import summarise
from koz_jax.storage import runtime

runtime.configure()  # all cores; compiled programs are kept for the next time
plt.rcParams |= {"figure.figsize": (6.8, 3.6), "axes.grid": True, "grid.alpha": 0.4}

# %%
task = TaskConfig()
cases = 2_000
urgencies = np.linspace(0.0, 1.0, 9)
universal = load_agent("universal")
flown = [monte_carlo(universal.with_urgency(float(urgency)), cases=cases, task=task) for urgency in urgencies]
front = [summarise(one.results) for one in flown]
planner = summarise(monte_carlo(load_controller("planner", task), cases=200).results)

# %%
print("urgency  success  settling [s]  effort [N² m² s]")
for urgency, mean in zip(urgencies, front, strict=True):
    print(f"{urgency:7.3f} {mean.success_rate:8.2%} {mean.settling_time_mean:13.2f} {mean.control_effort_mean:17.1f}")

# %% [markdown]
# ## Two limits
# Of a turn by an angle $\theta$ about its eigen-axis $e$, with no zone in the way:
#
# - **bang-bang**: the torque $I e \, \ddot\theta$ has to stay in the box, so half of the turn at the largest
#   acceleration $a$ and half at $-a$ take $2 \sqrt{\theta / a}$;
# - **least energy**: among all turns that take $T$, the one with an acceleration that falls linearly from
#   $6 \theta / T^2$ to $-6 \theta / T^2$ has the smallest $\int |\tau|^2 dt = 12\, |I e|^2 \theta^2 / T^3$.
#
# Both are means over the same cases as above.

# %%
inertia, limit = np.array(task.spacecraft.inertia), task.spacecraft.torque_limits
starts = [fly_case(universal, number, flown[0].config, task)[0].attitude_error[0] for number in range(50)]
axes = np.array([q[1:] / np.linalg.norm(q[1:]) for q in starts])
angles = np.array([2.0 * np.arctan2(np.linalg.norm(q[1:]), abs(q[0])) for q in starts])
moments = axes @ inertia

fastest = np.mean(2.0 * np.sqrt(angles / np.min(np.array(limit) / np.abs(moments), axis=1)))
times = np.linspace(fastest, 34.0, 60)
least_energy = np.mean(12.0 * np.sum(moments**2, axis=1) * angles**2) / times**3

# %%
figure, axis = plt.subplots(layout="constrained")
settling = [mean.settling_time_mean for mean in front]
effort = [mean.control_effort_mean for mean in front]
axis.plot(settling, effort, "o-", label="universal, urgency 0 to 1")
axis.plot(planner.settling_time_mean, planner.control_effort_mean, "s", label="planner")
axis.plot(27.8, 76.0, "x", color="black", label="paper's agent")
axis.plot(times, least_energy, "--", color="gray", label="least energy, no zone")
axis.axvline(fastest, color="gray", linestyle=":", label="bang-bang about one axis, no zone")
axis.set(xlabel="settling time [s]", ylabel="control effort [N² m² s]", ylim=(0.0, 140.0), xlim=(10.0, 34.0))
axis.legend()
plt.show()

# %% [markdown]
# What lies between the agent's front and the dashed line is the price of the zone, of feedback instead of a plan, and
# of a settling time that counts until the pointing error stays below a quarter of a degree. From the command line:
# `koz evaluate --agent universal --urgency 0.8`, `koz fly examples/cubesat_6u.toml --urgency 0.2`.
