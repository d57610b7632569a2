"""Free runs choose between solutions of a closed-form fit: by themselves."""

from __future__ import annotations

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


def solutions(*values: float) -> list[Solution]:
    return [
        Solution({"value": value}, {"theta": torch.full((3, 1), value, dtype=torch.float64)})
        for value in values
    ]


def test_the_best_free_run_is_kept() -> None:
    own = model()

    def bench(candidate: HybridDynamics) -> Score:
        theta: Any = candidate.baseline.theta
        return Score(0, abs(float(theta[0, 0]) - 2.2))

    best, notes = choose_solution(own, own.baseline, solutions(5.0, 2.0, 1.0), bench)
    assert best.choice == {"value": 2.0}
    assert bench(own).error == pytest.approx(0.2)
    assert [
        (entry["value"], pytest.approx(entry["validation"])) for entry in notes["free_run_choice"]
    ] == [(5.0, 2.8), (2.0, 0.2), (1.0, 1.2)]


def test_a_single_solution_is_taken_without_a_free_run() -> None:
    own = model()

    def never(candidate: HybridDynamics) -> Score:
        raise AssertionError("nothing to choose")

    best, notes = choose_solution(own, own.baseline, solutions(3.0), never)
    assert best.choice == {"value": 3.0}
    assert notes == {}
    assert own.baseline.theta.flatten().tolist() == [3.0] * 3  # type: ignore[union-attr, operator]


def test_what_lies_around_the_best_is_tried_while_it_gains() -> None:
    own = model()

    def at(value: float) -> Solution:
        theta = torch.full((3, 1), value, dtype=torch.float64)
        return Solution(
            {"value": value},
            {"theta": theta},
            neighbours=lambda: [at(value - 1.0), at(value + 1.0)],
        )

    def bench(candidate: HybridDynamics) -> Score:
        theta: Any = candidate.baseline.theta
        return Score(0, abs(float(theta[0, 0]) - 4.2))

    best, notes = choose_solution(own, own.baseline, [at(0.0), at(2.0)], bench)
    assert best.choice == {"value": 4.0}
    assert bench(own).error == pytest.approx(0.2)
    # each once, up to the first neighbours that do not gain
    assert [entry["value"] for entry in notes["free_run_choice"]] == [0.0, 2.0, 1.0, 3.0, 4.0, 5.0]


def test_what_stands_alone_does_not_end_the_search() -> None:
    """No residual at all may beat every shared setting, and yet lose to what lies around the best
    of them.
    """
    own = model()

    def at(value: float) -> Solution:
        theta = torch.full((3, 1), value, dtype=torch.float64)
        return Solution(
            {"value": value},
            {"theta": theta},
            neighbours=lambda: [at(value - 1.0), at(value + 1.0)],
        )

    def bench(candidate: HybridDynamics) -> Score:
        value = float(candidate.baseline.theta[0, 0])  # type: ignore[index, operator]
        return Score(0, 2.5 if value == 0.0 else abs(value - 7.2))

    nothing = Solution({"value": None}, {"theta": torch.zeros(3, 1, dtype=torch.float64)})
    best, notes = choose_solution(own, own.baseline, [at(4.0), at(3.0), nothing], bench)
    assert (
        notes["free_run_choice"][2]["validation"] == 2.5 < notes["free_run_choice"][0]["validation"]
    )
    assert best.choice == {"value": 7.0}
    assert float(own.baseline.theta[0, 0]) == 7.0  # type: ignore[index, operator]


def test_a_diverging_solution_never_beats_a_steady_one() -> None:
    own = model()
    scores = {5.0: Score(1, 0.1), 2.0: Score(0, 0.9), 1.0: Score(0, 0.8)}

    def bench(candidate: HybridDynamics) -> Score:
        return scores[float(candidate.baseline.theta[0, 0])]  # type: ignore[index, operator]

    best, notes = choose_solution(own, own.baseline, solutions(5.0, 2.0, 1.0), bench)
    assert best.choice == {"value": 1.0}
    assert [entry["diverged"] for entry in notes["free_run_choice"]] == [1, 0, 0]
