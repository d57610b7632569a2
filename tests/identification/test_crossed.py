"""Errors over folds: a model on a baseline is judged in proportion to the baseline."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from residnet.identification.cross_fitting.crossed import Crossed, with_crossed
from residnet.judge.verdict.selection import Blocks, log_errors

FOLDS = Blocks(np.full(3, 1.0 / 3.0), "stretches")
LOGS = Blocks(np.full(2, 0.5), "stretches")
CROSSED = Crossed(
    FOLDS,
    {"zero": np.full(3, 0.3), "hull": np.array([0.1, 0.2, 0.3])},
    ((0, 5), (1, 5)),
)


def model(name: str, **notes: Any) -> Any:
    return SimpleNamespace(name=name, notes=notes)


def test_a_baseline_s_error_over_the_folds_is_multiplied_by_the_ratio_of_errors() -> None:
    own = {
        "zero": np.array([0.5, 0.5]),
        "hull": np.array([0.1, 0.1]),
        "net": np.array([0.1, 0.05]),
        "force": np.array([0.2, 0.1]),
        "alone": np.array([0.3, 0.3]),
        "good": np.array([0.1, 0.14]),
        "mean": np.array([0.1, 0.2]),
    }
    fitted = {
        "zero": model("zero"),
        "hull": model("hull"),
        "net": model("net", baseline="hull"),
        "force": model("force", of="hull"),
        "alone": model("alone", baseline="zero"),
        "good": model("good", baseline="zero"),
        "mean": model("mean", members=["net", "alone"]),
    }
    found = with_crossed(own, LOGS, CROSSED, fitted)
    assert found is not None
    expected = {"zero": 0.9, "hull": 0.6, "net": 0.45, "force": 0.9, "alone": 0.54, "mean": 0.375}
    # by the hull, which errs about as much: little is left of the error of zero
    expected["good"] = 0.72
    np.testing.assert_allclose([found.errors[name] for name in expected], [*expected.values()])
    # a model that is its baseline everywhere has no spread against it
    same = with_crossed({**own, "net": own["hull"]}, LOGS, CROSSED, fitted)
    assert same is not None
    assert same.blocks.standard_error(same.scores["net"], same.scores["hull"]) == 0.0
    # the logarithm of the ratio is that of the validation logs, and so is its spread
    net, hull = found.scores["net"], found.scores["hull"]
    here = log_errors(own, LOGS.weights)
    np.testing.assert_allclose((net - hull).sum(), (here["net"] - here["hull"]).sum())
    spread = LOGS.standard_error(here["net"], here["hull"])
    np.testing.assert_allclose(found.blocks.standard_error(net, hull), spread)
    np.testing.assert_array_equal(hull[3:], 0.0)
    # where the baseline errs nowhere on the validation logs there is no ratio
    perfect = with_crossed({**own, "hull": np.zeros(2)}, LOGS, CROSSED, fitted)
    assert perfect is not None
    np.testing.assert_allclose(perfect.errors["net"], 0.6)
    assert with_crossed(own, LOGS, CROSSED, {**fitted, "other": model("other")}) is None


def test_a_model_that_was_judged_over_the_folds_itself_needs_no_baseline() -> None:
    force = np.array([0.3, 0.1, 0.1])
    crossed = replace(CROSSED, shares={**CROSSED.shares, "force": force})
    own = {name: np.array([0.2, 0.1]) for name in ("hull", "force")}
    fitted = {"hull": model("hull"), "force": model("force", of="hull")}
    found = with_crossed(own, LOGS, crossed, fitted)
    assert found is not None
    np.testing.assert_allclose(found.errors["force"], force.sum())
    np.testing.assert_array_equal(found.scores["force"][3:], 0.0)


def test_a_network_is_no_better_than_its_folds_for_standing_on_a_poor_baseline() -> None:
    """The numbers are those of five minutes of a tanker model's zigzags: the linear model runs
    wide, and the network on it errs more than the hull, which no ratio to the former may hide.
    """
    over = {"zero": 3.80, "linear": 1.638, "hull": 0.581}
    here = {"zero": 1.61, "linear": 2.07, "hull": 0.265, "linear_net": 0.338, "hull_net": 0.187}
    crossed = replace(CROSSED, shares={name: np.full(3, e / 3.0) for name, e in over.items()})
    fitted = {
        **{name: model(name) for name in over},
        "linear_net": model("linear_net", baseline="linear"),
        "hull_net": model("hull_net", baseline="hull"),
    }
    own = {name: np.full(2, 0.5 * e) for name, e in here.items()}
    found = with_crossed(own, LOGS, crossed, fitted)
    assert found is not None
    score = {name: float(one.sum()) for name, one in found.scores.items()}
    for e in (found.errors, score):
        assert e["hull_net"] < e["hull"] < e["linear_net"] < e["linear"]


def test_errors_over_other_windows_are_not_joined() -> None:
    other = replace(CROSSED, shares={"linear": np.full(3, 0.2)})
    joined = CROSSED.joined(other)
    assert joined is not None
    assert set(joined.shares) == {"zero", "hull", "linear"}
    assert CROSSED.joined(replace(other, starts=((0, 6), (1, 5)))) is None
