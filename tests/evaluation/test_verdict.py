"""The verdict in words, from made contents of a run's files."""

from __future__ import annotations

import math
from typing import Any

import pytest

from residnet.evaluation.data_records import ExcitationFile
from residnet.evaluation.limits_records import (
    HorizonRow,
    KinematicErrors,
    OutsideRange,
    PoseErrors,
    ProtocolLimits,
)
from residnet.evaluation.records import (
    BlockCount,
    MetricsRow,
    ModelKind,
    PairedDifference,
    SelectionFile,
    SelectionRow,
)
from residnet.evaluation.verdict import (
    VerdictEvidence,
    describe_divergence,
    list_model_objections,
    order_protocols,
    rate_model,
    write_verdict,
)
from residnet.tasks.fit.service import advise_excitation


def row(
    error: float,
    diverged: int = 0,
    kind: ModelKind = "head",
    split: str = "test",
    protocol: str = "T30",
) -> MetricsRow:
    return MetricsRow(
        model="mlp",
        kind=kind,
        split=split,
        protocol=protocol,
        manoeuvre="all",
        windows=12,
        n=120,
        diverged=diverged,
        rmse={},
        mae={},
        nrmse={"mean": error},
        rmse_ci95={},
        nrmse_mean_ci95=None,
        ci95_blocks=None,
    )


def difference(value: float, half: float | None) -> PairedDifference:
    interval = None if half is None else (value - half, value + half)
    excludes = interval is not None and (interval[0] > 0 or interval[1] < 0)
    return PairedDifference(
        to="", nrmse_mean=value, ci95=interval, excludes_zero=excludes, ratio=None, worse=False
    )


def errors(position: float, degrees: float, half: float | None = 0.1) -> PoseErrors:
    """Errors of one model; `half` is the half width of the intervals as a share."""
    heading = math.radians(degrees)
    ends = {"position": position, "heading": heading}
    intervals = {
        of: None if half is None else (value * (1.0 - half), value * (1.0 + half))
        for of, value in ends.items()
    }
    return PoseErrors(position=position, heading=heading, intervals=intervals)


def horizon(
    seconds: float, mlp: PoseErrors, windows: int = 12, best: PoseErrors | None = None
) -> HorizonRow:
    """One entry of limits.json: 2 m/s are sailed, zero is far off."""
    models = {
        "mlp": mlp,
        "constant_velocity": errors(seconds, 40.0),
        "baseline": best or errors(seconds, 30.0),
    }
    return HorizonRow(
        seconds=seconds,
        windows=windows,
        logs=4,
        slowest=1.5,
        fastest=2.5,
        sailed=2.0 * seconds,
        floor=errors(0.1, 0.2),
        models=models,
    )


def protocol_limits(**content: Any) -> ProtocolLimits:
    """Contents of limits.json for one protocol."""
    empty: dict[str, Any] = {
        "kinematics": KinematicErrors(),
        "bands": (),
        "worst": {},
        "compared": {},
        "outside": OutsideRange(),
        "horizons": (),
    }
    return ProtocolLimits(**{**empty, **content})


def under(**content: Any) -> dict[str, ProtocolLimits]:
    """Contents of limits.json for the protocol that decides."""
    return {"T30": protocol_limits(**content)}


def selection(reason: str = "", *faults: str) -> SelectionFile:
    """Contents of selection.json with one model."""
    chosen = SelectionRow(
        model="mlp",
        family="network",
        parameters=1,
        nrmse_mean=0.2,
        ratio=1.0,
        standard_error=0.0,
        diverged=0,
        sound=not faults,
        faults=faults,
    )
    return SelectionFile(
        schema="residnet.selection/2",
        selected="mlp",
        selected_ensemble=None,
        predictor="mlp",
        reason=reason,
        blocks=BlockCount(of="logs", count=5),
        models=(chosen,),
    )


def evidence(error: float = 0.2, **change: Any) -> VerdictEvidence:
    given: dict[str, Any] = {
        "selected": "mlp",
        "split": "test",
        "rows_by_model": {"constant_velocity": row(0.5), "baseline": row(0.25), "mlp": row(error)},
        "baseline": "baseline",
        "selection": selection("mlp has the least validation error."),
        "limits_by_protocol": under(
            compared={
                "mlp": {
                    "constant_velocity": difference(-0.3, 0.1),
                    "baseline": difference(-0.05, 0.1),
                }
            }
        ),
        "protocol": "T30",
    }
    return VerdictEvidence(**{**given, **change})


