# %% [markdown]
# # 2. Training
#
# An agent learns the maneuver in some minutes on a CPU core: first turning (phase 1), then turning around
# the zone (phase 2), then a polish by gradients through the dynamics. `koz train` does the same with more of
# everything.

# %%
# %matplotlib inline
from pathlib import Path

import numpy as np
from IPython.display import display
from pydantic import ValidationError

from koz_jax import TrainConfig, fly_scenario, load_agent, monte_carlo, preset, table, train
from koz_jax.figures import learning, sphere
from koz_jax.storage import runtime
from koz_jax.task import scenario

runtime.configure()  # all cores; compiled programs are kept for the next time

# %% [markdown]
# ## Settings
# A preset is a validated, immutable object: `short` takes three quarters of the time of `fast`, and `thorough` makes
# the shipped agents. To change one, change its content and validate again.

# %%
short = preset("short")
config = TrainConfig.model_validate(short.model_dump() | {"seed": 0})

# A setting that makes no sense is named, before any computing.
try:
    TrainConfig.model_validate(config.model_dump() | {"eval_min_angle_deg": 170.0, "eval_max_angle_deg": 120.0})
except ValidationError as error:
    print(error.errors()[0]["msg"])

# %% [markdown]
# ## Train
# The run folder keeps the settings, the curves, a checkpoint to go on from, and the best agent of each phase.

# %%
run = Path("runs", "notebook")
train(config, run, progress=False)
agent = load_agent(run)
print(*sorted(str(path.relative_to(run)) for path in run.glob("*")), sep="\n")

# %% [markdown]
# ## Watch it learn
# `metrics.csv` has a row per logged chunk. `koz curves RUN [RUN ...]` draws the same figure of one or several runs.

# %%
picture = learning.draw(learning.read_curves([run]))
display(picture)

# %% [markdown]
# The polish comes last: by the gradient of what whole maneuvers cost it halves the settling time of the agent that Soft
# Actor-Critic has found. The run keeps the agent with the best score.
#
# ## Evaluate

# %%
flown = monte_carlo(agent, cases=5_000)
print(table(flown, name="this agent"))

# %% [markdown]
# And the paper's test scenario:

# %%
history, result = fly_scenario(agent, scenario.paper_test())
print(f"settled: {bool(result.settled)}, smallest margin: {np.rad2deg(float(result.min_margin)):.2f}°")
picture = sphere.draw(history, config.task, "the paper's test scenario")
display(picture)
