"""Choosing between solutions of a closed-form fit by their free runs on validation data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from torch import nn

from residnet.core.solutions import Solution
from residnet.dynamics.hybrid import HybridDynamics


def choose(
    model: HybridDynamics, part: nn.Module, solutions: Sequence[Solution], bench: Callable[[HybridDynamics], float]
) -> tuple[Solution, dict[str, Any]]:
    """Fill a part of the model with the solution whose free run is best.

    Args:
        model: the model that runs.
        part: its baseline or head, which the solutions belong to.
        solutions: at least one; a single one is taken as it is.
        bench: error of a model's free runs on validation data.

    Returns:
        The solution, and for fit.json the free-run error of each; empty where there was nothing to choose.
    """
    errors = []
    for solution in solutions if len(solutions) > 1 else ():
        part.load_state_dict(solution.state, strict=False)
        errors.append(bench(model))
    best = min(range(len(errors)), key=errors.__getitem__, default=0)
    part.load_state_dict(solutions[best].state, strict=False)
    tried = [{**solution.choice, "validation": error} for solution, error in zip(solutions, errors, strict=False)]
    return solutions[best], {"free_run_choice": tried} if tried else {}
