"""The task `roll` from config to page: one sea state, two directions, a hardly trained policy."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from pictures import omit_drawings
from read_page import Page, plain
from tiny import Command, call, write_yaml
from tiny_tasks import roll

from residnet.autopilot.records import RollMetricsFile, RollRow
from residnet.autopilot.report.roll import verdict_texts
from residnet.autopilot.tasks.roll.execute import estimate_rms_change

BEAM = math.radians(90)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("roll")
    file = write_yaml(folder / "roll.yaml", roll(folder))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        omit_drawings(patch)
        assert call(patch, "run", file, "--out", folder / "run") == 0
    return folder / "run"


@pytest.fixture(scope="module")
def metrics(run: Path) -> RollMetricsFile:
    return RollMetricsFile.read(run / "metrics.json")


def find_row(metrics: RollMetricsFile, model: str, direction: float) -> RollRow:
    return next(
        row
        for row in metrics.rows
        if row.model == model and row.direction == pytest.approx(direction)
    )


def test_metrics_follow_from_the_simulations(run: Path, metrics: RollMetricsFile) -> None:
    simulations = pd.read_parquet(run / "simulations.parquet")
    assert len(simulations) == 6 * 2 * 3
    assert len(metrics.rows) == 6 * 2
    for row in metrics.rows:
        is_row = (simulations["controller"] == row.model) & np.isclose(
            simulations["direction"], row.direction
        )
        assert row.roll_rms**2 == pytest.approx(simulations[is_row]["roll"].mean())
        reference = find_row(metrics, "heading", row.direction).roll_rms
        assert row.roll_reduction == pytest.approx(1 - row.roll_rms / reference)


def test_fins_amidships_reduce_no_roll_and_fin_control_does(metrics: RollMetricsFile) -> None:
    heading = find_row(metrics, "heading", BEAM)
    assert (heading.fin_rms, heading.roll_reduction) == (0.0, 0.0)
    assert find_row(metrics, "rudder", BEAM).fin_rms == 0.0
    fins = find_row(metrics, "fins", BEAM)
    assert fins.roll_reduction > 0.2
    assert fins.fin_rms > math.radians(1)


def test_following_long_crested_seas_have_no_roll_to_reduce(metrics: RollMetricsFile) -> None:
    assert [row.is_judged for row in metrics.rows if row.model == "heading"] == [False, True]
    assert metrics.comparison.n_seas == 1


def test_the_verdict_is_that_of_the_figures(run: Path, metrics: RollMetricsFile) -> None:
    comparison = metrics.comparison
    totals = {total.model: total for total in metrics.totals if total.sea_state is None}
    policy = totals[comparison.policy]
    classical = totals[comparison.classical]
    assert comparison.roll.value == pytest.approx(policy.roll_rms / classical.roll_rms - 1)
    assert comparison.heading.value == pytest.approx(policy.heading_rms / classical.heading_rms - 1)
    costs = {entry.model: entry.judged_cost for entry in metrics.controllers}
    assert costs[comparison.classical] == min(
        costs[name] for name in costs if name not in ("heading", "learned")
    )
    assert verdict_texts(metrics)[0] in plain(run / "report.html")


def test_the_page_has_the_table_of_seas(run: Path, metrics: RollMetricsFile) -> None:
    page = Page(plain(run / "report.html"))
    totals, seas = page.tables[:2]
    assert totals[-1][0] == "learned policy"
    # columns have the labels of the rows of the first table, not the names in metrics.json
    columns = seas[1][1:]
    assert columns[-1] == "learned policy"
    assert set(columns) <= {line[0] for line in totals}
    beam = next(line for line in seas if line[0] == "4, 90 deg")
    row = find_row(metrics, "learned", BEAM)
    assert f"{100 * row.roll_reduction:.1f}".replace("-", "−") in beam[2:4]
    assert f"{math.degrees(row.heading_rms):.3f}" == beam[-1]


def test_a_run_continues_with_its_fitted_controllers(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    before = (run / "metrics.json").read_text()
    (run / "summary.json").unlink()
    (run / "metrics.json").unlink()
    monkeypatch.chdir(run.parent)
    resumed = command("run", run.parent / "roll.yaml", "--out", run, "--resume")
    assert resumed.code == 0
    assert "training learned" not in resumed.err
    assert (run / "metrics.json").read_text() == before


def test_interval_of_an_equal_and_of_a_scaled_policy() -> None:
    squares = np.random.default_rng(1).uniform(0.5, 2.0, (4, 12))
    assert estimate_rms_change(squares, squares).interval == (0.0, 0.0)
    smaller = estimate_rms_change(0.81 * squares, squares)
    assert smaller.value == pytest.approx(-0.1)
    assert smaller.interval == pytest.approx((-0.1, -0.1))
    noisy = estimate_rms_change(squares[:, ::-1], squares)
    assert noisy.interval[0] < 0.0 < noisy.interval[1]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vessel": "patrol_p06"}, "vessel: patrol_p06 has no stabiliser fins"),
        ({"vessel": "patrol_fin"}, "did you mean 'patrol_fins'"),
        ({"fins": "30 deg"}, "fins: 30 deg exceed the 25 deg of patrol_fins"),
        ({"sea_states": [4, 4]}, "sea_states: each value may occur once"),
        ({"sea_states": [7]}, "sea_states"),
        ({"transient": "35 s"}, "duration (30 s) must be longer than transient (35 s)"),
        ({"judging": {"duration": "5 s"}}, "judging.duration (5 s) must be longer than"),
    ],
)
def test_errors_of_a_config_name_the_key(
    changes: dict[str, Any], message: str, tmp_path: Path, command: Command
) -> None:
    file = write_yaml(tmp_path / "roll.yaml", roll(tmp_path) | changes)
    checked = command("check", file, "--quiet")
    assert checked.code in (1, 2)
    assert message in checked.err
    assert checked.err.count("\n") == 1
