"""The choice among models whose errors and faults are made by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from residnet.judge.selection import (
    Blocks,
    Contender,
    Selection,
    choose,
    difference,
    log_errors,
)

EVEN = Blocks(np.full(5, 0.2), "logs")
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
) -> Contender:
    """A model whose log error differs from log to log by `spread` times (1, -1, 2, -2, 0)."""
    told = (f"{diverged} of its 7 validation windows diverged (T30)",) if diverged else ()
    scores = (math.log(error) + spread * JITTER) / 5
    return Contender(name, family, parameters, error, scores, diverged, (*told, *faults))


ZERO = contender("zero", "zero", 1.0, parameters=0)


def chosen(*models: Contender) -> Selection:
    return choose((ZERO, *models), EVEN)


def test_the_standard_error_is_that_of_paired_differences() -> None:
    one, other = contender("a", "baseline", 0.5, spread=0.1), contender("b", "baseline", 0.4)
    expected = (0.1 * JITTER).std(ddof=1) / np.sqrt(5)
    assert EVEN.standard_error(one.scores, other.scores) == pytest.approx(expected)
    assert difference(one, other, EVEN) == pytest.approx((math.log(0.5 / 0.4), expected))
    # what both have in common is no spread of the difference
    common = contender("c", "baseline", 0.4, spread=0.1)
    assert EVEN.standard_error(one.scores, common.scores) == pytest.approx(0.0, abs=1e-12)


def test_a_diverging_model_is_not_selected_while_a_steady_one_is_there() -> None:
    found = chosen(
        contender("baseline", "baseline", 0.5), contender("lstm", "network", 0.2, diverged=7)
    )
    assert found.selected == "baseline"
    assert "passed over: lstm (7 of its 7 validation windows diverged (T30))" in found.reason


FAULT = ("its damping has the wrong sign",)


@pytest.mark.parametrize(("spread", "expected"), [(0.5, "baseline"), (0.05, "ridge")])
def test_a_fault_costs_as_much_error_as_the_logs_can_tell(spread: float, expected: str) -> None:
    # the standard error is 0.71 times the spread, the ratio exp(0.2)
    found = chosen(
        contender("baseline", "baseline", 0.5 * math.exp(0.2), spread=spread),
        contender("ridge", "closed-form head", 0.5, faults=FAULT),
    )
    assert found.selected == expected
    assert (FAULT[0] in found.reason) is (expected == "ridge")


def test_a_sound_network_comes_before_an_unsound_line_that_is_alike() -> None:
    line = contender("line", "baseline", 0.4, faults=FAULT)
    assert chosen(line, contender("mlp", "network", 0.4)).selected == "mlp"
    assert chosen(line).selected == "line"


@pytest.mark.parametrize(("spread", "expected"), [(0.1, "baseline"), (0.05, "mlp")])
def test_the_simplest_within_one_standard_error_is_selected(spread: float, expected: str) -> None:
    # the standard error is 0.71 times the spread, the ratio exp(0.05)
    found = chosen(
        contender("mlp", "network", 0.5 * math.exp(-0.05)),
        contender("baseline", "baseline", 0.5, spread=spread),
    )
    assert found.selected == expected
    said = "baseline is the simplest sound model within one standard error (7.1 %) of the best one"
    assert found.reason.startswith(said) is (expected == "baseline")
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


def test_zero_is_selected_where_nothing_beats_it() -> None:
    found = chosen(contender("baseline", "baseline", 1.2), contender("mlp", "network", 1.1))
    assert found.selected == "zero"


def test_zero_is_selected_where_all_others_diverge() -> None:
    assert chosen(contender("mlp", "network", 0.1, diverged=1)).selected == "zero"


def test_ensembles_are_compared_among_themselves() -> None:
    found = chosen(
        contender("baseline", "baseline", 0.5),
        contender("mean", "ensemble", 0.2),
        contender("best", "ensemble", 0.1, diverged=1),
    )
    assert (found.selected, found.selected_ensemble) == ("baseline", "mean")
    assert chosen(contender("baseline", "baseline", 0.5)).selected_ensemble is None


def test_the_file_says_of_each_model_what_decided() -> None:
    lead = contender("baseline", "baseline", 0.5, spread=0.1)
    content = chosen(lead, contender("mlp", "network", 0.7, diverged=2)).content()
    assert (content["schema"], content["selected"]) == ("residnet.selection/2", "baseline")
    assert content["blocks"] == {"of": "logs", "count": 5}
    rows = {row["model"]: row for row in content["models"]}
    assert rows["mlp"]["nrmse_mean"] == 0.7
    assert rows["mlp"]["ratio"] == pytest.approx(0.7 / 0.5)
    assert rows["mlp"]["standard_error"] == pytest.approx(0.1 * JITTER.std(ddof=1) / np.sqrt(5))
    assert (rows["mlp"]["sound"], rows["mlp"]["diverged"]) == (False, 2)
    assert rows["zero"]["sound"] is True


def test_one_bad_stretch_decides_nothing() -> None:
    """The numbers are the errors over folds of five minutes of a model tanker: a line stood before
    a hull that erred less in seven of eight stretches, and on other logs half as much.
    """
    line = np.array([0.37, 2.68, 1.44, 3.27, 0.40, 1.48, 0.80, 1.63]) / 8
    hull = np.array([0.26, 2.15, 0.99, 1.06, 0.17, 3.71, 0.19, 0.84]) / 8
    eight = Blocks(np.full(8, 0.125), "stretches")
    assert hull.sum() < line.sum() < hull.sum() + eight.standard_error(line, hull)
    scores = log_errors({"baseline": line, "hull": hull}, eight.weights)
    models = [
        Contender(name, "refitted baseline", size, float(shares.sum()), scores[name])
        for name, shares, size in (("baseline", line, 18), ("hull", hull, 40))
    ]
    assert choose(models, eight).selected == "hull"


def test_blocks_in_which_all_are_nearly_right_count_little() -> None:
    weights = np.full(4, 0.25)
    one, other = np.array([0.4, 0.4, 0.4, 1e-9]), np.array([0.3, 0.3, 0.3, 1e-4])
    scores = log_errors({"one": weights * one, "other": weights * other}, weights)
    apart = scores["one"] - scores["other"]
    assert apart.sum() > 0.0
    assert abs(apart[3]) < 0.02 * apart[0]
    assert np.isfinite(log_errors({"none": np.zeros(4)}, weights)["none"]).all()
