"""A whole run: its folder, its repeatability, and its life after a kill."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml
from tiny import call
from tiny_tasks import measured


def rows(run: Path) -> list[dict[str, Any]]:
    content: list[dict[str, Any]] = json.loads((run / "metrics.json").read_text())["rows"]
    return content


def test_folder_is_complete(tiny_run: Path) -> None:
    for name in (
        "resolved.yaml",
        "provenance.json",
        "metrics.json",
        "report.html",
        "data_quality.json",
        "residuals.parquet",
        "exports/lstm.pt",
    ):
        assert (tiny_run / name).stat().st_size > 0, name
    models = {path.name for path in (tiny_run / "models").iterdir()}
    assert models == {"zero", "baseline", "ridge", "lstm", "mean"}
    assert {path.suffix for path in (tiny_run / "models").rglob("*") if path.is_file()} == {
        ".json",
        ".safetensors",
    }


def test_ensemble_averages_accelerations(tiny_run: Path) -> None:
    from residnet.dynamics.store import load_model

    models = {
        name: load_model(tiny_run / "models" / name)[1].double()
        for name in ("ridge", "lstm", "mean")
    }
    random = torch.Generator().manual_seed(0)
    y, w = (
        torch.rand(3, 7, 6, generator=random, dtype=torch.float64),
        20 * torch.rand(3, 7, 2, generator=random, dtype=torch.float64),
    )
    rates = {}
    for name, model in models.items():
        p = model.signals.prepare(w[:, -1])
        rho, _ = model.head(model.signals(y[:, -1], p), model.warmup(y[:, :-1], w[:, :-1]))
        rates[name] = model.rate(y[:, -1], p, rho)[:, 3:]
    torch.testing.assert_close(rates["mean"], (rates["ridge"] + rates["lstm"]) / 2)


def test_metrics_follow_from_rollouts(tiny_run: Path) -> None:
    parts = []
    for path in (tiny_run / "rollouts" / "test").glob("*.parquet"):
        parts.append(pd.read_parquet(path).assign(log=path.stem))
    table = pd.concat(parts)
    for row in rows(tiny_run):
        if row["split"] != "test" or row["manoeuvre"] != "all":
            continue
        own = table[(table.model == row["model"]) & (table.protocol == row["protocol"])]
        groups = list(own.groupby(["log", "window"]))
        assert len(groups) == row["windows"]
        for name in ("u", "v", "r"):
            each = [np.sqrt(np.mean((g[f"{name}_hat"] - g[name]) ** 2)) for _, g in groups]
            assert row["rmse"][name] == pytest.approx(np.mean(each), rel=1e-9)


def test_truth_and_heads_beat_the_baseline(tiny_run: Path) -> None:
    error = {
        row["model"]: row["nrmse"]["mean"]
        for row in rows(tiny_run)
        if row["split"] == "test" and row["protocol"] == "manoeuvre" and row["manoeuvre"] == "all"
    }
    assert error["truth"] < error["ridge"] < error["baseline"] < error["zero"]
    assert sum(row["diverged"] for row in rows(tiny_run)) == 0


@pytest.mark.long
def test_same_seed_same_metrics(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert call(monkeypatch, "run", tiny_config, "--out", tmp_path / "again") == 0
    assert rows(tmp_path / "again") == rows(tiny_run)


@pytest.mark.long
def test_another_seed_other_head(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert call(monkeypatch, "run", tiny_config, "-s", "seed=1", "--out", tmp_path / "other") == 0
    changed = {
        row["model"]
        for row, old in zip(rows(tmp_path / "other"), rows(tiny_run), strict=True)
        if row["rmse"] != old["rmse"]
    }
    assert changed == {"lstm", "mean"}


@pytest.mark.long
def test_killed_and_resumed(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "killed"
    command = [sys.executable, "-m", "residnet.cli", "run", str(tiny_config), "--out", str(out)]
    process = subprocess.Popen(
        command,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    checkpoint = out / "checkpoints" / "lstm" / "last.ckpt"
    for _ in range(1200):
        if checkpoint.is_file() or process.poll() is not None:
            break
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert checkpoint.is_file()
    epoch = torch.load(checkpoint, weights_only=True)["epoch"]
    assert epoch < 6 or not (out / "metrics.json").is_file()
    assert call(monkeypatch, "run", tiny_config, "--out", out, "--resume") == 0
    assert rows(out) == rows(tiny_run)


@pytest.mark.long
def test_models_read_back_give_the_same_rows(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed after the last training: what is judged has been read from the folder."""
    out = tmp_path / "late"
    shutil.copytree(tiny_run / "models", out / "models")
    shutil.copy(tiny_run / "resolved.yaml", out)
    assert call(monkeypatch, "run", tiny_config, "--out", out, "--resume") == 0
    assert rows(out) == rows(tiny_run)


@pytest.mark.long
def test_evaluate_on_the_training_logs_gives_the_numbers_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(measured(tmp_path), sort_keys=False))
    assert call(monkeypatch, "run", config, "--out", tmp_path / "run") == 0
    logs = [word for i in range(4) for word in ("--logs", tmp_path / "logs" / f"log_{i}.csv")]
    out = tmp_path / "again"
    assert call(monkeypatch, "evaluate", tmp_path / "run", *logs, "--out", out) == 0
    own = [row for row in rows(tmp_path / "run") if row["split"] == "train"]
    assert rows(out) == [row | {"split": "external"} for row in own]


def test_resume_needs_the_same_configuration(
    tiny_config: Path,
    tiny_run: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert call(monkeypatch, "run", tiny_config, "-s", "seed=9", "--out", tiny_run, "--resume") == 2
    assert "another configuration" in capsys.readouterr().err


def test_exported_module_runs_without_residnet(tiny_run: Path, tmp_path: Path) -> None:
    script = """
import json, sys, torch
sys.modules["residnet"] = None
files = {"card.json": ""}
model = torch.jit.load(sys.argv[1], _extra_files=files)
card = json.loads(files["card.json"])
assert [s["name"] for s in card["states"]] == ["x", "y", "psi", "u", "v", "r"]
s = model.warmup(torch.zeros(2, 5, 6), torch.full((2, 5, 2), 10.0))
x = torch.zeros(2, 6)
w = torch.full((2, 40, 2), 10.0)
single = [x]
m = s
for k in range(40):
    x, m, outside = model.step(x, w[:, k], m)
    single.append(x)
assert outside.shape == (2,) and not outside.any()
assert model.step(x, w[:, 0] * 100, m)[2].all()
whole, last, flags = model.rollout(torch.zeros(2, 6), w, s)
assert torch.equal(last, m) and flags.shape == (2, 40) and not flags.any()
assert (whole - torch.stack(single, 1)).abs().max() < 1e-6
assert model.initial_state(3).shape == (3, card["memory"])
print(float(x[0, 3]))
"""
    file = tmp_path / "plain.py"
    file.write_text(script)
    result = subprocess.run(
        [sys.executable, str(file), str(tiny_run / "exports" / "lstm.pt")],
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stderr
    assert 0.05 < float(result.stdout.splitlines()[-1]) < 2.5
