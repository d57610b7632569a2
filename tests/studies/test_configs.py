"""What the configs of the documents' studies refuse before any work, one row for each."""

from __future__ import annotations

from pathlib import Path

import pytest

from residnet.core.errors import ConfigError
from residnet.tasks.registry import load_task

STUDIES = Path(__file__).parents[2] / "configs" / "studies"
FERRY = "jervan2020/operation"
SEA = "jervan2020/measured"
GRID = "halvorsen2019/table_5_2"
TRIAL = "halvorsen2019/standard_model"
FAST = "rows={key: head.evolution.crossover, values: [0.1, 0.9]}"
REFUSED: tuple[tuple[str, tuple[str, ...], str], ...] = (
    (FERRY, ("true=wam_v_cal",), "actuators for surge, sway and yaw"),
    (FERRY, ("models.lag_ridge.on=nothing",), "no preceding model"),
    (FERRY, ("models.lag_ridge.terms=[u_dott]",), "u_dott"),
    (FERRY, ("course.interval=0.05",), "whole number of steps"),
    (SEA, ("models.ridge.lag=true",), "set force to 'commanded'"),
    (
        SEA,
        ("models.ridge.fit={kind: surface, choose: test}",),
        "selected on the samples of its evaluation",
    ),
    (SEA, ("models.ridge.terms=[u_dott]",), "u_dott"),
    (SEA, ("models.zero={fit: {kind: ols}}",), "is reserved for a reference model"),
    (SEA, ("believed=nomoto_mariner",), "a believed hull needs"),
    (SEA, ("models.ols.fit.order=3",), "an option of kind plsr"),
    (SEA, ("validation.gap=0",), "at least one step"),
    (SEA, ("prepare.hold=mean",), "nothing is simulated"),
    (GRID, ("rows.key=head.evolution.populaton",), "did you mean 'population'"),
    (
        GRID,
        (FAST, "~published", "~published_error"),
        "their sum is a share of the offspring and at most 1",
    ),
    (GRID, ("published=[[1, 2]]",), "expected . rows of . numbers"),
    (TRIAL, ("standard.weights=[1, 1, 0]",), "positive"),
    (TRIAL, ("equations.force.head.features=[u]",), "give `inputs` instead"),
    (TRIAL, ("equations.force.head.candidates.coupling=[cmd_n]",), "'cmd_n' is not a channel"),
    (TRIAL, ("trials.calm.vessel=odin_forces",), "needs a vessel of kind 'odin' with water jets"),
    ("moreno2019/moreno2019", ("~heads.p2_each", "~base_of.p2_each"), "'p2_each' is absent"),
    ("woo2018/woo2018", ("~heads.lstm_rate", "~training.lstm_rate"), "or leave the study out"),
)


@pytest.mark.parametrize(("study", "overrides", "said"), REFUSED, ids=lambda value: str(value)[:60])
def test_load_task_refuses_impossible_studies(
    study: str,
    overrides: tuple[str, ...],
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    with pytest.raises(ConfigError, match=said) as caught:
        load_task(STUDIES / f"{study}.yaml", list(overrides))
    assert "\n" not in str(caught.value)


def test_load_task_without_study_and_its_models(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RESIDNET_DATA", str(tmp_path))
    over = ["~heads.lstm_rate", "~training.lstm_rate", "study=null"]
    assert load_task(STUDIES / "woo2018" / "woo2018.yaml", over).name
