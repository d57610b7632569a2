"""A whole run: its folder, its numbers, its repeatability, and its life after a kill."""

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
from tiny import TINY, Command, read_json, write_yaml

from residnet.core.config import validate_config
from residnet.dynamics.store import load_model
from residnet.evaluation.verdict import LEVEL_TEXTS
from residnet.manoeuvres.trials_config import SimulatedTrials

ALONE: dict[str, Any] = {**TINY, "ensembles": {}, "training": {}, "export": {"models": []}}


def rows(run: Path) -> list[dict[str, Any]]:
    content: list[dict[str, Any]] = read_json(run / "metrics.json")["rows"]
    return content


def notes(run: Path, model: str) -> dict[str, Any]:
    content: dict[str, Any] = read_json(run / "models" / model / "fit.json")
    return content


def test_the_folder_holds_models_as_plain_numbers_and_what_was_found(tiny_run: Path) -> None:
    made = ("resolved.yaml", "provenance.json", "metrics.json", "report.html", "exports/lstm.pt")
    for name in (*made, "data_quality.json", "residuals.parquet"):
        assert (tiny_run / name).stat().st_size > 0, name
    models = {path.name for path in (tiny_run / "models").iterdir()}
    assert models == {"constant_velocity", "baseline", "ridge", "lstm", "ensemble"}
    kinds = {path.suffix for path in (tiny_run / "models").rglob("*") if path.is_file()}
    assert kinds == {".json", ".safetensors"}


def test_the_card_of_an_export_holds_what_the_run_says(tiny_run: Path) -> None:
    extra = {"card.json": ""}
    torch.jit.load(str(tiny_run / "exports" / "lstm.pt"), _extra_files=extra)
    card = json.loads(extra["card.json"])
    doctor = read_json(tiny_run / "doctor.json")
    summary = read_json(tiny_run / "summary.json")
    assert card["level"] in LEVEL_TEXTS
    assert all(sentence.strip() for sentence in card["verdict"])
    assert card["verdict"]
    if summary["level"] == card["level"]:
        assert set(card["verdict"]) & set(summary["verdict"])
    said = [row for log in doctor["logs"] for row in log["findings"]] + doctor["together"]
    codes = [row["code"] for row in said if row["level"] != "note"]
    assert [row["code"] for row in card["findings"]] == codes
    quality = read_json(tiny_run / "data_quality.json")
    logs = [name for names in card["split"].values() for name in names]
    assert sorted(logs) == sorted(row["log"] for row in quality)
    trained = [row["log"] for row in quality if row["split"] == "train"]
    assert card["split"]["identification"] == trained
    assert trained


def test_an_ensemble_averages_accelerations(tiny_run: Path) -> None:
    random = torch.Generator().manual_seed(0)
    y = torch.rand(3, 7, 6, generator=random, dtype=torch.float64)
    w = 20 * torch.rand(3, 7, 2, generator=random, dtype=torch.float64)
    rates = {}
    for name in ("ridge", "lstm", "ensemble"):
        model = load_model(tiny_run / "models" / name)[1].double()
        p = model.signals.prepare(w[:, -1])
        rho, _ = model.head(model.signals(y[:, -1], p), model.warmup(y[:, :-1], w[:, :-1]))
        rates[name] = model.state_derivative(y[:, -1], p, rho)[:, 3:]
    torch.testing.assert_close(rates["ensemble"], (rates["ridge"] + rates["lstm"]) / 2)


