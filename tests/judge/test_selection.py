"""The choice among models whose errors and faults are made by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from residnet.judge.verdict.selection import Blocks, Contender, Selection, choose, difference

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
    """A model whose error differs from log to log by `spread` times (1, -1, 2, -2, 0)."""
    told = (f"{diverged} of its 7 validation windows diverged (T30)",) if diverged else ()
    shares = (error + spread * JITTER) / 5
    return Contender(name, family, parameters, shares, diverged, (*told, *faults))


ZERO = contender("zero", "zero", 1.0, parameters=0)


def chosen(*models: Contender) -> Selection:
    return choose((ZERO, *models), EVEN)


def test_the_standard_error_is_that_of_paired_differences() -> None:
    one, other = contender("a", "baseline", 0.5, spread=0.1), contender("b", "baseline", 0.4)
    differences = 0.1 + 0.1 * JITTER
    expected = differences.std(ddof=1) / np.sqrt(5)
    assert EVEN.standard_error(one.shares, other.shares) == pytest.approx(expected)
    # what both have in common is no spread of the difference
    common = contender("c", "baseline", 0.4, spread=0.1)
    assert EVEN.standard_error(one.shares, common.shares) == pytest.approx(0.0, abs=1e-12)


def test_a_diverging_model_is_not_selected_while_a_steady_one_is_there() -> None:
    found = chosen(
        contender("baseline", "baseline", 0.5), contender("lstm", "network", 0.2, diverged=7)
    )
    assert found.selected == "baseline"
    assert "unsound: lstm (7 of its 7 validation windows diverged (T30))" in found.reason


@pytest.mark.parametrize(
    "fault", ["its damping has the wrong sign", "it runs away within 20 s", "it is unstable"]
)
def test_no_unsound_model_is_selected_while_a_sound_one_is_there(fault: str) -> None:
    found = chosen(
        contender("baseline", "baseline", 0.5),
        contender("ridge", "closed-form head", 0.2, faults=(fault,)),
    )
    assert found.selected == "baseline"


@pytest.mark.parametrize(("spread", "expected"), [(0.1, "baseline"), (0.05, "mlp")])
def test_the_simplest_within_one_standard_error_is_selected(spread: float, expected: str) -> None:
    # the standard error is 0.71 times the spread, the difference 0.05
    found = chosen(
        contender("mlp", "network", 0.45), contender("baseline", "baseline", 0.5, spread=spread)
    )
    assert found.selected == expected
    assert ("within one standard error (0.071)" in found.reason) is (expected == "baseline")
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


def test_where_none_is_sound_a_steady_one_that_beats_zero_is_taken() -> None:
    wrong = ("its damping has the wrong sign",)
    worse = contender("baseline", "baseline", 0.5, faults=wrong)
    better = contender("ridge", "closed-form head", 0.4, faults=wrong)
    lost = contender("mlp", "network", 0.1, diverged=1)
    found = chosen(worse, better, lost)
    assert found.selected == "ridge"
    assert found.reason.startswith("No model is sound; ridge has the least validation error")
    assert chosen(lost).selected == "zero"
    assert chosen(contender("baseline", "baseline", 1.3, faults=wrong)).selected == "zero"


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
    assert (content["schema"], content["selected"]) == ("residnet.selection/1", "baseline")
    assert content["blocks"] == {"of": "logs", "count": 5}
    rows = {row["model"]: row for row in content["models"]}
    assert rows["mlp"]["difference"] == pytest.approx(0.2)
    assert rows["mlp"]["standard_error"] == pytest.approx(0.1 * JITTER.std(ddof=1) / np.sqrt(5))
    assert (rows["mlp"]["sound"], rows["mlp"]["diverged"]) == (False, 2)
    assert rows["zero"]["sound"] is True


def test_blocks_of_other_data_add_to_the_variance() -> None:
    """The blocks of folds and those of validation logs are independent of each other."""
    random = np.random.default_rng(3)
    one, other = random.random(5), random.random(4)
    quarters = Blocks(np.full(4, 0.25), "stretches")
    both = EVEN.beside(quarters)
    apart = [EVEN.standard_error(one, np.zeros(5)), quarters.standard_error(other, np.zeros(4))]
    found = both.standard_error(np.concatenate((one, other)), np.zeros(9))
    assert found == pytest.approx(math.hypot(*apart))
    assert both.count == 9


def test_the_more_precise_of_two_comparisons_counts() -> None:
    """A network alone is judged by way of `zero` over folds, which differs much between logs."""
    both = EVEN.beside(EVEN)

    def judged(name: str, folds: float, spread: float, alone: float, family: str) -> Contender:
        direct = (alone + 0.001 * JITTER) / 5
        over_folds = (folds + spread * JITTER) / 5
        rest = np.zeros(5) if family == "refitted baseline" else direct - over_folds[::-1]
        return Contender(name, family, 10, np.concatenate((over_folds, rest)), direct=direct)

    hull = judged("hull", 0.2, 0.01, 0.2, "refitted baseline")
    network = judged("network", 0.8, 0.3, 0.25, "network")
    assert difference(network, hull, both)[0] == pytest.approx(0.05)
    assert difference(network, hull, both)[1] < 0.01
    found = choose((ZERO_OF_FOLDS, hull, network), both)
    assert (found.selected, found.tied) == ("hull", ("hull",))
    # the other way round neither a simpler hull nor zero stands in a good network's way
    good = judged("network", 0.8, 0.3, 0.1, "network")
    assert choose((ZERO_OF_FOLDS, hull, good), both).selected == "network"
    # two baselines are compared over the folds, which are more logs
    linear = judged("linear", 0.3, 0.02, 0.1, "refitted baseline")
    assert difference(linear, hull, both)[0] == pytest.approx(0.1)


def test_stretches_of_one_validation_log_do_not_overrule_folds() -> None:
    """A patrol vessel with five minutes of logs: a line in each channel stood before the hull."""
    both = EVEN.beside(replace(EVEN, of="stretches"))

    def judged(name: str, folds: float, alone: float, family: str, gain: float) -> Contender:
        over_folds, direct = (folds + 0.02 * JITTER) / 5, (alone + 0.001 * JITTER) / 5
        return Contender(
            name, family, 10, np.concatenate((over_folds, np.full(5, gain / 5))), direct=direct
        )

    linear = judged("baseline", 0.53, 0.38, "refitted baseline", 0.0)
    hull = judged("hull", 0.32, 0.47, "refitted baseline", 0.0)
    network = judged("hull_network", 0.32, 0.46, "network", -0.01)
    assert difference(network, linear, both)[0] == pytest.approx(-0.22)
    found = choose((ZERO_OF_FOLDS, linear, hull, network), both)
    assert found.selected == "hull_network"
    # five whole logs or more may
    assert difference(network, linear, EVEN.beside(EVEN))[0] == pytest.approx(0.08)


ZERO_OF_FOLDS = Contender(
    "zero",
    "zero",
    0,
    np.concatenate(((0.8 + 0.3 * JITTER) / 5, np.zeros(5))),
    direct=np.full(5, 0.16),
)
