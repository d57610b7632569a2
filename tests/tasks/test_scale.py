"""`residnet scale`: the run of the full-scale ship and its commands."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from pictures import omit_drawings
from tiny import Command, read_json

import residnet
from residnet.export import vessel


def test_the_full_scale_run_has_the_errors_of_the_model_in_units_of_the_ship(
    tiny_run: Path, tmp_path: Path, command: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(vessel, "PARITY_STEPS", 60)
    omit_drawings(monkeypatch)
    run = shutil.copytree(tiny_run, tmp_path / "run")
    ship = tmp_path / "ship"
    said = command("scale", run, "--scale", "16", "--out", ship)
    assert said.code == 0, said.err
    assert "not of full-scale trials" in said.out
    rows = {
        (row["model"], row["split"], row["protocol"], row["manoeuvre"]): row
        for row in read_json(run / "metrics.json")["rows"]
    }
    scaled_rows = read_json(ship / "metrics.json")["rows"]
    assert any(row["model"] == "baseline" for row in scaled_rows)
    for row in scaled_rows:
        original = rows[row["model"], row["split"], row["protocol"], row["manoeuvre"]]
        assert row["nrmse"]["mean"] == pytest.approx(original["nrmse"]["mean"], rel=1e-4)
        assert row["rmse"]["u"] == pytest.approx(4.0 * original["rmse"]["u"], rel=1e-4)
    model = residnet.load(run, "baseline")
    assert residnet.load(ship, "baseline").dt == pytest.approx(4.0 * model.dt)
    # the other commands accept it
    assert command("export", ship, "--model", "baseline", "--anyway").code == 0
    log = next((ship / "logs").glob("test_*.parquet"))
    assert command("evaluate", ship, log, "--out", tmp_path / "again").code == 0
    refused = command("scale", run, "--scale", "16", "--out", run / "inside")
    assert refused.code == 2
    assert "lies in the run" in refused.err
    unknown = command("scale", run, "--scale", "16", "--rudder", "0.9", "--out", tmp_path / "b")
    assert unknown.code == 2
    assert "needs its source" in unknown.err


def test_a_scaled_model_simulates_like_the_original(tiny_run: Path) -> None:
    model = residnet.load(tiny_run, "baseline")
    ship = model.scale(16.0)
    low = np.array(model.spec.low)
    high = np.array(model.spec.high)
    x0 = np.concatenate((np.zeros(3), 0.5 * (low + high)[:3]))
    w = np.tile(0.6 * high[3:] + 0.4 * low[3:], (100, 1))
    factors = {"m": 16.0, "m/s": 4.0, "rad/s": 0.25, "1/s": 0.25, "rad": 1.0, "-": 1.0}
    x_factor = np.array([factors[model.units[name]] for name in model.states])
    w_factor = np.array([factors[model.units[name]] for name in model.inputs])
    original = model.rollout(x0, w)
    assert ship.rollout(x0 * x_factor, w * w_factor) / x_factor == pytest.approx(original, rel=1e-6)
