"""``koz tune``: tune the gains of a classical controller.

Random search over the logarithms of the gains, with a spread that shrinks from round to round.  Every candidate flies
the same cases, drawn with a seed that is not the one controllers are judged with.  The score is the mean of the paper's
reward, to which a case that enters the zone adds nothing: by the reward alone it pays to cut through.

What is flown is the paper's task.  Gains are in units of T = sqrt(J / u) and of radians, so that what is found there is
for every spacecraft of such a shape; ``control/feedback.py`` says what long time steps make of them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Self

from pydantic import Field, PositiveFloat, PositiveInt, model_validator
from tyro.conf import Positional

from koz_jax.cli import invocation
from koz_jax.cli.exit_status import exit_status
from koz_jax.cli.flags import parsing
from koz_jax.config.base import CaseCount, Settings
from koz_jax.config.monte_carlo import MonteCarloConfig
from koz_jax.control.registry import CLASSICAL, load_controller

if TYPE_CHECKING:
    import jax

    from koz_jax.control.base import Controller
    from koz_jax.control.registry import NamedController
    from koz_jax.task.scenario import Scenario


class TuneFlags(Settings):
    """Tune the gains of a classical controller for the mean of the paper's reward, without violations.

    For pd, which does not know it, the zone does not count.
    """

    name: Positional[str] = Field(description=f"Which controller: {', '.join(CLASSICAL)}.")
    cases: CaseCount = 200
    """Cases that every candidate flies."""
    candidates: PositiveInt = 32
    """Candidates of a round."""
    rounds: PositiveInt = 12
    """Rounds."""
    seed: int = 1
    """Seed of the cases and of the search; not 0, which is what controllers are judged with."""
    spread: PositiveFloat = 0.7
    """Standard deviation of the logarithm of each gain in the first round; a tenth of it in the last."""

    @model_validator(mode="after")
    def _can_be(self) -> Self:
        if self.name not in CLASSICAL:
            raise ValueError(f"name: must be one of {', '.join(CLASSICAL)}; got {self.name!r}")
        judged = MonteCarloConfig().seed
        if not judged < self.seed < 2**32:
            raise ValueError(f"seed: must be from 1 to 2^32 - 1, as {judged} draws the test; got {self.seed}")
        return self

    def config(self) -> MonteCarloConfig:
        """Which cases are flown."""
        return MonteCarloConfig(cases=self.cases, seed=self.seed)


def main(argv: Sequence[str]) -> int:
    """Tune and print.  Returns the exit status."""
    return exit_status(lambda: _tune(parsing.parse(TuneFlags, argv, invocation.command("tune"))))


def _tune(asked: TuneFlags) -> int:
    from koz_jax.storage import runtime

    runtime.configure()
    named = load_controller(asked.name)
    print_table(named, asked, "before")
    best = named.controller
    for round_, (found, score) in enumerate(search(named, asked), start=1):
        best = found
        print(f"round {round_}: {score:.2f}  {describe(best)}", flush=True)
    print_table(dataclasses.replace(named, controller=best), asked, "after")
    for name, value in gains(best).items():
        print(f"{name} = {value:.4g}")
    return 0


def search(named: NamedController, asked: TuneFlags) -> Iterator[tuple[Controller, float]]:
    """Search round by round.  Yields the best gains so far and their score."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.flatten_util import ravel_pytree

    score = _scorer(named, asked)
    best, unflatten = ravel_pytree(jax.tree.map(jnp.float32, named.controller))
    random = np.random.default_rng(asked.seed)
    for spread in np.geomspace(asked.spread, 0.1 * asked.spread, asked.rounds):
        factors = np.exp(spread * random.standard_normal((asked.candidates, best.size)))
        factors[0] = 1.0
        candidates = best * jnp.asarray(factors, jnp.float32)
        scores = score(jax.vmap(unflatten)(candidates))
        best = candidates[jnp.argmax(scores)]
        yield unflatten(best), float(jnp.max(scores))


def _scorer(named: NamedController, asked: TuneFlags) -> Callable[[Controller], jax.Array]:
    """Make the function from stacked controllers to their scores (candidates,)."""
    import jax
    import jax.numpy as jnp

    from koz_jax.evaluation import cases, rollout
    from koz_jax.task import reward

    env = cases.environment(named.task, asked.config())
    drawn = jax.vmap(functools.partial(cases.draw_case, named.task, asked.config()))(jnp.arange(asked.cases))
    keys = jax.random.split(jax.random.key(asked.seed), asked.cases)
    blind = asked.name == "pd"
    weights = reward.PAPER_WEIGHTS.replace(zone=0.0) if blind else reward.PAPER_WEIGHTS

    def score(controller: Controller) -> jax.Array:
        def one(case: Scenario, key: jax.Array) -> jax.Array:
            result = rollout.run_case(env, controller, case, key=key)
            earned = reward.total(result.reward_terms, weights)
            return earned if blind else jnp.where(result.violated, jnp.minimum(earned, 0.0), earned)

        scores = jnp.mean(jax.vmap(one)(drawn, keys))
        return jnp.where(jnp.isfinite(scores), scores, -jnp.inf)

    return jax.jit(functools.partial(jax.lax.map, score))


def gains(controller: Controller) -> dict[str, float]:
    """Gains of a controller by name."""
    fields = dataclasses.fields(controller)  # pyright: ignore[reportArgumentType]
    return {field.name: float(getattr(controller, field.name)) for field in fields if _is_gain(field)}


def _is_gain(field: dataclasses.Field[Any]) -> bool:
    return field.metadata.get("pytree_node", True)


def describe(controller: Controller) -> str:
    """Gains in a line."""
    return "  ".join(f"{name} {value:.4g}" for name, value in gains(controller).items())


def print_table(named: NamedController, asked: TuneFlags, label: str) -> None:
    """Fly the cases that are tuned on, and print the paper's table."""
    from koz_jax.evaluation import monte_carlo
    from koz_jax.evaluation.summary import table

    flown = monte_carlo.run_cases(named, named.task, asked.config())
    print(f"\n{label}: {describe(named.controller)}")
    print(table(flown, name=asked.name), flush=True)
