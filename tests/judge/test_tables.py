"""Metrics as a table, and as the contents of metrics.json."""

from __future__ import annotations

from typing import Any

from residnet.judge.metrics import metrics_content, metrics_table


def row(model: str, rmse: float) -> dict[str, Any]:
    by_channel = {"u": rmse, "v": 2 * rmse, "r": 3 * rmse}
    return {
        "model": model,
        "kind": "baseline",
        "split": "test",
        "protocol": "T30",
        "manoeuvre": "all",
        "windows": 4,
        "n": 400,
        "diverged": 1,
        "rmse": by_channel,
        "mae": by_channel,
        "nrmse": by_channel | {"mean": 2 * rmse},
        "rmse_ci95": {"u": [0.0, 1.0], "v": [0.0, 1.0], "r": [0.0, 1.0]},
        "nrmse_mean_ci95": [0.0, 1.0],
        "position_error_end": 7.0,
        "heading_error_end": 0.1,
    }


def test_one_column_per_number() -> None:
    table = metrics_table([row("a", 1.0), row("b", 0.5)])
    assert table["model"].tolist() == ["a", "b"]
    assert table["rmse_r"].tolist() == [3.0, 1.5]
    assert table["nrmse_mean"].tolist() == [2.0, 1.0]
    assert table["diverged"].tolist() == [1, 1]
    assert "selected" not in table
    assert table.notna().to_numpy().all()


def test_the_file_marks_the_selected_model_and_leaves_the_rows_as_they_are() -> None:
    rows = [row("a", 1.0), row("b", 0.5)]
    content = metrics_content("run", {"u": "m/s"}, {"u": 1.0}, "b", "c", "c", rows)
    assert content["schema"] == "residnet.metrics/1"
    assert (content["selected"], content["selected_ensemble"]) == ("b", "c")
    assert [entry["selected"] for entry in content["rows"]] == [False, True]
    assert metrics_table(content["rows"])["selected"].tolist() == [False, True]
    assert "selected" not in rows[0]
