"""Free runs choose between solutions of a closed-form fit: by themselves."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch

from residnet.baselines.regressors import RegressorsConfig
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ZeroHead
from residnet.identification.fitter import choose_solution
from residnet.physics.signals import SignalsConfig
from residnet.regression.estimator import Solution
from residnet.training.score import Score


def model() -> HybridDynamics:
    signals = SignalsConfig(inputs=("n", "delta")).build()
    return HybridDynamics(
        signals, RegressorsConfig(terms=("u",)).build(signals.names), ZeroHead(), 0.1
    )


def at(value: float, *, alone: bool = True) -> Solution:
    """A solution of coefficients all alike; it has neighbours one apart where it is not alone."""
    return Solution(
        {"value": value},
        {"theta": torch.full((3, 1), value, dtype=torch.float64)},
        neighbours=None
        if alone
        else lambda: [at(value - 1.0, alone=False), at(value + 1.0, alone=False)],
    )


def chosen(
    bench: Callable[[float], Score], *solutions: Solution
) -> tuple[float, list[dict[str, Any]]]:
    """The value that is chosen, which the model then has, and what was tried."""
    own = model()
    theta: Any = own.baseline.theta

    def score(candidate: HybridDynamics) -> Score:
        assert candidate is own
        return bench(float(theta[0, 0]))

    best, notes = choose_solution(own, own.baseline, solutions, score)
    assert theta.flatten().tolist() == [best.choice["value"]] * 3
    return best.choice["value"], notes.get("free_run_choice", [])


def test_the_best_free_run_is_kept() -> None:
    best, tried = chosen(lambda value: Score(0, abs(value - 2.2)), at(5.0), at(2.0), at(1.0))
    assert best == 2.0
    assert [(one["value"], pytest.approx(one["validation"])) for one in tried] == [
        (5.0, 2.8),
        (2.0, 0.2),
        (1.0, 1.2),
    ]


def test_a_single_solution_is_taken_without_a_free_run() -> None:
    def never(value: float) -> Score:
        raise AssertionError("nothing to choose")

    assert chosen(never, at(3.0)) == (3.0, [])


def test_what_lies_around_the_best_is_tried_while_it_gains() -> None:
    best, tried = chosen(
        lambda value: Score(0, abs(value - 4.2)), at(0.0, alone=False), at(2.0, alone=False)
    )
    assert best == 4.0
    # each once, up to the first neighbours that do not gain
    assert [one["value"] for one in tried] == [0.0, 2.0, 1.0, 3.0, 4.0, 5.0]


def test_what_stands_alone_does_not_end_the_search() -> None:
    """No residual at all may beat every shared setting, and yet lose to what lies around the best
    of them.
    """
    best, tried = chosen(
        lambda value: Score(0, 2.5 if value == 0.0 else abs(value - 7.2)),
        at(4.0, alone=False),
        at(3.0, alone=False),
        at(0.0),
    )
    assert tried[2]["validation"] == 2.5 < tried[0]["validation"]
    assert best == 7.0


def test_a_diverging_solution_never_beats_a_steady_one() -> None:
    scores = {5.0: Score(1, 0.1), 2.0: Score(0, 0.9), 1.0: Score(0, 0.8)}
    best, tried = chosen(scores.__getitem__, at(5.0), at(2.0), at(1.0))
    assert best == 1.0
    assert [one["diverged"] for one in tried] == [1, 0, 0]
