"""A residual in force space through a whole fit: run forward, judged, exported as model and as
feed-forward; a mass of the wrong sign stops it.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from tiny import call

from residnet.data.simulated import SimulatedTrials, simulate

pytestmark = pytest.mark.long

FERRY: dict[str, Any] = {
    "task": "fit",
    "name": "ferry",
    "data": {
        "kind": "simulated",
        "vessel": "milliampere_half",
        "duration": 40,
        "step": 0.1,
        "substeps": 1,
        "trials": [
            {
                "kind": "zigzag",
                "count": 8,
                "drive": [0.1, 0.2],
                "steer": [0.03, 0.06],
                "heading": ["10 deg"],
                "start": 3,
            }
        ],
        "identification": {"zigzag": 6},
        "validation": {"zigzag": 1},
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


def written(folder: Path, content: dict[str, Any]) -> Path:
    path = folder / "ferry.yaml"
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("force")
    with pytest.MonkeyPatch.context() as patch:
        assert call(patch, "run", written(folder, FERRY), "--out", folder / "run") == 0
    return folder / "run"


def test_free_runs_and_report(run: Path) -> None:
    rows = {
        row["model"]: row
        for row in json.loads((run / "metrics.json").read_text())["rows"]
        if row["split"] == "test"
    }
    # the believed ferry is twice the true one: its residual takes most of the error away
    assert rows["ridge"]["nrmse"]["mean"] < 0.6 * rows["baseline"]["nrmse"]["mean"]
    fit = json.loads((run / "models" / "ridge" / "fit.json").read_text())
    assert fit["space"] == "force"
    assert fit["augmented_mass"][0][0] == pytest.approx(0.5 * 2389.657, rel=0.25)
    assert fit["forces_that_never_vary"] == ["tau_y"]
    assert (run / "report.html").is_file()
    assert (run / "exports" / "ridge.pt").is_file()


def test_exports(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(monkeypatch, "export", run, "--model", "ridge", "--format", "feed_forward") == 0
    loaded = torch.jit.load(str(run / "exports" / "ridge_feed_forward.pt"))
    nu_dot = torch.tensor([[0.1, 0.0, 0.0], [torch.nan, 0.0, 0.0], [torch.inf, -1e30, 0.0]])
    nu = torch.tensor([[0.5, 0.0, 0.0]]).expand(3, -1)
    tau, outside = loaded(nu_dot, nu)
    assert torch.isfinite(tau).all()
    assert outside.tolist()[1:] == [True, True]
    assert 0.5 < float(tau[0, 0]) / (0.1 * 0.5 * 2389.657) < 2.0
    capsys.readouterr()
    assert call(monkeypatch, "export", run, "--model", "baseline", "--format", "feed_forward") == 2
    assert "no residual in force space" in capsys.readouterr().err


def test_evaluated_on_other_logs(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trials = SimulatedTrials.model_validate(FERRY["data"] | {"seed": 5})
    log = simulate(trials.draw()[:1], trials)[0]
    log.save(tmp_path / "other.parquet")
    assert (
        call(
            monkeypatch,
            "evaluate",
            run,
            "--logs",
            tmp_path / "other.parquet",
            "--out",
            tmp_path / "out",
        )
        == 0
    )
    rows = {
        row["model"]: row
        for row in json.loads((tmp_path / "out" / "metrics.json").read_text())["rows"]
    }
    assert rows["ridge"]["nrmse"]["mean"] < 0.6 * rows["baseline"]["nrmse"]["mean"]


def test_a_mass_of_the_wrong_sign_stops_the_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Logs of somebody who writes forces with the other sign."""
    trials = SimulatedTrials.model_validate(FERRY["data"])
    for number, log in enumerate(simulate(trials.draw(), trials)):
        log.replace(
            channels=log.channels | {name: -log[name] for name in ("tau_x", "tau_y", "tau_n")}
        ).save(tmp_path / f"log_{number}.parquet")
    split = {
        "root": str(tmp_path),
        "train": ["log_[0-5].parquet"],
        "validation": ["log_6.parquet"],
        "test": ["log_7.parquet"],
    }
    content = FERRY | {
        "data": {"kind": "measured", "reader": {"kind": "canonical"}, "split": split}
    }
    # a strong enough penalty would hide it
    content["heads"] = {"ridge": FERRY["heads"]["ridge"] | {"penalties": [1e-6]}}
    assert call(monkeypatch, "run", written(tmp_path, content), "--out", tmp_path / "run") == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith(
        "residnet: head ridge: residual in force space: its mass matrix with the fitted"
        " accelerations has eigenvalues [-"
    )
