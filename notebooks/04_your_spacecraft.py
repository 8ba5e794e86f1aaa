# %% [markdown]
# # 4. Your spacecraft
#
# Another body, weaker actuators, a telescope that points elsewhere, larger zones: everything about the task is a
# setting. This notebook makes a small satellite of its own, flies it at once with the shipped agent for any spacecraft,
# as fast and as thriftily as one likes, and then trains an agent for it alone.

# %%
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display
from pydantic import ValidationError

from koz_jax import TaskConfig, fly_case, load_agent, monte_carlo, preset, table, train
from koz_jax.config.presets.spacecraft import for_spacecraft
from koz_jax.figures import sphere
from koz_jax.storage import runtime

runtime.configure()  # all cores; compiled programs are kept for the next time
plt.rcParams |= {"figure.figsize": (6.8, 2.8), "axes.grid": True, "grid.alpha": 0.4}

# %%
mine = TaskConfig.model_validate(
    {
        "spacecraft": {
            "inertia": ((7.0, 0.3, 0.0), (0.3, 4.0, 0.2), (0.0, 0.2, 6.0)),  # kg m^2
            "torque_limit": 0.15,  # N m per axis
            "boresight": (0.0, 0.6, 0.8),
        },
        "scenario": {"min_half_angle_deg": 20.0, "max_half_angle_deg": 35.0},
    }
)

# %% [markdown]
# What cannot be is refused, with the reason:

# %%
try:
    TaskConfig.model_validate({"spacecraft": {"inertia": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 5.0))}})
except ValidationError as error:
    print(error.errors()[0]["msg"])

# %% [markdown]
# ## Without training
# The agent `universal` flies any spacecraft. `with_urgency` trades effort for time, from 0 to 1:

# %%
cases = 2_000
universal = load_agent("universal")
for urgency in (0.0, 0.5, 1.0):
    hurried = monte_carlo(universal.with_urgency(urgency), cases=500, task=mine)
    print(table(hurried, name=f"urgency {urgency}").splitlines()[3:5])

# %%
before = monte_carlo(universal, cases=cases, task=mine)
print(table(before, name="universal"))

# %% [markdown]
# ## One of its own
# The default training, in units of this spacecraft, as `koz train --spacecraft FILE` makes it. Such an agent must be
# trained again for every change of the spacecraft.

# %%
config = for_spacecraft(preset("fast"), mine)
run = Path("runs", "my-spacecraft")
train(config, run, progress=False)
agent = load_agent(run)

# %%
after = monte_carlo(agent, cases=cases)
print(table(after, name="my agent"))

# %% [markdown]
# `preset("thorough")` trains longer, `preset("universal")` for all spacecraft. What is left of cases that look into a
# zone is what the shield is for: `monte_carlo(agent, task=mine, shield=ShieldConfig())`.

# %%
figure, (left, right) = plt.subplots(1, 2, layout="constrained")
for name, flown in {"universal": before, "my agent": after}.items():
    left.hist(np.rad2deg(flown.results.min_margin), bins=np.arange(-40, 41, 2), histtype="step", label=name)
    right.hist(flown.results.settling_time, bins=np.arange(0, 101, 2.5), histtype="step", label=name)
left.set(xlabel="smallest margin [°]", ylabel="cases")
right.set(xlabel="settling time [s]")
left.legend()
right.legend()
plt.show()

# %%
history, _ = fly_case(agent, 0, after.config)
picture = sphere.draw(history, mine, "case 0, my agent")
display(picture)

# %% [markdown]
# `agent.save("my-agent")` keeps it as a folder; `load_agent("my-agent")`, `koz evaluate --agent my-agent` and
# `koz view --agent my-agent` take it from there.
