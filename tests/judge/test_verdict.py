"""The verdict in words, from made contents of a run's files."""

from __future__ import annotations

from typing import Any

import pytest

from residnet.judge.verdict import Evidence, diverged_note, objections, verdict


def row(error: float, diverged: int = 0) -> dict[str, Any]:
    return {"nrmse": {"mean": error}, "diverged": diverged, "windows": 12}


def difference(value: float, half: float | None) -> dict[str, Any]:
    interval = None if half is None else [value - half, value + half]
    excludes = interval is not None and (interval[0] > 0 or interval[1] < 0)
    return {"nrmse_mean": value, "ci95": interval, "excludes_zero": excludes}


def horizons(*differences: tuple[float, float | None]) -> list[dict[str, Any]]:
    return [
        {"low": 5.0 * place, "high": 5.0 * (place + 1), "difference": difference(*given)}
        for place, given in enumerate(differences)
    ]


def evidence(error: float = 0.2, **change: Any) -> Evidence:
    given: dict[str, Any] = {
        "selected": "mlp",
        "split": "test",
        "rows": {"zero": row(0.5), "baseline": row(0.25), "mlp": row(error)},
        "baseline": "baseline",
        "selection": {
            "reason": "mlp has the least validation error.",
            "models": [{"model": "mlp", "faults": []}],
        },
        "limits": {
            "compared": {"mlp": {"zero": difference(-0.3, 0.1), "baseline": difference(-0.05, 0.1)}}
        },
    }
    return Evidence(**{**given, **change})


def test_the_first_sentence_compares_with_zero_and_the_baseline() -> None:
    first = verdict(evidence())[0]
    assert first.startswith("On test data model mlp is 60 % better than zero (paired 95 % interval")
    assert "-0.4 to -0.2)" in first
    assert "20 % better than the baseline" in first
    assert "which holds zero: the data cannot tell them apart" in first


def test_a_model_worse_than_zero_says_so_first() -> None:
    first = verdict(evidence(error=0.608, rows={"zero": row(0.506), "mlp": row(0.608)}))[0]
    assert first.startswith("WORSE THAN ZERO: on test data the selected model mlp has an NRMSE of")
    assert "0.608" in first
    assert "0.506" in first


def test_where_nothing_beats_zero_the_first_sentence_says_so() -> None:
    assert verdict(evidence(selected="zero"))[0].startswith("NOTHING BEATS ZERO")


def test_what_is_worse_than_zero_or_the_baseline_is_objected_to() -> None:
    assert objections(evidence(0.2)) == []
    assert objections(evidence(0.3)) == ["on test data its NRMSE is 0.3, that of baseline 0.25"]
    assert len(objections(evidence(0.6))) == 2
    assert objections(evidence(selected="baseline")) == []
    assert objections(evidence(selected="unknown")) == []


def test_unsound_models_and_divergences_are_named() -> None:
    fault = {"models": [{"model": "mlp", "faults": ["its damping has the wrong sign"]}]}
    rows = {"zero": row(0.5), "mlp": row(0.2, diverged=7)}
    said = verdict(evidence(selection=fault, rows=rows))
    assert "7/12 diverged, which count with the error of zero" in said[0]
    assert said[1] == (
        "It is UNSOUND: its damping has the wrong sign; 7 of its 12 test windows diverged."
    )
    assert verdict(evidence())[1].startswith("It is sound")
    assert (diverged_note(row(0.2)), diverged_note(row(0.2, 3))) == ("", "3/12 diverged")


@pytest.mark.parametrize(
    ("entries", "said"),
    [
        (((-0.2, 0.1), (-0.2, 0.1), (-0.2, 0.1)), "trusted up to 15 s ahead, as far as the runs"),
        (((-0.2, 0.1), (-0.2, 0.1), (0.2, 0.1)), "trusted up to 10 s ahead, but"),
        (((-0.01, 0.1), (-0.2, 0.1), (-0.2, 0.1)), "trusted from 5 up to 15 s ahead"),
        (((-0.01, 0.1), (0.2, 0.1), (-0.05, 0.1)), "cannot be trusted at any horizon"),
        (((-0.2, None), (-0.2, None)), "but there are too few logs for an interval"),
    ],
)
def test_trust_reaches_as_far_as_errors_are_smaller_than_those_of_zero(
    entries: tuple[tuple[float, float | None], ...], said: str
) -> None:
    speeds = horizons((0.1, 0.01))
    limits = {"trust": {"mlp": {"horizons": horizons(*entries), "speeds": speeds}}}
    (sentence,) = [text for text in verdict(evidence(limits=limits)) if "trusted" in text]
    assert said in sentence


def test_data_outside_the_training_range_and_the_doctor_are_told() -> None:
    limits = {"outside": {"share": 0.123, "channels": {"u": 0.1, "delta": 0.03}}}
    said = verdict(evidence(limits=limits, doctor="Data doctor: nothing would mislead a fit."))
    assert any(text.startswith("Of the test data, 12 % lies outside") for text in said)
    assert any("(u 10 %, delta 3 %)" in text for text in said)
    assert said[-1] == "Data doctor: nothing would mislead a fit."


def test_an_old_run_without_these_files_still_has_a_verdict() -> None:
    said = verdict(evidence(selection={}, limits={}))
    assert said == [
        "On test data model mlp is 60 % better than zero and 20 % better than the baseline; its"
        " NRMSE is 0.2."
    ]
