# %% [markdown]
# # 2. Training
#
# An agent learns the maneuver in two or three minutes on two CPU cores: first turning (phase 1), then turning around
# the zone (phase 2), then a polish by gradients through the dynamics. `koz train` does the same with more of
# everything.

# %%
# %matplotlib inline
import os
from pathlib import Path

import numpy as np
from IPython.display import display

from koz_jax import TrainConfig, fly_scenario, monte_carlo, preset, summarise, table, train
from koz_jax.figures import learning, sphere
from koz_jax.storage import runtime
from koz_jax.task import scenario

runtime.configure()  # all cores; compiled programs are kept for the next time
small = os.environ.get("KOZ_JAX_BUDGET") == "small"

# %% [markdown]
# ## Settings
# A preset is a validated, immutable object: `short` takes two minutes, `fast` five, and `thorough` makes the shipped
# agents. To change one, change its content and validate again.

# %%
short = preset("smoke" if small else "short")
config = TrainConfig.model_validate(short.model_dump() | {"seed": 0})

# A setting that makes no sense is named, before any computing.
try:
    TrainConfig.model_validate(config.model_dump() | {"eval_min_angle_deg": 170.0, "eval_max_angle_deg": 120.0})
except ValueError as error:
    print(error.errors()[0]["msg"])  # pyright: ignore[reportAttributeAccessIssue]

# %% [markdown]
# ## Train
# The run folder keeps the settings, the curves, a checkpoint to go on from, and the best agent of each phase.

# %%
run = Path("runs", "notebook")
agent = train(config, run, progress=False)
assert agent is not None
print(*sorted(str(path.relative_to(run)) for path in run.glob("*")), sep="\n")

# %% [markdown]
# ## Watch it learn
# `metrics.csv` has a row per logged chunk. `koz curves RUN [RUN ...]` draws the same figure of one or several runs.

# %%
picture = learning.draw(learning.curves([learning.read_metrics(run)]))
picture.set_dpi(70)
display(picture)

# %% [markdown]
# In so short a training the polish loses more than it gains: it presses for little effort before the way around the
# zone is sure. The run keeps the agent with the best score, here the one before the polish.
#
# ## Evaluate

# %%
cases = 500 if small else 5_000
flown = monte_carlo(agent, cases=cases)
print(table(summarise(flown.results), cases, "this agent"))

# %% [markdown]
# And the paper's test scenario:

# %%
history, result = fly_scenario(agent, scenario.paper_test())
print(f"settled: {bool(result.settled)}, smallest margin: {np.rad2deg(float(result.min_margin)):.2f}°")
picture = sphere.draw(history, config.task, "the paper's test scenario")
picture.set_dpi(70)
display(picture)
