"""`residnet compare`, `runs`, `--version`, `--quiet`, `--json`, `-v`: what stands beside a run."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from read_page import plain
from tiny import call

from residnet.core.errors import DataError, UsageError
from residnet.core.progress import say
from residnet.core.version import __version__
from residnet.runs.folder import RunFolder
from residnet.runs.task import Outcome
from residnet.tasks.compare import compare_runs, judged_runs, paired
from residnet.tasks.registry import runs_below, runs_text
from residnet.tasks.simulate import SimulateConfig


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


def test_version_and_list_on_the_command_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    made_run(tmp_path / "good", 0.3)
    assert call(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.strip() == f"residnet {__version__}"
    assert call(monkeypatch, "runs", tmp_path, "--json") == 0
    assert json.loads(capsys.readouterr().out)[0]["best"]["value"] == 0.3


FLY = (
    "task: simulate\nname: fly\nprogramme:\n  vessel: wam_v_cal\n  duration: 5 s\n"
    "  manoeuvres: [{kind: constant, name: turn, drive: 0.5, steer: 0.3}]\n"
)


@pytest.mark.parametrize("error", [DataError("no such wind"), KeyboardInterrupt(), ValueError("x")])
def test_the_log_of_a_run_that_ends_badly(
    error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lines and the traceback stay, and the next one goes on behind them."""

    def broken(self: SimulateConfig, folder: RunFolder) -> Outcome:
        say("the wind rises")
        raise error

    monkeypatch.chdir(tmp_path)
    (tmp_path / "fly.yaml").write_text(FLY)
    with monkeypatch.context() as patch:
        patch.setattr(SimulateConfig, "carry_out", broken)
        assert call(monkeypatch, "run", "fly.yaml", "--out", "run", "-v", "--quiet") != 0
    text = (tmp_path / "run/log.txt").read_text()
    assert "the wind rises\n" in text
    assert "in broken" in text
    assert type(error).__name__ in text
    assert call(monkeypatch, "run", "fly.yaml", "--out", "run", "-v", "--resume") == 0
    assert (tmp_path / "run/log.txt").read_text().startswith(text)


def test_the_log_of_a_run_without_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "fly.yaml").write_text(FLY)
    (tmp_path / "run").mkdir()
    (tmp_path / "run/mine.txt").write_text("not a run")
    assert call(monkeypatch, "run", tmp_path / "fly.yaml", "--out", tmp_path / "run", "-v") == 2
    assert "UsageError" in (tmp_path / "run.log.txt").read_text()
    assert [entry.name for entry in (tmp_path / "run").iterdir()] == ["mine.txt"]


def test_a_quiet_run_for_machines(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "fly.yaml"
    config.write_text(FLY)
    out = tmp_path / "run"
    code = call(monkeypatch, "run", config, "--out", out, "--json", "-v")
    assert code == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["folder"] == str(out)
    assert told.err == ""
    assert (out / "log.txt").is_file()
