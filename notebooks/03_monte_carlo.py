# %% [markdown]
# # 3. Monte Carlo
#
# Ten thousand random maneuvers in one call, the paper's table beside ours, and a closer look at those that went wrong.

# %%
# %matplotlib inline
from pathlib import Path

import jax
import matplotlib.pyplot as plt
import numpy as np
from IPython.display import display

from koz_jax import fly_case, load_agent, monte_carlo, table
from koz_jax.evaluation.cases import draw_case
from koz_jax.evaluation.tables import describe_case
from koz_jax.figures import monte_carlo as figures
from koz_jax.figures import sphere
from koz_jax.storage import runtime
from koz_jax.viewer.maneuver import fly
from koz_jax.viewer.page import write_page

runtime.configure()  # all cores; compiled programs are kept for the next time
plt.rcParams |= {"figure.figsize": (6.8, 2.8), "axes.grid": True, "grid.alpha": 0.4}

# %%
agent = load_agent("phase2")
flown = monte_carlo(agent, cases=10_000)
print(table(flown))
print(f"compiled in {flown.compile_s:.1f} s, flown in {flown.wall_s:.1f} s")

# %% [markdown]
# ## All cases at a glance
# `koz evaluate --figures DIR` writes this figure of the paper, and the others, for print.

# %%
results = flown.results
picture = figures.draw_samples(figures.points(results, agent.task))
display(picture)

# %% [markdown]
# ## The failures

# %%
failed = np.flatnonzero(~results.success)
print(f"{len(failed)} of {flown.config.cases} cases failed")
for case in failed[:10]:
    print(describe_case(case, jax.tree.map(lambda leaf, at=case: leaf[at], results)))

# %% [markdown]
# ## The worst cases, flown again
# A case is its index: case 17 of a seed is the same alone, in a chunk, or among a million. So the worst ones can be
# flown again one by one, with their whole history. Worst are those that came closest to the zone, or went furthest
# into it.

# %%
worst = np.argsort(results.min_margin)[:3]
for case in worst:
    history, result = fly_case(agent, int(case), flown.config)
    print(describe_case(case, result))
    seconds = np.arange(len(history.zone_margin)) * agent.task.step_seconds
    plt.plot(seconds, np.rad2deg(history.zone_margin), label=f"case {case}")
plt.axhline(0.0, color="black", linewidth=1)
plt.gca().set(xlim=(0, 40), xlabel="time [s]", ylabel="margin to the zone [°]")
plt.legend()
plt.show()

# %%
history, _ = fly_case(agent, int(worst[0]), flown.config)
picture = sphere.draw(history, agent.task, f"case {worst[0]}")
display(picture)

# %% [markdown]
# ## In 3-D
# The same case as an interactive page, beside the agent that knows no zone: one file, which opens in a browser without
# any network. `koz view --case N` writes the same.

# %%
drawn = draw_case(agent.task, flown.config, int(worst[0]))
maneuvers = [fly(load_agent("phase1"), drawn), fly(agent, drawn)]
page = Path("runs", "worst.html")
write_page(page, maneuvers, f"Case {worst[0]}, the worst of {flown.config.cases}")
print(f"{page}: {page.stat().st_size / 1e6:.1f} MB")
