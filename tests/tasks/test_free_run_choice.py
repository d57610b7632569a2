"""Free runs choose between solutions of a closed-form fit in a run."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml
from tiny import TINY, call


@pytest.mark.long
def test_in_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Baseline and heads carry the solution whose validation free run is best, and fit.json says
    what was tried.
    """
    config: dict[str, Any] = {
        **TINY,
        "baselines": {
            "poly": {"kind": "regressors", "sets": ["polynomial_2"], "ridge": [1.0e-5, 1.0e-1]},
            "nomoto": {"kind": "nomoto_sideslip", "drive": "tau_x", "steer": "tau_n"},
        },
        "heads": {
            "plsr": {
                "kind": "plsr",
                "choose": "free_run",
                "terms": ["u", "v", "r", "tau_n", "u|u|", "r|r|"],
                "features": ["u", "v", "r", "tau_n"],
            },
            "ridge": {"kind": "ridge", "choose": "free_run", "penalties": [1.0e-6, 1.0e-2]},
        },
        "ensembles": {},
        "training": {},
        "export": {"models": []},
    }
    path = tmp_path / "config.yaml"
    path.write_text(yaml.safe_dump(config))
    assert call(monkeypatch, "run", path, "--out", tmp_path / "run") == 0
    notes = {
        name: json.loads((tmp_path / "run" / "models" / name / "fit.json").read_text())
        for name in ("poly", "plsr", "ridge", "nomoto")
    }
    for name, key, count in (("poly", "ridge", 2), ("plsr", "order", 8), ("ridge", "penalty", 4)):
        tried = notes[name]["free_run_choice"]
        assert len(tried) == count
        best = min(tried, key=lambda entry: entry["validation"])
        assert notes[name][key] == best[key]
        assert notes[name]["validation"] == best["validation"]
    assert len(notes["plsr"]["cross_validated_share"]) == 6
    assert "free_run_choice" not in notes["nomoto"]
    assert {"T", "K", "T_beta", "K_beta"} <= {
        entry["term"] for entry in notes["nomoto"]["coefficients"]
    }
