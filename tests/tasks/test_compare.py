"""`residnet compare`, `runs`, `--version`, `--quiet`, `--json`, `-v`: what stands beside a run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from read_page import plain

from residnet.core.errors import UsageError
from residnet.tasks.compare import compare_runs, judged_runs, paired
from residnet.tasks.registry import runs_below, runs_text


def made_run(folder: Path, size: float, *, task: str = "fit") -> Path:
    """A finished fit whose selected model is off by `size` in u; six logs of two windows."""
    (folder / "rollouts" / "test").mkdir(parents=True)
    (folder / "resolved.yaml").write_text(f"task: {task}\nname: {folder.name}\nseed: {size}\n")
    summary = {
        "schema": "residnet.summary/1",
        "task": task,
        "finished": True,
        "verdict": ["Fine."],
        "figures": {"nrmse": {"value": size, "unit": "-"}},
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    row = {
        "model": "linear",
        "kind": "baseline",
        "split": "test",
        "protocol": "T2",
        "manoeuvre": "all",
        "windows": 12,
        "diverged": 0,
        "rmse": {"u": size, "v": 0.1, "r": 0.01},
        "nrmse": {"u": size, "v": 1.0, "r": 1.0, "mean": size},
    }
    metrics = {
        "schema": "residnet.metrics/1",
        "run": folder.name,
        "channels": {},
        "scales": {"u": 1.0, "v": 1.0, "r": 1.0},
        "selected": "linear",
        "rows": [row],
    }
    (folder / "metrics.json").write_text(json.dumps(metrics))
    for log in range(6):
        random = np.random.default_rng(log)
        t = np.concatenate([start + 0.1 * np.arange(21) for start in (0.0, 2.0)])
        table = pd.DataFrame({"t": t, "window": np.repeat([0, 1], 21)})
        table["protocol"], table["model"], table["usable"] = "T2", "linear", True
        table["diverged"] = False
        for name in ("u", "v", "r", "psi", "x", "y"):
            table[name] = random.standard_normal(t.size)
            table[f"{name}_hat"] = table[name] + (size if name == "u" else 0.0)
        table.to_parquet(folder / "rollouts" / "test" / f"log{log}.parquet")
    return folder


def test_two_runs_side_by_side(tmp_path: Path) -> None:
    first, second = made_run(tmp_path / "first", 0.3), made_run(tmp_path / "second", 0.15)
    text, page = compare_runs([first, second], tmp_path / "out")
    entry = paired(judged_runs([first, second]))["T2"]["second"]
    # a third of the error of u, as the mean over u, v, r
    assert entry["nrmse_mean"] == pytest.approx(-0.05)
    assert entry["ci95"] == pytest.approx([-0.05, -0.05])
    assert "second (linear) has the least error: -0.050 against first, beyond chance." in text
    assert "seed" in text
    content = plain(page)
    assert "Where the runs differ" in content
    assert "Error against horizon" in content


def test_runs_of_other_velocities_are_compared_by_what_both_move(tmp_path: Path) -> None:
    first, second = made_run(tmp_path / "first", 0.3), made_run(tmp_path / "second", 0.15)
    metrics = json.loads((second / "metrics.json").read_text())
    metrics["scales"] = {"u": 1.0}
    metrics["rows"][0] |= {"rmse": {"u": 0.15}, "nrmse": {"u": 0.15, "mean": 0.15}}
    (second / "metrics.json").write_text(json.dumps(metrics))
    entry = paired(judged_runs([first, second]))["T2"]["second"]
    assert entry["nrmse_mean"] == pytest.approx(-0.15)
    _, page = compare_runs([first, second], tmp_path / "out")
    assert "mean over u." in plain(page)


def test_a_part_that_one_run_lacks_stands_in_one_line(tmp_path: Path) -> None:
    first, second = made_run(tmp_path / "first", 0.3), made_run(tmp_path / "second", 0.15)
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
    first, second = made_run(tmp_path / "first", 0.3), made_run(tmp_path / "second", 0.15)
    shutil.rmtree(second / "rollouts" / "test")
    text, _ = compare_runs([first, second], tmp_path / "out")
    assert "no window of a log in common" in text


def test_what_cannot_be_compared(tmp_path: Path) -> None:
    first = made_run(tmp_path / "first", 0.3)
    with pytest.raises(UsageError, match="name at least two runs"):
        compare_runs([first], tmp_path / "out")
    with pytest.raises(UsageError, match="named twice"):
        compare_runs([first, first], tmp_path / "out")
    second = made_run(tmp_path / "second", 0.2)
    (second / "metrics.json").unlink()
    with pytest.raises(UsageError, match="runs of fits can be compared"):
        compare_runs([first, second], tmp_path / "out")


def test_the_list_of_runs(tmp_path: Path) -> None:
    made_run(tmp_path / "good", 0.3)
    (made_run(tmp_path / "deep" / "cut", 0.2) / "summary.json").write_text("{")
    (made_run(tmp_path / "open", 0.1) / "summary.json").unlink()
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