def test_metrics_follow_from_the_stored_free_runs(tiny_run: Path) -> None:
    files = (tiny_run / "rollouts" / "test").glob("*.parquet")
    table = pd.concat([pd.read_parquet(path).assign(log=path.stem) for path in files])
    own_rows = [r for r in rows(tiny_run) if (r["split"], r["manoeuvre"]) == ("test", "all")]
    assert len(own_rows) == 12
    for row in own_rows:
        own = table[(table.model == row["model"]) & (table.protocol == row["protocol"])]
        groups = list(own.groupby(["log", "window"]))
        assert len(groups) == row["windows"]
        for name in ("u", "v", "r"):
            each = [np.sqrt(np.mean((g[f"{name}_hat"] - g[name]) ** 2)) for _, g in groups]
            assert row["rmse"][name] == pytest.approx(np.mean(each), rel=1e-9)
    error = {r["model"]: r["nrmse"]["mean"] for r in own_rows if r["protocol"] == "manoeuvre"}
    assert error["plant"] < error["ridge"] < error["baseline"] < error["constant_velocity"]
    assert sum(row["diverged"] for row in rows(tiny_run)) == 0
    # the summary has the main horizon: whole manoeuvres of three logs are too few windows
    main_error = {r["model"]: r["nrmse"]["mean"] for r in own_rows if r["protocol"] == "T10"}
    figures = read_json(tiny_run / "summary.json")["figures"]
    assert figures["nrmse"]["value"] == main_error[read_json(tiny_run / "metrics.json")["selected"]]


def test_goodness_of_every_model_and_axis_agrees_with_the_stored_residuals(tiny_run: Path) -> None:
    for found in read_json(tiny_run / "goodness.json")["splits"].values():
        by = {(row["model"], row["axis"]): row for row in found}
        assert len(by) == len(found) == 3 * 5
        for axis in ("u_dot", "v_dot", "r_dot"):
            names = ("constant_velocity", "baseline", "ridge", "lstm")
            counts = [by[name, axis]["parameters"] for name in names]
            assert counts[0] == 0
            assert counts == sorted(set(counts))
            assert by["constant_velocity", axis]["r2"] <= 1e-9 < by["baseline", axis]["r2"]
            assert by["ridge", axis]["difference"]["to"] == "baseline"
            low, high = by["ridge", axis]["mae_ci95"]
            assert low < by["ridge", axis]["mae"] < high
    stored = pd.read_parquet(tiny_run / "residuals.parquet")
    for name, part in stored[stored.model == "ridge"].groupby("axis"):
        # only every so manieth sample is stored
        error = float(((part.target - part.predicted) ** 2).mean() ** 0.5)
        assert error == pytest.approx(by["ridge", name]["rmse"], rel=0.1)


@pytest.mark.long
def test_another_seed_changes_the_networks_alone(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, command: Command
) -> None:
    assert command("run", tiny_config, "-s", "seed=1", "--out", tmp_path / "other").code == 0
    pairs = zip(rows(tmp_path / "other"), rows(tiny_run), strict=True)
    assert {row["model"] for row, old in pairs if row["rmse"] != old["rmse"]} == {
        "lstm",
        "ensemble",
    }


@pytest.mark.long
def test_a_run_that_was_killed_ends_with_the_same_numbers(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, command: Command
) -> None:
    out = tmp_path / "killed"
    words = [sys.executable, "-m", "residnet.cli", "run", str(tiny_config), "--out", str(out)]
    quiet: dict[str, Any] = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    process = subprocess.Popen(words, **quiet, env={**os.environ, "OMP_NUM_THREADS": "1"})
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
    assert command("run", tiny_config, "--out", out, "--resume").code == 0
    assert rows(out) == rows(tiny_run)


@pytest.mark.long
def test_models_that_are_read_back_are_judged_alike(
    tiny_config: Path, tiny_run: Path, tmp_path: Path, command: Command
) -> None:
    """Killed after the last training: what is judged has been read from the folder."""
    out = tmp_path / "late"
    shutil.copytree(tiny_run / "models", out / "models")
    for name in ("resolved.yaml", "checksums.json"):
        shutil.copy(tiny_run / name, out)
    assert command("run", tiny_config, "--out", out, "--resume").code == 0
    assert rows(out) == rows(tiny_run)


ALONE_WITH_TORCH = """
import json, sys, torch
sys.modules["residnet"] = None
files = {"card.json": ""}
model = torch.jit.load(sys.argv[1], _extra_files=files)
card = json.loads(files["card.json"])
assert [s["name"] for s in card["states"]] == ["x", "y", "psi", "u", "v", "r"]
s = model.warmup(torch.zeros(2, 5, 6), torch.full((2, 5, 2), 10.0))
x, m, w = torch.zeros(2, 6), s, torch.full((2, 40, 2), 10.0)
single = [x]
for k in range(40):
    x, m, outside = model.step(x, w[:, k], m)
    single.append(x)
assert outside.shape == (2,) and not outside.any()
assert model.step(x, w[:, 0] * 100, m)[2].all()
whole, last, flags = model.rollout(torch.zeros(2, 6), w, s)
assert torch.equal(last, m) and flags.shape == (2, 40) and not flags.any()
assert (whole - torch.stack(single, 1)).abs().max() < 1e-6
assert model.initial_state(3).shape == (3, card["memory"])
assert 0.05 < float(x[0, 3]) < 2.5
"""


