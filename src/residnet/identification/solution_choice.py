"""Choosing between solutions of a closed-form fit by their free runs on validation data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import nn

from residnet.dynamics.hybrid import HybridDynamics
from residnet.regression.solutions import Solution
from residnet.training.module import Score


def choose_solution(
    model: HybridDynamics,
    part: nn.Module,
    solutions: Sequence[Solution],
    score: Callable[[HybridDynamics], Score],
) -> tuple[Solution, dict[str, Any]]:
    """Fill a part of the model with the solution whose free run is best.

    What lies around the best is tried for as long as it gains.

    Args:
        model: the model that runs.
        part: its baseline or head, which the solutions belong to.
        solutions: at least one; a single one is taken as it is.
        score: of a model's free runs on validation data; fewer divergences come before less error.

    Returns:
        The solution, and for fit.json the free-run error of each; empty where there was nothing to
        choose.
    """
    tried: list[tuple[Solution, Score]] = []

    def attempt(batch: Sequence[Solution]) -> None:
        for solution in batch:
            part.load_state_dict(solution.state, strict=False)
            tried.append((solution, score(model)))

    attempt(solutions if len(solutions) > 1 else ())
    centre = _best_with_neighbours(tried)
    while centre is not None and centre[0].neighbours is not None:
        choices = [solution.choice for solution, _ in tried]
        attempt([solution for solution in centre[0].neighbours() if solution.choice not in choices])
        better = _best_with_neighbours(tried)
        if better is centre:
            break
        centre = better
    best = min(tried, key=_score)[0] if tried else solutions[0]
    part.load_state_dict(best.state, strict=False)
    scores = [
        {**solution.choice, "validation": found.error, "diverged": found.diverged}
        for solution, found in tried
    ]
    return best, {"free_run_choice": scores} if scores else {}


def _score(tried: tuple[Solution, Score]) -> Score:
    return tried[1]


def _best_with_neighbours(
    tried: Sequence[tuple[Solution, Score]],
) -> tuple[Solution, Score] | None:
    """The best of those that have neighbours; one that has none, such as no residual at all, does
    not end the search.
    """
    return min((pair for pair in tried if pair[0].neighbours is not None), key=_score, default=None)