def test_velocity_errors_are_compared_with_constant_velocity_and_the_baseline() -> None:
    first = write_verdict(evidence())[0]
    assert first.startswith(
        "On test data the velocity errors of mlp (NRMSE 0.200) are 60 % lower than those of"
        " constant velocity (paired 95 % confidence interval"
    )
    for part in (
        "−0.400 to −0.200)",
        "20 % lower than those of the baseline",
        "zero: the difference is not significant",
    ):
        assert part in first
    worse = write_verdict(
        evidence(error=0.608, rows_by_model={"constant_velocity": row(0.506), "mlp": row(0.608)})
    )[0]
    assert worse.startswith("Do not use: on test data the velocity errors of mlp (NRMSE 0.608)")
    assert "larger than those of constant velocity (0.506)" in worse
    assert write_verdict(evidence(selected="constant_velocity"))[0].startswith(
        "Do not use: no model of this run is better than constant velocity"
    )


def test_constant_velocity_is_selected_because_a_model_fails() -> None:
    """Its errors at short horizons may be smaller, as the table next to the verdict shows."""
    fault = "4 of its 4 validation windows diverged (T20)"
    said = write_verdict(evidence(selected="constant_velocity", selection=selection("", fault)))[0]
    assert said.startswith("Do not use: no sound model of this run is better than constant")
    assert said.endswith(f"; mlp fails: {fault}.")


def test_logs_that_trained_the_model_are_not_external_data() -> None:
    known = evidence(split="external", n_logs=2, n_logs_of_fit=2)
    sentences = write_verdict(known)
    assert sentences[0].startswith("On data of the fit the velocity errors of mlp")
    assert sentences[1].startswith(
        "The rating is at most limited, because 2 of 2 logs trained the model (same SHA-256)"
    )
    assert "external" not in " ".join(sentences)
    partly_known = write_verdict(evidence(split="external", n_logs=3, n_logs_of_fit=1))
    assert partly_known[0].startswith("On external data")
    assert "1 of 3 logs trained the model" in partly_known[1]
    new = write_verdict(evidence(split="external", n_logs=3))
    assert "trained the model" not in " ".join(new)


def test_what_is_worse_than_zero_or_the_baseline_is_objected_to() -> None:
    assert list_model_objections(evidence(0.2)) == []
    assert list_model_objections(evidence(0.3)) == [
        "on test data its NRMSE is 0.300, that of baseline 0.250"
    ]
    assert len(list_model_objections(evidence(0.6))) == 2
    assert list_model_objections(evidence(selected="baseline")) == []
    assert list_model_objections(evidence(selected="unknown")) == []


@pytest.mark.parametrize(
    ("mlp", "objection"),
    [
        (errors(3.0, 5.0), ""),
        (errors(26.0, 5.0), "its position error is not significantly smaller than that of"),
        (errors(3.0, 60.0), "its heading error is not significantly smaller than that of"),
        (errors(25.0, 5.0), "the upper limit of its position error is 28 m"),
        (errors(3.0, 30.0), "the upper limit of its heading error is 33 deg"),
    ],
)
def test_a_model_rated_do_not_use_by_position_or_heading_alone_is_objected_to(
    mlp: PoseErrors, objection: str
) -> None:
    """Its velocity errors are smaller than those of constant velocity and of the baseline."""
    judged = evidence(limits_by_protocol=under(horizons=[horizon(30, mlp)]))
    objections = list_model_objections(judged)
    assert bool(objections) == (rate_model(judged) == "do not use") == bool(objection)
    if objection:
        assert f"in free runs of 30 s on test data {objection}" in "; ".join(objections)


def test_an_indistinguishable_model_and_too_few_windows_are_objected_to_as_rated() -> None:
    compared = {"mlp": {"constant_velocity": difference(-0.01, 0.1)}}
    assert "not significantly smaller" in "".join(
        list_model_objections(evidence(limits_by_protocol=under(compared=compared)))
    )
    few = evidence(limits_by_protocol=under(horizons=[horizon(30, errors(26.0, 60.0), windows=4)]))
    assert rate_model(few) == "too few windows"
    assert list_model_objections(few) == []


