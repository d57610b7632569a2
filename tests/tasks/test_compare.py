"""`residnet compare` and `runs`: what stands beside a run."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from made_run import KINDS, MODELS, RESOLVED, made_run, write_json, write_rollout
from read_page import plain
from tiny import read_json

from residnet.core.errors import UsageError
from residnet.core.run_loader import accept_run
from residnet.tasks.compare import compare_paired, compare_runs, open_fit_runs
from residnet.tasks.registry import format_runs, list_runs


def judged(folder: Path, size: float, more: str = "") -> Path:
    """A finished fit whose models are off by so much; `plsr` is selected, its nrmse 0.08 of it."""
    made_run(folder)
    # five logs and more have an interval
    for log in (*KINDS, "turning_02", "turning_03"):
        write_rollout(folder / "rollouts" / "test", log, tuple(MODELS), size)
    resolved = RESOLVED.replace("name: made", f"name: {folder.name}")
    (folder / "resolved.yaml").write_text(f"{resolved}seed: {size}\n{more}\n")
    summary = {
        "schema": "residnet.summary/1",
        "task": "fit",
        "finished": True,
        "verdict": ["Fine."],
    }
    figures = {"nrmse": {"value": size, "unit": "-"}}
    write_json(folder / "summary.json", {**summary, "figures": figures})
    accept_run(folder)
    return folder


@pytest.fixture
def two(tmp_path: Path) -> list[Path]:
    """Runs of which the second is half as far off and lacks a head."""
    head = "heads: {mlp: {kind: mlp, hidden: [16], dropout: 0.1}}"
    first = judged(tmp_path / "first", 1.0, head)
    return [first, judged(tmp_path / "second", 0.5, "heads: {}")]


def test_two_runs_side_by_side(two: list[Path], tmp_path: Path) -> None:
    text, page = compare_runs(two, tmp_path / "out")
    entry = compare_paired(open_fit_runs(two))["whole"]["second"]
    assert (entry.nrmse, entry.difference.nrmse_mean) == pytest.approx((0.04, -0.04))
    assert entry.difference.ci95 == pytest.approx((-0.04, -0.04))
    assert (
        "second (plsr) has the lowest error: NRMSE 0.0400 instead of 0.0800 of first (plsr);"
        " the difference is significant." in text
    )
    assert "seed" in text
    assert "same" not in text
    assert "Where the runs differ" in plain(page)
    assert "Error against horizon" in plain(page)
    # a part that one of them lacks stands in one line
    (line,) = [line for line in text.splitlines() if line.startswith("heads")]
    assert line.split() == ["heads.mlp", "set", "(kind", "mlp)", "not", "set"]
    shutil.rmtree(two[1] / "rollouts" / "test")
    accept_run(two[1])
    assert "no common window" in compare_runs(two, tmp_path / "again")[0]


def test_runs_of_other_velocities_are_compared_by_what_both_move(
    two: list[Path], tmp_path: Path
) -> None:
    metrics = read_json(two[1] / "metrics.json")
    metrics["scales"] = {"u": 0.5}
    for row in metrics["rows"]:
        row["rmse"] = {"u": row["rmse"]["u"]}
    write_json(two[1] / "metrics.json", metrics)
    accept_run(two[1])
    entry = compare_paired(open_fit_runs(two))["whole"]["second"]
    # of u alone
    assert entry.difference.nrmse_mean == pytest.approx(-0.04)
    assert "mean over u." in plain(compare_runs(two, tmp_path / "out")[1])


def test_what_cannot_be_compared(two: list[Path], tmp_path: Path) -> None:
    (two[1] / "metrics.json").unlink()
    accept_run(two[1])
    for runs, said in (
        (two[:1], "name at least two runs"),
        (two[:1] * 2, "given twice"),
        (two, "metrics.json"),
    ):
        with pytest.raises(UsageError, match=said):
            compare_runs(runs, tmp_path / "out")


def test_the_list_of_runs_tells_how_each_ended(tmp_path: Path) -> None:
    judged(tmp_path / "good", 0.3)
    (judged(tmp_path / "deep" / "cut", 0.2) / "summary.json").write_text("{")
    (judged(tmp_path / "open", 0.1) / "summary.json").unlink()
    entries = list_runs(tmp_path)
    states = {Path(entry.run).name: entry.state for entry in entries}
    assert states == {"good": "finished", "cut": "damaged", "open": "unfinished"}
    assert "nrmse 0.3" in format_runs(tmp_path, entries)
    assert format_runs(tmp_path / "none", []).endswith("no runs")
    with pytest.raises(UsageError, match="no such folder"):
        list_runs(tmp_path / "nowhere")
