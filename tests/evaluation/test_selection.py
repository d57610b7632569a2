"""The choice among models whose errors and faults are made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from residnet.evaluation.selection import (
    Selection,
    SelectionBlocks,
    SelectionCandidate,
    block_log_errors,
    log_error_ratio,
    select_models,
)
from residnet.evaluation.verdict import describe_diverged_heads

EVEN = SelectionBlocks(np.full(5, 0.2), "logs")
JITTER = np.array([1.0, -1.0, 2.0, -2.0, 0.0])


def contender(
    name: str,
    family: str,
    error: float,
    *,
    parameters: int = 10,
    spread: float = 0.0,
    diverged: int = 0,
    faults: tuple[str, ...] = (),
) -> SelectionCandidate:
    """A model whose log error differs from log to log by `spread` times (1, -1, 2, -2, 0)."""
    told = (f"{diverged} of its 7 validation windows diverged (T30)",) if diverged else ()
    scores = (math.log(error) + spread * JITTER) / 5
    return SelectionCandidate(name, family, parameters, error, scores, diverged, (*told, *faults))


ZERO = contender("constant_velocity", "constant_velocity", 1.0, parameters=0)


def chosen(*models: SelectionCandidate) -> Selection:
    return select_models((ZERO, *models), EVEN)


def test_the_standard_error_is_that_of_paired_differences() -> None:
    one = contender("a", "baseline", 0.5, spread=0.1)
    other = contender("b", "baseline", 0.4)
    expected = (0.1 * JITTER).std(ddof=1) / np.sqrt(5)
    assert EVEN.standard_error(one.block_scores, other.block_scores) == pytest.approx(expected)
    assert log_error_ratio(one, other, EVEN) == pytest.approx((math.log(0.5 / 0.4), expected))
    # what both have in common is no spread of the difference
    common = contender("c", "baseline", 0.4, spread=0.1)
    assert EVEN.standard_error(one.block_scores, common.block_scores) == pytest.approx(
        0.0, abs=1e-12
    )


LOST = "excluded: lstm (7 of its 7 validation windows diverged (T30))"
FAULT = ("its damping has the wrong sign",)
WITHIN = "baseline is the simplest sound model within one standard error (7.1 %) of the best one"


def baseline(error: float, spread: float = 0.0) -> SelectionCandidate:
    return contender("baseline", "baseline", error, spread=spread)


LSTM = contender("lstm", "network", 0.2, diverged=7)
RIDGE = contender("ridge", "closed-form head", 0.5, faults=FAULT)
LINE = contender("line", "baseline", 0.4, faults=FAULT)


@pytest.mark.parametrize(
    ("models", "expected", "said"),
    [
        # no model that diverges while a steady one is there
        ([baseline(0.5), LSTM], "baseline", LOST),
        # a fault costs as much error as the logs can tell: the standard error is 0.71 times the
        # spread
        ([baseline(0.5 * math.exp(0.2), 0.5), RIDGE], "baseline", ""),
        ([baseline(0.5 * math.exp(0.2), 0.05), RIDGE], "ridge", FAULT[0]),
        # a sound network comes before an unsound line that is alike
        ([LINE, contender("mlp", "network", 0.4)], "mlp", ""),
        ([LINE], "line", ""),
        # the simplest within one standard error
        (
            [baseline(0.5, 0.1), contender("mlp", "network", 0.5 * math.exp(-0.05))],
            "baseline",
            WITHIN,
        ),
        (
            [baseline(0.5, 0.05), contender("mlp", "network", 0.5 * math.exp(-0.05))],
            "mlp",
            "smallest",
        ),
        # constant velocity where nothing beats it, or all others diverge
        (
            [baseline(1.2), contender("mlp", "network", 1.1)],
            "constant_velocity",
            "No model is better than constant velocity",
        ),
        ([contender("mlp", "network", 0.1, diverged=1)], "constant_velocity", ""),
    ],
)
def test_the_choice(models: list[SelectionCandidate], expected: str, said: str) -> None:
    found = chosen(*models)
    assert found.selected == expected
    assert said in found.reason
    assert (FAULT[0] in found.reason) is (expected in ("ridge", "line"))
    assert found.reason.endswith(".")


def test_families_and_then_parameters_order_models_that_are_alike() -> None:
    models = [
        contender("mlp", "network", 0.4, parameters=5),
        contender("plsr", "closed-form head", 0.4, parameters=30),
        contender("ridge", "closed-form head", 0.4, parameters=20),
        contender("refitted", "refitted baseline", 0.4, parameters=50),
        contender("hull", "baseline", 0.4, parameters=40),
        contender("line", "baseline", 0.4, parameters=9),
    ]
    order = []
    while models:
        order.append(chosen(*models).selected)
        models = [model for model in models if model.name != order[-1]]
    assert order == ["line", "hull", "refitted", "ridge", "plsr", "mlp"]


def test_ensembles_are_compared_among_themselves() -> None:
    found = chosen(
        baseline(0.5),
        contender("mean", "ensemble", 0.2),
        contender("best", "ensemble", 0.1, diverged=1),
    )
    assert (found.selected, found.selected_ensemble) == ("baseline", "mean")
    assert chosen(baseline(0.5)).selected_ensemble is None


def test_the_file_says_of_each_model_what_decided() -> None:
    lead = baseline(0.5, 0.1)
    content = chosen(lead, contender("mlp", "network", 0.7, diverged=2)).to_record().to_content()
    assert (content["schema"], content["selected"]) == ("residnet.selection/2", "baseline")
    assert content["blocks"] == {"of": "logs", "count": 5}
    rows = {row["model"]: row for row in content["models"]}
    assert rows["mlp"]["nrmse_mean"] == 0.7
    assert rows["mlp"]["ratio"] == pytest.approx(0.7 / 0.5)
    assert rows["mlp"]["standard_error"] == pytest.approx(0.1 * JITTER.std(ddof=1) / np.sqrt(5))
    assert (rows["mlp"]["sound"], rows["mlp"]["diverged"]) == (False, 2)
    assert rows["constant_velocity"]["sound"] is True


@pytest.mark.parametrize(
    ("family", "remedy"), [("closed-form head", "choose: free_run"), ("network", "add logs")]
)
def test_a_single_head_that_diverges_is_refused_in_plain_words(family: str, remedy: str) -> None:
    """Also if its error is not smaller than that of the selected model."""
    hull = contender("hull", "baseline", 0.5)
    for error in (0.4, 0.9):
        head = contender("plsr", family, error, diverged=2, faults=FAULT)
        (line,) = describe_diverged_heads(chosen(hull, head).to_record())
        assert line.startswith(
            "plsr must not be used alone: 2 of its 7 validation windows diverged (T30). hull was"
            " selected instead; to use plsr, "
        )
        assert remedy in line
    # another head was selected: the reason of the selection says why
    ridge = contender("ridge", "closed-form head", 0.2)
    head = contender("plsr", family, 0.1, diverged=2)
    assert describe_diverged_heads(chosen(hull, ridge, head).to_record()) == []
    # a head that only has a fault of its physical checks is not refused
    head = contender("plsr", family, 0.9, faults=FAULT)
    assert describe_diverged_heads(chosen(hull, head).to_record()) == []


def test_of_stretches_half_a_standard_error_is_taken() -> None:
    models = (ZERO, baseline(0.5, 0.1), contender("mlp", "network", 0.5 * math.exp(-0.05)))
    found = select_models(models, SelectionBlocks(EVEN.weights, "stretches"))
    assert found.selected == "mlp"
    assert "no simpler one is within half a standard error" in found.reason


def test_a_tenth_of_the_least_error_is_added_to_that_of_each_block() -> None:
    """No block counts much where all models are nearly right, nor does one bad stretch."""
    weights = np.array([0.5, 0.25, 0.25])
    errors = {"one": np.array([0.4, 0.4, 1e-9]), "other": np.array([0.3, 0.6, 1e-4])}
    scores = block_log_errors({name: weights * error for name, error in errors.items()}, weights)
    least = min(float(weights @ error) for error in errors.values())
    for name, error in errors.items():
        np.testing.assert_allclose(scores[name], weights * np.log(error + 0.1 * least))
    assert np.isfinite(block_log_errors({"none": np.zeros(3)}, weights)["none"]).all()