def test_unsound_models_and_divergences_are_named() -> None:
    fault = selection("", "its damping has the wrong sign")
    rows = {"constant_velocity": row(0.5), "mlp": row(0.2, diverged=7)}
    said = write_verdict(evidence(selection=fault, rows_by_model=rows))
    assert "7/12 diverged, which count with the constant-velocity error" in said[0]
    assert said[1] == (
        "It is UNSOUND: its damping has the wrong sign; 7 of its 12 test windows diverged."
    )
    assert write_verdict(evidence())[1].startswith("No window diverged")
    assert (describe_divergence(row(0.2)), describe_divergence(row(0.2, 3))) == (
        "",
        "3/12 diverged",
    )


def test_the_verdict_refuses_a_single_head_that_diverges() -> None:
    (network,) = selection().models
    plsr = network.model_copy(
        update={
            "model": "plsr",
            "family": "closed-form head",
            "diverged": 3,
            "sound": False,
            "faults": ("3 of its 12 validation windows diverged (T30)",),
        }
    )
    hull = network.model_copy(update={"model": "baseline", "family": "baseline"})
    chosen = selection().model_copy(update={"selected": "baseline", "models": (hull, plsr)})
    said = write_verdict(evidence(selected="baseline", selection=chosen))
    assert any(line.startswith("plsr must not be used alone: 3 of its 12") for line in said)


@pytest.mark.parametrize(
    ("entries", "expected", "reason"),
    [
        (
            [horizon(10, errors(0.5, 2.0)), horizon(30, errors(3.0, 5.0))],
            "good",
            "Good: upper limits within 10 % of the distance travelled and 10 deg",
        ),
        # the main horizon counts: the longest that half of the windows reach
        (
            [horizon(10, errors(0.5, 2.0)), horizon(30, errors(9.0, 5.0))],
            "limited",
            "Limited for 30 s, good up to 10 s: the upper limit of its position error is 9.9 m,"
            " 16 % of the distance travelled (good: at most 10 %)",
        ),
        (
            [horizon(10, errors(0.5, 2.0)), horizon(30, errors(9.0, 5.0), windows=5)],
            "good",
            "Good: upper limits within",
        ),
        # a tenth of the distance is no use where the bow points elsewhere
        (
            [horizon(30, errors(3.0, 67.0))],
            "do not use",
            "Do not use: its heading error is not significantly smaller than that of constant"
            " velocity; the upper limit of its heading error is 74 deg (limited: at most 30 deg)",
        ),
        (
            [horizon(10, errors(3.0, 5.0)), horizon(30, errors(25.0, 25.0))],
            "do not use",
            "46 % of the distance travelled (limited: at most 25 %)",
        ),
        (
            [
                horizon(10, errors(0.5, 2.0)),
                horizon(20, errors(6.0, 5.0)),
                horizon(30, errors(25.0, 25.0)),
            ],
            "do not use",
            "Do not use for 30 s, good up to 10 s and limited up to 20 s: its position error is",
        ),
        # a level that fails at a shorter horizon does not hold up to a longer one
        (
            [
                horizon(10, errors(1.9, 5.0)),
                horizon(20, errors(2.0, 5.0)),
                horizon(30, errors(9.0, 5.0)),
            ],
            "limited",
            "Limited: the upper limit of its position error is 9.9 m",
        ),
        # the upper limit of the prediction interval counts; without one there is no rating
        (
            [horizon(30, errors(5.0, 5.0, half=0.5))],
            "limited",
            "Limited: the upper limit of its position error is 7.5 m, 12 % of",
        ),
        (
            [horizon(30, errors(3.0, 5.0, half=None))],
            "too few windows",
            "A rating needs at least 5 free runs of 3 logs",
        ),
        # a model with a far larger error than another one of the run is not good
        (
            [horizon(30, errors(3.0, 5.0), best=errors(1.0, 4.0))],
            "limited",
            "its position error is 3.0 times that of baseline",
        ),
        (
            [horizon(60, errors(35.0, 160.0), windows=1)],
            "too few windows",
            "Too few test data for a rating: 1 free run of 4 logs",
        ),
        # a large noise floor does not raise the limits
        ([horizon(0.5, errors(0.15, 0.3))], "limited", "0.17 m, 16 % of the distance travelled"),
    ],
)
def test_the_level_is_that_of_the_main_horizon(
    entries: list[HorizonRow], expected: str, reason: str
) -> None:
    judged = evidence(limits_by_protocol=under(horizons=entries))
    assert rate_model(judged) == expected
    sentences = write_verdict(judged)
    assert sentences[0].startswith("After a ")
    assert reason in sentences[1]


