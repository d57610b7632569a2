"""A tiny run folder with hand-made numbers."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.fit import fit_sections
from residnet.report.page import write_page
from residnet.report.run_reader import RunFiles
from residnet.report.sections import verdict

DEG = 180.0 / math.pi
MODELS = {
    "constant_velocity": "constant_velocity",
    "baseline": "baseline",
    "mlp": "head",
    "plsr": "head",
    "plant": "plant",
}
# error of each model: rmse of u [m/s], v [m/s], r [rad/s]
LEVEL = {
    "constant_velocity": (1.2345, 0.2222, 0.2111),
    "baseline": (0.1000, 0.0500, 0.0200),
    "mlp": (0.0700, 0.0510, 0.0150),
    "plsr": (0.0400, 0.0300, 0.0100),
    "plant": (0.0200, 0.0250, 0.0050),
}
KINDS = {**{f"zigzag_0{number}": "zigzag" for number in (1, 2, 3)}, "turning_01": "turning"}
SCALES = {"u": 0.5, "v": 0.25, "r": 0.25}
RESOLVED = """task: fit
name: made
description: made by hand <script>alert(1)</script>
data: {kind: simulated, vessel: wam_v_cal, seed: 0, noise: {u: 0.03, v: 0.03, r: 0.0035}}
signals: {inputs: [n_port, n_stbd], exogenous: [], forces: wam_v_cal}
baseline: {kind: linear_steady}
training: {mlp: {one_step: {epochs: 2}, multi_step: [{horizon: 2.0, epochs: 2}]}}
evaluation:
  protocols:
    T30: {kind: windows, length: 30.0, first: 5.0}
    whole: {kind: manoeuvre, initial: 0.5}
  selection: whole
  divergence: 3.0
"""


def row(
    model: str, split: str, protocol: str, manoeuvre: str = "all", *, factor: float = 1.0
) -> dict[str, Any]:
    """One row of metrics.json."""
    rmse = {name: factor * value for name, value in zip("uvr", LEVEL[model], strict=True)}
    nrmse = {name: rmse[name] / scale for name, scale in SCALES.items()}
    mean = sum(nrmse.values()) / 3
    found: dict[str, Any] = {
        "model": model,
        "kind": MODELS[model],
        "split": split,
        "protocol": protocol,
    }
    found |= {"manoeuvre": manoeuvre, "windows": 6, "n": 600, "diverged": 0}
    found |= {"rmse": rmse, "mae": rmse, "nrmse": nrmse | {"mean": mean}}
    found |= {"rmse_ci95": {name: [0.9 * value, 1.1 * value] for name, value in rmse.items()}}
    found |= {"nrmse_mean_ci95": [0.9 * mean, 1.1 * mean], "ci95_blocks": None}
    found |= {"heading_error_end": rmse["r"]}
    return found | {"position_error_end": 10 * rmse["u"]}


def complete_row(rmse: dict[str, float], **labels: Any) -> dict[str, Any]:
    """A row of metrics.json with errors of the velocities and no intervals."""
    found: dict[str, Any] = {"manoeuvre": "all", "windows": 6, "n": 600, "diverged": 0}
    found |= {"rmse": rmse, "mae": rmse, "nrmse": {**rmse, "mean": 1.0}}
    found |= {"rmse_ci95": dict.fromkeys(rmse), "nrmse_mean_ci95": None, "ci95_blocks": None}
    return {**found, **labels}


def metrics_file(rows: list[dict[str, Any]], selected: str) -> dict[str, Any]:
    """Contents of metrics.json."""
    units = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
    about = {"schema": "residnet.metrics/1", "run": "made", "channels": units, "scales": SCALES}
    chosen = {"selected": selected, "selected_ensemble": None, "predictor": selected}
    marked = [{**line, "selected": line["model"] == selected} for line in rows]
    return {**about, **chosen, "rows": marked}


def metrics(
    splits: tuple[str, ...] = ("train", "validation", "test"),
    models: tuple[str, ...] = tuple(MODELS),
) -> dict[str, Any]:
    """Contents of metrics.json."""
    rows = []
    for split in splits:
        for protocol in ("T30", "whole"):
            for model in models:
                rows.append(row(model, split, protocol, factor=0.8 if split == "train" else 1.0))
                for number, kind in enumerate(("turning", "zigzag")):
                    rows.append(row(model, split, protocol, kind, factor=1.1 + 0.1 * number))
    return metrics_file(rows, "plsr")


def provenance(**change: Any) -> dict[str, Any]:
    """Contents of provenance.json."""
    about: dict[str, Any] = {"residnet": "9.8.7", "command": ["residnet"], "config": None}
    about |= {"overrides": [], "seed": 5, "git": "abc123", "python": "3.12.1", "machine": "Linux"}
    about |= {"packages": {"torch": "2.13.0"}, "started": "2026-01-02T03:04:05Z", "seconds": 12.3}
    return {**about, "inputs": {"logs/a.csv": "f00d"}, **change}


def data_quality(kinds: dict[str, str], split: str) -> list[dict[str, Any]]:
    """Contents of data_quality.json; `kinds` has the manoeuvre of each log."""
    entry: dict[str, Any] = {"split": split, "seconds": 60.0, "samples": 600, "usable": 0.975}
    entry |= {"learned_from": 0.95, "masked": {"frozen": 0.025}}
    entry |= {"largest": {"u": 1.5, "v": 0.2, "r": 0.1}}
    return [{"log": log, "manoeuvre": kind} | entry for log, kind in kinds.items()]


def finding(code: str, level: str, text: str, **change: Any) -> dict[str, Any]:
    """A finding in doctor.json."""
    about = {"level": level, "code": code, "text": text, "action": "", "effect": None}
    return {**about, "figures": {}, **change}


def inspection(
    logs: dict[str, list[dict[str, Any]]], together: list[dict[str, Any]]
) -> dict[str, Any]:
    """Contents of doctor.json."""
    entries = [
        {"name": name, "source": "", "misled": bool(found), "findings": found}
        for name, found in logs.items()
    ]
    about = {"schema": "residnet.inspection/1", "misled": True, "logs": entries}
    return {**about, "together": together, "tally": "", "first": ""}


def protocol_limits(**change: Any) -> dict[str, Any]:
    """Contents of limits.json for one protocol of one split."""
    empty: dict[str, Any] = {"kinematics": {}, "bands": [], "worst": {}, "compared": {}}
    return {**empty, "outside": {}, "horizons": [], **change}


def limits(
    protocols: dict[str, dict[str, Any]], repeatability: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Contents of limits.json for test data."""
    about = {"schema": "residnet.limits/1", "run": "made", "splits": {"test": protocols}}
    return {**about, "repeatability": repeatability}


