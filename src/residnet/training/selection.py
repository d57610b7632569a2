"""Selection of the hyperparameters of a closed-form part by free runs on validation data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from operator import itemgetter
from typing import Any

from torch import nn

from residnet.dynamics.hybrid import HybridDynamics
from residnet.regression.estimator import Solution
from residnet.training.score import Score


def select_by_free_run(
    model: HybridDynamics,
    module: nn.Module,
    solutions: Sequence[Solution],
    score_model: Callable[[HybridDynamics], Score],
) -> tuple[Solution, dict[str, Any]]:
    """Set a part of the model to the solution with the best free run.

    Neighbours of the best solution are evaluated as long as the error decreases.

    Args:
        model: model with the part.
        module: baseline or head that the solutions belong to.
        solutions: candidates; a single one is used without evaluation.
        score_model: free-run score on validation data; fewer divergences precede a smaller error.

    Returns:
        The solution, and the free-run error of each for fit.json; empty for a single solution.
    """
    scored_solutions: list[tuple[Solution, Score]] = []

    def attempt(new_solutions: Sequence[Solution]) -> None:
        for solution in new_solutions:
            module.load_state_dict(solution.state, strict=False)
            scored_solutions.append((solution, score_model(model)))

    attempt(solutions if len(solutions) > 1 else ())
    # local search in the hyperparameters, around the best solution so far
    search_centre = _find_best_with_neighbours(scored_solutions)
    while search_centre is not None and search_centre[0].neighbours is not None:
        tried_choices = [solution.hyperparameters for solution, _ in scored_solutions]
        attempt(
            [
                solution
                for solution in search_centre[0].neighbours()
                if solution.hyperparameters not in tried_choices
            ]
        )
        new_centre = _find_best_with_neighbours(scored_solutions)
        if new_centre is search_centre:
            break
        search_centre = new_centre
    best_solution = (
        min(scored_solutions, key=itemgetter(1))[0] if scored_solutions else solutions[0]
    )
    module.load_state_dict(best_solution.state, strict=False)
    choice_records = [
        {
            **solution.hyperparameters,
            "validation": solution_score.error,
            "diverged": solution_score.diverged,
        }
        for solution, solution_score in scored_solutions
    ]
    return best_solution, {"free_run_choice": choice_records} if choice_records else {}


def _find_best_with_neighbours(
    scored_solutions: Sequence[tuple[Solution, Score]],
) -> tuple[Solution, Score] | None:
    """Return the best of the solutions with neighbours.

    A solution without neighbours, such as a zero residual, does not end the search.
    """
    return min(
        (
            scored_solution
            for scored_solution in scored_solutions
            if scored_solution[0].neighbours is not None
        ),
        key=itemgetter(1),
        default=None,
    )