def test_the_verdict_names_references_other_horizons_and_the_free_runs() -> None:
    entries = [horizon(10, errors(0.5, 2.0)), horizon(30, errors(3.0, 5.0))]
    said = write_verdict(evidence(limits_by_protocol=under(horizons=entries)))
    assert said[0] == (
        "After a 30 s free run the position error of mlp is 3.0 m (95 % prediction interval 2.7 to"
        " 3.3 m; 5.0 % of the 60 m travelled) and the heading error is 5.0 deg (95 % prediction"
        " interval 4.5 to 5.5 deg)."
    )
    assert said[2].startswith(
        "Reference models (95 % prediction intervals): constant velocity 30 m (27 to 33) and 40 deg"
        " (36 to 44); baseline"
    )
    assert said[2].endswith("noise floor (measured velocities, integrated) 0.10 m and 0.20 deg.")
    assert said[3] == "Other horizons: 0.50 m and 2.0 deg after 10 s (good)."
    assert said[4] == (
        "The errors are means of 12 free runs (T30) of 4 logs at mean speeds of 1.5 to 2.5 m/s."
        " The intervals hold for commands of the kind in these logs."
    )
    # no number has an exponent
    limits = under(horizons=[horizon(100, errors(1234.0, 113.0))])
    lost = " ".join(write_verdict(evidence(limits_by_protocol=limits)))
    assert "is 1234 m (95 % prediction interval 1111 to 1357 m; 617 % of the 200 m" in lost


def test_a_model_as_near_as_the_plant_itself_is_good() -> None:
    """Another model is nearer, but within twice what the plant leaves all are alike."""
    entry = horizon(10, errors(0.5, 1.0), best=errors(0.2, 1.0))
    assert rate_model(evidence(limits_by_protocol=under(horizons=[entry]))) == "limited"
    models = {**entry.models, "plant": errors(0.4, 0.9)}
    entry = entry.model_copy(update={"models": models})
    rows = {"constant_velocity": row(0.5), "mlp": row(0.2), "plant": row(0.1, kind="plant")}
    assert (
        rate_model(evidence(limits_by_protocol=under(horizons=[entry]), rows_by_model=rows))
        == "good"
    )


def test_what_diverges_or_is_no_better_than_zero_is_never_good() -> None:
    limits = under(horizons=[horizon(30, errors(1.0, 1.0))])
    rows = {"constant_velocity": row(0.5), "baseline": row(0.25), "mlp": row(0.2, diverged=1)}
    assert rate_model(evidence(limits_by_protocol=limits, rows_by_model=rows)) == "limited"
    assert rate_model(evidence(error=0.6, limits_by_protocol=limits)) == "do not use"
    assert (
        rate_model(evidence(selected="constant_velocity", limits_by_protocol=limits))
        == "do not use"
    )
    assert rate_model(evidence(selected="unknown")) == ""


def test_other_protocols_add_horizons_and_do_not_change_the_level() -> None:
    main = protocol_limits(horizons=[horizon(10, errors(0.5, 2.0), windows=6)])
    other = protocol_limits(
        horizons=[horizon(10, errors(0.6, 2.0), windows=20), horizon(20, errors(9, 3))]
    )
    judged = evidence(limits_by_protocol={"whole": other, "T30": main})
    assert rate_model(judged) == "good"
    text = " ".join(write_verdict(judged))
    assert "After a 10 s free run the position error of mlp is 0.50 m" in text
    assert "6 free runs (T30)" in text
    assert "Other horizons: 9.0 m and 3.0 deg after 20 s (limited)." in text