def write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def stored(
    protocol: str,
    model: str,
    t: np.ndarray,
    measured: dict[str, np.ndarray],
    predicted: dict[str, np.ndarray],
    usable: Any = True,
) -> pd.DataFrame:
    """One free run of one window as a rollout file holds it."""
    about = {"protocol": protocol, "model": model, "window": 0, "t": t, "usable": usable}
    hats = {f"{name}_hat": values for name, values in predicted.items()}
    return pd.DataFrame({**about, "diverged": False, **measured, **hats})


def write_rollout(folder: Path, log: str, models: tuple[str, ...], size: float) -> None:
    """One log of 6 s under two protocols; errors are `size` times the levels, constant in time,
    samples 20..29 masked and off by 9 m/s.
    """
    t = np.arange(61) * 0.1
    usable = (t < 1.95) | (t > 2.95)
    u, v, r = 1.0 + 0 * t, 0.1 * np.sin(t), 0.2 * np.cos(t)
    psi = 0.2 * np.sin(t)
    x, y = np.cumsum(0.1 * u * np.cos(psi)), np.cumsum(0.1 * u * np.sin(psi))
    own = {"u": u, "v": v, "r": r, "psi": psi, "x": x, "y": y}
    measured = own | {"u": np.where(usable, u, u + 9)}
    parts = []
    for protocol in ("T30", "whole"):
        for model in models:
            eu, ev, er = (size * level for level in LEVEL[model])
            off = {"u": eu, "v": ev, "r": er, "psi": er * t, "x": eu * t, "y": ev * t}
            predicted = {name: values + off[name] for name, values in own.items()}
            parts.append(stored(protocol, model, t, measured, predicted, usable))
    folder.mkdir(parents=True, exist_ok=True)
    pd.concat(parts).to_parquet(folder / f"{log}.parquet")


def residuals() -> pd.DataFrame:
    """Contents of residuals.parquet: `plsr` explains all of it, `mlp` nothing."""
    random = np.random.default_rng(0)
    parts = []
    for model, share in (("plsr", 1.0), ("mlp", 0.0)):
        for axis in ("u_dot", "v_dot", "r_dot"):
            target = random.normal(0, 0.1, 400)
            about = {"model": model, "axis": axis}
            parts.append(pd.DataFrame({**about, "target": target, "predicted": share * target}))
    return pd.concat(parts)


def made_run(run: Path, *, split: str = "test") -> Path:
    """The whole folder, but for models that can be loaded."""
    write_json(run / "metrics.json", metrics())
    (run / "resolved.yaml").write_text(RESOLVED)
    write_json(run / "provenance.json", provenance())
    write_json(run / "data_quality.json", data_quality(KINDS, split))
    for number, log in enumerate(KINDS):
        write_rollout(run / "rollouts" / split, log, tuple(MODELS), 0.5 + 0.5 * number)
    coefficients = [
        {"axis": "u_dot", "term": "u", "value": -0.91393, "standard_error": 0.0762},
        {"axis": "v_dot", "term": "tau_n", "value": 1.0e-5, "standard_error": 5.8e-5},
        {"axis": "r_dot", "term": "v|v|", "value": 0.5, "standard_error": 0.1},
    ]
    # a learning curve of two stages
    curve = [
        {"epoch": e, "stage": float(e > 1), "loss": 1.0 / (1 + e) ** 2, "validation": 0.2 - e / 50}
        for e in (0.0, 1.0, 2.0, 3.0)
    ]
    fits = {
        "baseline": {"coefficients": coefficients, "samples": 2400, "seconds": 0.01},
        "plsr": {"order": 7, "terms": 23, "seconds": 0.1, "validation": 0.1},
        "mlp": {
            "parameters": 1347,
            "epochs": 4,
            "seconds": 23.0,
            "validation": 0.14,
            "curve": curve,
        },
    }
    for name, fit in fits.items():
        write_json(run / "models" / name / "fit.json", fit)
    # the terms of a card are names, those of a fit their count
    head = {"hidden": [16, 8], "terms": ["n|n|"], "features": ["u", "n"]}
    write_json(run / "models" / "mlp" / "model.json", {"head": head})
    return run


def write_fit_page(run: RunFiles) -> Path:
    """Write `report.html` of a fit or an evaluation with the figures that stand in its folder."""
    title = run.metrics.run
    said = verdict.verdict_sentences(run)
    level = verdict.verdict_level(run)
    sections = fit_sections(run)
    return write_page(run.path, title, run.description, said, sections, level=level)
