"""The typed contents of the files of a run folder."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from residnet.core.errors import ResidnetError
from residnet.evaluation.metrics_file import build_metrics_file
from residnet.evaluation.records import MetricsFile, MetricsRow


def row(**change: Any) -> dict[str, Any]:
    errors = {"u": 0.1}
    return {
        "model": "mlp",
        "kind": "head",
        "split": "test",
        "protocol": "T30",
        "manoeuvre": "all",
        "windows": 2,
        "n": 20,
        "diverged": 0,
        "rmse": errors,
        "mae": errors,
        "nrmse": {"u": 0.2, "mean": 0.2},
        "rmse_ci95": {"u": None},
        "nrmse_mean_ci95": None,
        "ci95_blocks": None,
        "position_error_end": 1.0,
        "position_error_end_ci95": [0.5, 1.5],
        "difference": None,
        **change,
    }


def metrics(**change: Any) -> MetricsFile:
    rows = [MetricsRow.model_validate(row(**change))]
    return build_metrics_file("run", {"u": "m/s"}, {"u": 0.5}, "mlp", None, "mlp", rows)


def test_metrics_file_keeps_the_keys_of_its_rows(tmp_path: Path) -> None:
    path = tmp_path / "metrics.json"
    path.write_text(metrics().to_json_text(), encoding="utf-8")
    content = json.loads(path.read_text(encoding="utf-8"))
    assert list(content)[:2] == ["schema", "run"]
    assert content["rows"] == [{**row(), "selected": True}]
    assert MetricsFile.read(path) == metrics()


@pytest.mark.parametrize(
    ("change", "key"),
    [
        ({"kind": "zero"}, "rows.0.kind"),
        ({"rmse": {"u": float("nan")}}, "rows.0.rmse.u"),
        ({"rsme": {}}, "rows.0.rsme"),
    ],
)
def test_metrics_file_refuses_what_the_format_does_not_have(
    tmp_path: Path, change: dict[str, Any], key: str
) -> None:
    with pytest.raises(ValidationError):
        metrics(**change)
    content = metrics().to_content()
    content["rows"][0] |= change
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ResidnetError, match=rf"metrics\.json: key '{key}'"):
        MetricsFile.read(path)
