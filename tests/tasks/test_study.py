"""Task `study`: all variants are run with all seeds, kept on resume, and stand in one table."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from read_page import plain
from tiny import call

VARIANTS = {"recipe": [], "short": ["heads.ridge.degree=1"]}


@pytest.fixture
def study(tiny_config: Path, tmp_path: Path) -> Path:
    path = tmp_path / "study.yaml"
    content = {
        "task": "study",
        "name": "tiny_study",
        "base": str(tiny_config),
        "common": [
            "heads={ridge: {kind: ridge}}",
            "training={}",
            "ensembles={}",
            "export.models=[]",
        ],
        "variants": VARIANTS,
        "reference": "recipe",
        "model": "ridge",
        "seeds": [0, 1],
    }
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


@pytest.mark.long
def test_all_variants_and_seeds_in_one_table(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    assert call(monkeypatch, "run", study, "--out", out) == 0
    content = json.loads((out / "study.json").read_text())
    assert {(row["variant"], row["protocol"]) for row in content["rows"]} == {
        (v, p) for v in VARIANTS for p in ("manoeuvre", "T10")
    }
    for row in content["rows"]:
        found = []
        for seed in (0, 1):
            metrics = json.loads(
                (out / "variants" / f"{row['variant']}.{seed}" / "metrics.json").read_text()
            )
            wanted = {
                "model": "ridge",
                "split": "test",
                "protocol": row["protocol"],
                "manoeuvre": "all",
            }
            (own,) = [
                r for r in metrics["rows"] if all(r[key] == value for key, value in wanted.items())
            ]
            found.append(own["nrmse"]["mean"])
        assert row["nrmse_mean"] == pytest.approx(sum(found) / 2, rel=1e-6)
    assert "short" in plain(out / "report.html")
    assert (out / "figures" / "01_study.png").stat().st_size > 1000
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("variants/*/metrics.json")}
    assert len(stamps) == 4
    (out / "variants" / "short.1" / "summary.json").unlink()
    assert call(monkeypatch, "run", study, "--out", out, "--resume") == 0
    again = {path: path.stat().st_mtime_ns for path in out.glob("variants/*/metrics.json")}
    changed = {path.parent.name for path in again if again[path] != stamps[path]}
    assert changed == {"short.1"}, "finished runs are kept"
