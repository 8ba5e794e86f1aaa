"""Tune a classical controller: ``python -m koz_jax.controllers.tune NAME``.

Random search over the logarithms of the gains, with a spread that shrinks from round to round.  Every candidate flies
the same cases, drawn with a seed that is not the one controllers are judged with.  The score is the mean of the paper's
reward, to which a case that enters the zone adds nothing: by the reward alone it pays to cut through.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import tyro

from koz_jax.controllers.registry import CLASSICAL, load_controller
from koz_jax.errors import UserError, exit_status

if TYPE_CHECKING:
    import jax

    from koz_jax.controllers.base import Controller
    from koz_jax.controllers.registry import NamedController
    from koz_jax.evaluation import MonteCarloConfig
    from koz_jax.scenario import Scenario

# Seed of ``eval_mc.py``.
_TEST_SEED = 0


@dataclasses.dataclass(frozen=True)
class TuneArgs:
    """Tune the gains of a classical controller for the mean of the paper's reward, without violations.

    For pd, which does not know it, the zone does not count.
    """

    name: tyro.conf.Positional[str]
    """Which controller: pd, potential, sliding or planner."""
    cases: int = 200
    """Cases that every candidate flies."""
    candidates: int = 32
    """Candidates of a round."""
    rounds: int = 12
    """Rounds."""
    seed: int = 1
    """Seed of the cases and of the search; not 0, which is what controllers are judged with."""
    spread: float = 0.7
    """Standard deviation of the logarithm of each gain in the first round; a tenth of it in the last."""


def main(argv: list[str]) -> int:
    """Tune and print.  Returns the exit status."""
    return exit_status(lambda: _tune(tyro.cli(TuneArgs, args=argv, prog="python -m koz_jax.controllers.tune")))


def _tune(args: TuneArgs) -> int:
    _check(args)
    from koz_jax import runtime

    runtime.configure()
    pilot = load_controller(args.name)
    print_table(pilot, args, "before")
    best = pilot.controller
    for round_, (found, score) in enumerate(search(pilot, args), start=1):
        best = found
        print(f"round {round_}: {score:.2f}  {describe(best)}", flush=True)
    print_table(dataclasses.replace(pilot, controller=best), args, "after")
    for name, value in gains(best).items():
        print(f"{name} = {value:.4g}")
    return 0


def _check(args: TuneArgs) -> None:
    if args.name not in CLASSICAL:
        raise UserError(f"name: must be one of {', '.join(CLASSICAL)}; got {args.name!r}")
    if not 0 < args.seed < 2**32:
        raise UserError(f"seed: must be from 1 to 2^32 - 1, as {_TEST_SEED} draws the test; got {args.seed}")
    for field in ("cases", "candidates", "rounds"):
        if getattr(args, field) < 1:
            raise UserError(f"{field}: must be at least 1, got {getattr(args, field)}")
    if not args.spread > 0.0:
        raise UserError(f"spread: must be above 0, got {args.spread}")


def search(pilot: NamedController, args: TuneArgs) -> Iterator[tuple[Controller, float]]:
    """Search round by round.  Yields the best gains so far and their score."""
    import jax
    import jax.numpy as jnp
    import numpy as np
    from jax.flatten_util import ravel_pytree

    score = _scorer(pilot, args)
    best, unflatten = ravel_pytree(jax.tree.map(jnp.float32, pilot.controller))
    random = np.random.default_rng(args.seed)
    for spread in np.geomspace(args.spread, 0.1 * args.spread, args.rounds):
        factors = np.exp(spread * random.standard_normal((args.candidates, best.size)))
        factors[0] = 1.0
        candidates = best * jnp.asarray(factors, jnp.float32)
        scores = score(jax.vmap(unflatten)(candidates))
        best = candidates[jnp.argmax(scores)]
        yield unflatten(best), float(jnp.max(scores))


def _scorer(pilot: NamedController, args: TuneArgs) -> Callable[[Controller], jax.Array]:
    """Make the function from stacked controllers to their scores (candidates,)."""
    import jax
    import jax.numpy as jnp

    from koz_jax import evaluation, reward, rollout, task

    params = task.env_params(pilot.task)
    draw = functools.partial(evaluation.draw_case, pilot.task, monte_carlo(args))
    cases = jax.vmap(draw)(jnp.arange(args.cases))
    keys = jax.random.split(jax.random.key(args.seed), args.cases)
    blind = args.name == "pd"
    weights = reward.PAPER_WEIGHTS.replace(zone=0.0) if blind else reward.PAPER_WEIGHTS

    def score(controller: Controller) -> jax.Array:
        def one(case: Scenario, key: jax.Array) -> jax.Array:
            result = rollout.run_case(controller, case, params, pilot.task.episode_steps, key=key)
            earned = reward.total(result.reward_terms, weights)
            return earned if blind else jnp.where(result.violated, jnp.minimum(earned, 0.0), earned)

        scores = jnp.mean(jax.vmap(one)(cases, keys))
        return jnp.where(jnp.isfinite(scores), scores, -jnp.inf)

    return jax.jit(functools.partial(jax.lax.map, score))


def monte_carlo(args: TuneArgs) -> MonteCarloConfig:
    """Which cases are flown."""
    from koz_jax.evaluation import MonteCarloConfig

    return MonteCarloConfig(args.cases, args.seed)


def gains(controller: Controller) -> dict[str, float]:
    """Gains of a controller by name."""
    fields = dataclasses.fields(controller)  # pyright: ignore[reportArgumentType]
    return {field.name: float(getattr(controller, field.name)) for field in fields if _is_gain(field)}


def _is_gain(field: dataclasses.Field[Any]) -> bool:
    return field.metadata.get("pytree_node", True)


def describe(controller: Controller) -> str:
    """Gains in a line."""
    return "  ".join(f"{name} {value:.4g}" for name, value in gains(controller).items())


def print_table(pilot: NamedController, args: TuneArgs, label: str) -> None:
    """Fly the cases that are tuned on, and print the paper's table."""
    from koz_jax import evaluation
    from koz_jax.summary import summarise, table

    flown = evaluation.run_cases(pilot, pilot.task, monte_carlo(args))
    print(f"\n{label}: {describe(pilot.controller)}")
    print(table(summarise(flown.results), args.cases, args.name), flush=True)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
