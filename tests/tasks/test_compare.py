"""`residnet compare`, `runs`, `--version`, `--quiet`, `--json`, `-v`: what stands beside a run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from made_run import KINDS, MODELS, RESOLVED, made_run, write_json, write_rollout
from read_page import plain

from residnet.core.errors import UsageError
from residnet.tasks.compare import compare_runs, judged_runs, paired
from residnet.tasks.registry import runs_below, runs_text


def judged(folder: Path, size: float) -> Path:
    """A finished fit whose models are off by so much; `plsr` is selected."""
    made_run(folder)
    # five logs and more have an interval
    for log in (*KINDS, "turning_02", "turning_03"):
        write_rollout(folder / "rollouts" / "test", log, tuple(MODELS), size)
    resolved = RESOLVED.replace("name: made", f"name: {folder.name}")
    (folder / "resolved.yaml").write_text(f"{resolved}seed: {size}\n")
    summary = {
        "schema": "residnet.summary/1",
        "task": "fit",
        "finished": True,
        "verdict": ["Fine."],
    }
    figures = {"nrmse": {"value": size, "unit": "-"}}
    write_json(folder / "summary.json", {**summary, "figures": figures})
    return folder


def test_two_runs_side_by_side(tmp_path: Path) -> None:
    first, second = judged(tmp_path / "first", 1.0), judged(tmp_path / "second", 0.5)
    text, page = compare_runs([first, second], tmp_path / "out")
    entry = paired(judged_runs([first, second]))["whole"]["second"]
    # the nrmse of plsr is 0.08
    assert (entry["mean"], entry["nrmse_mean"]) == pytest.approx((0.04, -0.04))
    assert entry["ci95"] == pytest.approx([-0.04, -0.04])
    assert "second (plsr) has the least error: -0.040 against first, beyond chance." in text
    assert "seed" in text
    content = plain(page)
    assert "Where the runs differ" in content
    assert "Error against horizon" in content


def test_runs_of_other_velocities_are_compared_by_what_both_move(tmp_path: Path) -> None:
    first, second = judged(tmp_path / "first", 1.0), judged(tmp_path / "second", 0.5)
    metrics = json.loads((second / "metrics.json").read_text())
    metrics["scales"] = {"u": 0.5}
    for row in metrics["rows"]:
        row["rmse"] = {"u": row["rmse"]["u"]}
    write_json(second / "metrics.json", metrics)
    entry = paired(judged_runs([first, second]))["whole"]["second"]
    # of u alone
    assert entry["nrmse_mean"] == pytest.approx(-0.04)
    _, page = compare_runs([first, second], tmp_path / "out")
    assert "mean over u." in plain(page)


def test_a_part_that_one_run_lacks_stands_in_one_line(tmp_path: Path) -> None:
    first, second = judged(tmp_path / "first", 1.0), judged(tmp_path / "second", 0.5)
    for folder, more in (
        (first, "heads: {mlp: {kind: mlp, hidden: [16], dropout: 0.1}}"),
        (second, "heads: {}"),
    ):
        with (folder / "resolved.yaml").open("a") as file:
            file.write(f"{more}\n")
    text, _ = compare_runs([first, second], tmp_path / "out")
    (line,) = [line for line in text.splitlines() if line.startswith("heads")]
    assert line.split() == ["heads.mlp", "there", "(kind", "mlp)", "not", "there"]
    assert "same" not in text


def test_runs_without_a_common_log(tmp_path: Path) -> None:
    first, second = judged(tmp_path / "first", 1.0), judged(tmp_path / "second", 0.5)
    shutil.rmtree(second / "rollouts" / "test")
    text, _ = compare_runs([first, second], tmp_path / "out")
    assert "no window of a log in common" in text


def test_what_cannot_be_compared(tmp_path: Path) -> None:
    first = judged(tmp_path / "first", 0.3)
    with pytest.raises(UsageError, match="name at least two runs"):
        compare_runs([first], tmp_path / "out")
    with pytest.raises(UsageError, match="named twice"):
        compare_runs([first, first], tmp_path / "out")
    second = judged(tmp_path / "second", 0.2)
    (second / "metrics.json").unlink()
    with pytest.raises(UsageError, match="runs of fits can be compared"):
        compare_runs([first, second], tmp_path / "out")


def test_the_list_of_runs(tmp_path: Path) -> None:
    judged(tmp_path / "good", 0.3)
    (judged(tmp_path / "deep" / "cut", 0.2) / "summary.json").write_text("{")
    (judged(tmp_path / "open", 0.1) / "summary.json").unlink()
    entries = {Path(entry["run"]).name: entry for entry in runs_below(tmp_path)}
    assert {name: entry["state"] for name, entry in entries.items()} == {
        "good": "finished",
        "cut": "damaged",
        "open": "unfinished",
    }
    text = runs_text(tmp_path, runs_below(tmp_path))
    assert "nrmse 0.3" in text
    assert runs_text(tmp_path / "none", []).endswith("no runs")
    with pytest.raises(UsageError, match="no such folder"):
        runs_below(tmp_path / "nowhere")
