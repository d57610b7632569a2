"""A residual in force space through a whole fit: run forward, judged, exported as model and as
feed-forward.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from tiny import Command, read_json, write_yaml

pytestmark = pytest.mark.long

ZIGZAGS = {"kind": "zigzag", "count": 8, "start": 3, "heading": ["10 deg"], "drive": [0.1, 0.2]}
FERRY: dict[str, Any] = {
    "task": "fit",
    "name": "ferry",
    "data": {
        **{"kind": "simulated", "vessel": "milliampere_half"},
        **{"duration": 40, "step": 0.1, "substeps": 1},
        "trials": [ZIGZAGS | {"steer": [0.03, 0.06]}],
        **{"identification": {"zigzag": 6}, "validation": {"zigzag": 1}},
    },
    "prepare": {
        "grid": {"step": 0.1},
        "derivative": {"kind": "savitzky_golay", "window": 1.1, "order": 2},
    },
    "signals": {"inputs": ["tau_x", "tau_y", "tau_n"]},
    "baseline": {"kind": "believed", "vessel": "milliampere"},
    # zigzags never push sideways: penalties keep the masses near the believed ones
    "heads": {"ridge": {"kind": "ridge", "space": "force", "penalties": [0.1, 0.3]}},
    "evaluation": {
        "protocols": {"manoeuvre": {"kind": "manoeuvre"}},
        "selection": "manoeuvre",
        "scales": {"u": 0.3, "v": 0.1, "r": 0.05},
    },
    "export": {"models": ["ridge"]},
}


def test_a_whole_fit_and_its_exports(tmp_path: Path, command: Command) -> None:
    run = tmp_path / "run"
    assert command("run", write_yaml(tmp_path / "ferry.yaml", FERRY), "--out", run).code == 0
    content = read_json(run / "metrics.json")["rows"]
    error = {row["model"]: row["nrmse"]["mean"] for row in content if row["split"] == "test"}
    # the believed ferry is twice the true one: its residual takes most of the error away
    assert error["ridge"] < 0.6 * error["baseline"]
    fit = read_json(run / "models" / "ridge" / "fit.json")
    assert fit["space"] == "force"
    assert fit["augmented_mass"][0][0] == pytest.approx(0.5 * 2389.657, rel=0.25)
    assert fit["forces_that_never_vary"] == ["tau_y"]
    assert (run / "exports" / "ridge.pt").is_file()
    feed_forward = ("export", run, "--format", "feed_forward", "--model")
    assert command(*feed_forward, "ridge").code == 0
    loaded = torch.jit.load(str(run / "exports" / "ridge_feed_forward.pt"))
    nu_dot = torch.tensor([[0.1, 0.0, 0.0], [torch.nan, 0.0, 0.0], [torch.inf, -1e30, 0.0]])
    tau, outside = loaded(nu_dot, torch.tensor([[0.5, 0.0, 0.0]]).expand(3, -1))
    assert torch.isfinite(tau).all()
    assert outside.tolist()[1:] == [True, True]
    assert 0.5 < float(tau[0, 0]) / (0.1 * 0.5 * 2389.657) < 2.0
    said = command(*feed_forward, "baseline")
    assert said.code == 2
    assert "no residual in force space" in said.err