def test_an_exported_module_runs_without_residnet(tiny_run: Path) -> None:
    words = [sys.executable, "-c", ALONE_WITH_TORCH, str(tiny_run / "exports" / "lstm.pt")]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.long
def test_models_carry_the_solution_whose_free_run_is_best(tmp_path: Path, command: Command) -> None:
    """Of several solutions that validation logs choose between; fit.json says what was tried."""
    ridge = {"kind": "ridge", "choose": "free_run", "penalties": [1.0e-6, 1.0e-2]}
    plsr = {"kind": "plsr", "choose": "free_run", "features": ["u", "v", "r", "tau_n"]}
    plsr["terms"] = ["u", "v", "r", "tau_n", "u|u|", "r|r|"]
    poly = {"kind": "regressors", "sets": ["polynomial_2"], "ridge": [1.0e-5, 1.0e-1]}
    nomoto = {"kind": "nomoto_sideslip", "drive": "tau_x", "steer": "tau_n"}
    config = {**ALONE, "baselines": {"poly": poly, "nomoto": nomoto}}
    config["heads"] = {"plsr": plsr, "ridge": ridge}
    run = tmp_path / "run"
    assert command("run", write_yaml(tmp_path / "c.yaml", config), "--out", run).code == 0
    for name, key, count in (("poly", "ridge", 2), ("plsr", "order", 8), ("ridge", "penalty", 4)):
        tried = notes(run, name)["free_run_choice"]
        assert len(tried) == count
        best = min(tried, key=lambda entry: entry["validation"])
        assert notes(run, name)[key] == best[key]
        assert notes(run, name)["validation"] == best["validation"]
    assert len(notes(run, "plsr")["cross_validated_share"]) == 6
    assert "free_run_choice" not in notes(run, "nomoto")
    terms = {entry["term"] for entry in notes(run, "nomoto")["coefficients"]}
    assert {"T", "K", "T_beta", "K_beta"} <= terms


@pytest.mark.long
def test_currents_are_found_and_models_fitted_without_them(
    tmp_path: Path, command: Command
) -> None:
    drifting = {**TINY["data"], "disturbance": {"current_each": [0.1, 0.4]}}
    fossen = {"kind": "regressors", "sets": ["fossen"]}
    config = {**ALONE, "data": drifting, "baseline": fossen, "heads": {}}
    errors = {}
    for name, current in (("with", {"baseline": "baseline"}), ("without", None)):
        file = write_yaml(tmp_path / f"{name}.yaml", {**config, "current": current})
        assert command("run", file, "--out", tmp_path / name).code == 0
        errors[name] = notes(tmp_path / name, "baseline")["validation"]
    # 0.118 in calm water
    assert errors["with"] < 0.15 < 0.5 < errors["without"]
    assert not (tmp_path / "without" / "currents.json").exists()
    data = validate_config(drifting, SimulatedTrials, "here")
    kinds = [manoeuvre.kind for manoeuvre in data.draw_manoeuvres()]
    names = [f"{kind}_{kinds[: i + 1].count(kind):02d}" for i, kind in enumerate(kinds)]
    known = dict(zip(names, data.disturbance.draw_currents(len(names), data.seed), strict=True))
    table = read_json(tmp_path / "with" / "currents.json")
    splits = zip(names, data.assign_splits(data.draw_manoeuvres()), strict=True)
    assert {row["log"]: row["fitted"] for row in table} == {n: s != "test" for n, s in splits}
    for row in table:
        found = [row["current_north"], row["current_east"]]
        np.testing.assert_allclose(found, known[row["log"]], atol=0.06)