def test_a_model_that_the_data_cannot_tell_from_zero_is_not_to_be_used() -> None:
    compared = {"mlp": {"constant_velocity": difference(-0.01, 0.1)}}
    given = evidence(
        limits_by_protocol=under(compared=compared, horizons=[horizon(30, errors(1, 1))])
    )
    assert rate_model(given) == "do not use"
    text = " ".join(write_verdict(given))
    assert "are not significantly smaller than those of constant velocity (0.500)" in text
    assert "lower than" not in text
    # too few logs for an interval tell neither
    unknown = under(compared={"mlp": {"constant_velocity": difference(-0.01, None)}})
    assert rate_model(evidence(limits_by_protocol=unknown)) == "limited"


def test_data_outside_the_training_range_and_the_doctor_are_told() -> None:
    limits = under(outside=OutsideRange(share=0.123, channels={"u": 0.1, "delta": 0.03}))
    said = write_verdict(
        evidence(
            limits_by_protocol=limits, data_quality_text="Data checks: nothing would mislead a fit."
        )
    )
    assert any(text.startswith("Of the test data, 12 % lies outside") for text in said)
    assert any("(u 10 %, delta 3.0 %)" in text for text in said)
    assert said[1] == "Data checks: nothing would mislead a fit."


def test_windows_unlike_those_that_calibrated_the_intervals_are_named() -> None:
    limits = under(beyond_calibration={"mlp": 0.4})
    sentence = "40 % of the test windows are farther from the training data than any run"
    assert any(
        text.startswith(sentence) for text in write_verdict(evidence(limits_by_protocol=limits))
    )
    limits = under(beyond_calibration={"mlp": 0.05, "hull": 1.0})
    verdict = write_verdict(evidence(limits_by_protocol=limits))
    assert not any("farther from the training" in text for text in verdict)


def test_an_old_run_without_these_files_still_has_a_verdict() -> None:
    said = write_verdict(evidence(selection=None, limits_by_protocol={}))
    assert said == [
        "On test data the velocity errors of mlp (NRMSE 0.200) are 60 % lower than those of"
        " constant velocity and 20 % lower than those of the baseline."
    ]


def test_a_split_that_is_too_short_is_judged_by_a_shorter_protocol() -> None:
    rows = [row(0.1, split="validation", protocol=name) for name in ("T30", "T100", "T10")]
    short = [*rows, row(0.1, protocol="T30"), row(0.1, protocol="T10")]
    assert order_protocols(short, "test", "T100") == ["T30", "T10", "T100"]
    assert order_protocols([*short, row(0.1, protocol="T100")], "test", "T100")[0] == "T100"
    assert order_protocols(short, "validation", "T100")[0] == "T100"


def test_the_main_protocol_has_windows_of_equal_length() -> None:
    rows = [row(0.1, protocol=name) for name in ("manoeuvre", "T30", "T10")]
    assert order_protocols(rows, "test", "manoeuvre")[0] == "manoeuvre"
    assert order_protocols(rows, "test", "manoeuvre", {"T30", "T10"})[0] == "T30"
    assert order_protocols(rows, "test", "T10", {"T30", "T10"})[0] == "T10"
    # a protocol with too few windows for a rating is not the main one
    rows[1] = rows[1].model_copy(update={"windows": 3})
    assert order_protocols(rows, "test", "T30", {"T30", "T10"})[0] == "T10"


def excitation(state: str, **change: Any) -> ExcitationFile:
    """Contents of excitation.json for a rudder in a state."""
    rudder: dict[str, Any] = {"name": "delta", "low": -0.3, "high": 0.3, "std": 0.1}
    rudder |= {"bandwidth": None, "variance_inflation": 1.0, "feedback_source": None}
    rudder |= {"feedback_share": None, "effect_share": None}
    rudder |= {"state": state, "text": f"delta was {state}"}
    content = {"schema": "residnet.excitation/1", "run": "made", "inputs": [rudder]}
    empty: dict[str, list[Any]] = {"directions": [], "closed_loop_test_inputs": [], "domain": []}
    return ExcitationFile.model_validate({**content, **empty, **change})


