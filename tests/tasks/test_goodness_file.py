"""goodness.json of a run: its residuals are those of the stored models, and every model has its
rows.
"""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest


def test_rows_of_every_model_and_axis_agree_with_the_stored_residuals(tiny_run: Path) -> None:
    content = json.loads((tiny_run / "goodness.json").read_text())
    models = {path.name for path in (tiny_run / "models").iterdir()}
    stored = pd.read_parquet(tiny_run / "residuals.parquet")
    for rows in content["splits"].values():
        assert len(rows) == 3 * len(models)
        by = {(row["model"], row["axis"]): row for row in rows}
        for axis in ("u_dot", "v_dot", "r_dot"):
            assert by["zero", axis]["parameters"] == 0
            assert by["zero", axis]["r2"] <= 1e-9 < by["baseline", axis]["r2"]
            assert (
                by["lstm", axis]["parameters"]
                > by["ridge", axis]["parameters"]
                > by["baseline", axis]["parameters"]
                > 0
            )
            assert by["ridge", axis]["difference"]["to"] == "baseline"
            low, high = by["ridge", axis]["mae_ci95"]
            assert low < by["ridge", axis]["mae"] < high
    for name, part in stored[stored.model == "ridge"].groupby("axis"):
        row = next(
            row
            for row in content["splits"]["test"]
            if (row["model"], row["axis"]) == ("ridge", name)
        )
        # only every so manieth sample is stored
        assert ((part.target - part.predicted) ** 2).mean() ** 0.5 == pytest.approx(
            row["rmse"], rel=0.1
        )