def test_inputs_that_cannot_be_identified_make_no_good_model() -> None:
    good = under(horizons=[horizon(10.0, errors(0.5, 2.0))])
    for state, level in (
        ("excited", "good"),
        ("held", "good"),
        ("feedback", "limited"),
        ("collinear", "limited"),
    ):
        judged = evidence(limits_by_protocol=good, excitation=excitation(state))
        assert rate_model(judged) == level
        text = " ".join(write_verdict(judged))
        assert ("the effect of delta cannot be identified" in text) == (level == "limited")
        assert ("Delta was held." in text) == (state == "held")


def test_the_verdict_names_unexcited_directions_and_controlled_test_logs() -> None:
    direction = {"name": "", "inputs": ["n_port", "n_stbd"], "ratio": 0.0}
    differential = {"text": "differential thrust: not excited", "is_excited": False}
    common = {"text": "common thrust: excited", "is_excited": True}
    found = excitation(
        "excited",
        directions=[direction | differential, direction | common],
        closed_loop_test_inputs=["delta"],
        domain=["n was held at 12 1/s."],
    )
    text = " ".join(write_verdict(evidence(excitation=found)))
    assert "Differential thrust: not excited. n was held at 12 1/s." in text
    assert "common thrust" not in text
    assert "for operation under the same controller only" in text


def test_a_level_from_zigzags_holds_for_such_commands_only() -> None:
    good = under(horizons=[horizon(10.0, errors(0.5, 2.0))])
    found = excitation("excited", relay_inputs=["delta"])
    sentences = write_verdict(evidence(limits_by_protocol=good, excitation=found))
    assert sentences[0].startswith("After a 10 s free run with commands like those in the logs the")
    assert sentences[1].startswith("Good for such commands: ")
    assert "only switch delta between the ends of its range" in sentences[2]
    assert advise_excitation(found, ["delta"]) == (
        "delta only switches between the ends of its range; run steps of delta to a quarter, a half"
        " and three quarters of its range, each held until the motion is steady.",
    )
    sentences = write_verdict(evidence(limits_by_protocol=good, excitation=excitation("excited")))
    assert "commands" not in " ".join(sentences[:3])


def test_velocities_that_leave_the_positions_make_no_model_good() -> None:
    good = horizon(30.0, errors(1.0, 1.0))
    assert rate_model(evidence(limits_by_protocol=under(horizons=[good]))) == "good"
    contradicting = good.model_copy(update={"floor": errors(12.6, 1.0)})
    limits = under(horizons=[contradicting])
    assert rate_model(evidence(limits_by_protocol=limits)) == "limited"
    sentences = " ".join(write_verdict(evidence(limits_by_protocol=limits)))
    assert "the measured velocities do not reproduce the measured track" in sentences
    assert "(21 % of the distance travelled; good: at most 10 %)" in sentences


@pytest.mark.parametrize(
    ("position_change", "heading_change", "level"),
    [
        ((-29.0, -20.0), (-0.7, -0.5), "good"),
        # better in position alone
        ((-29.0, -20.0), (-0.7, 0.1), "do not use"),
        ((-29.0, 3.0), (-0.7, -0.5), "do not use"),
    ],
)
def test_a_useful_model_is_significantly_better_than_constant_velocity_in_both(
    position_change: tuple[float, float], heading_change: tuple[float, float], level: str
) -> None:
    changes = {"mlp": {"position": position_change, "heading": heading_change}}
    entry = horizon(30, errors(3.0, 5.0)).model_copy(
        update={"change_from_constant_velocity": changes}
    )
    judged = evidence(limits_by_protocol=under(horizons=[entry]))
    assert rate_model(judged) == level
    text = " ".join(write_verdict(judged))
    assert ("is not significantly smaller than that of constant velocity" in text) == (
        level == "do not use"
    )


def test_without_a_paired_interval_prediction_intervals_must_not_overlap() -> None:
    """Constant velocity has 30 m (27 to 33 m); an error of 26 m is smaller, not significantly."""
    for position, level in ((3.0, "good"), (26.0, "do not use")):
        entry = horizon(30, errors(position, 5.0)).model_copy(update={"sailed": 300.0})
        judged = evidence(limits_by_protocol=under(horizons=[entry]))
        assert rate_model(judged) == level
