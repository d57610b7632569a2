"""Composition of metrics.json, and its rows as a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Final

from residnet.evaluation.records import MetricsFile, MetricsRow
from residnet.evaluation.verdict import describe_divergence

if TYPE_CHECKING:
    import pandas as pd

SCHEMA: Final = "residnet.metrics/1"


def find_row(
    rows: Sequence[MetricsRow],
    *,
    model: str,
    split: str | None = None,
    protocol: str | None = None,
    manoeuvre: str = "all",
) -> MetricsRow:
    """Return the row of a model and manoeuvre, and of a split and protocol if these are given.

    Raises:
        KeyError: if there is no such row, or several.
    """
    matching_rows = [
        row
        for row in rows
        if row.model == model
        and row.manoeuvre == manoeuvre
        and split in (None, row.split)
        and protocol in (None, row.protocol)
    ]
    if len(matching_rows) != 1:
        raise KeyError(
            f"{len(matching_rows)} rows of model {model}, split {split}, protocol {protocol},"
            f" manoeuvre {manoeuvre}"
        )
    return matching_rows[0]


def build_metrics_file(
    run: str,
    units: Mapping[str, str],
    scales: Mapping[str, float],
    selected: str,
    selected_ensemble: str | None,
    predictor: str,
    rows: Sequence[MetricsRow],
) -> MetricsFile:
    """Return the contents of metrics.json.

    Args:
        run: name of the run.
        units: unit of each state.
        scales: denominators of the nrmse.
        selected: name of the single model that the validation data chose.
        selected_ensemble: name of the best ensemble; None without ensembles.
        predictor: name of the model that is reported first and exported by default.
        rows: rows of all splits, without `selected`.
    """
    return MetricsFile(
        schema=SCHEMA,
        run=run,
        channels=dict(units),
        scales=dict(scales),
        selected=selected,
        selected_ensemble=selected_ensemble,
        predictor=predictor,
        rows=tuple(mark_selected(rows, selected)),
    )


def mark_selected(rows: Sequence[MetricsRow], selected: str) -> list[MetricsRow]:
    """Return the rows with `selected` set, by the name of the selected model."""
    return [row.model_copy(update={"selected": row.model == selected}) for row in rows]


def build_metrics_table(rows: Sequence[MetricsRow]) -> pd.DataFrame:
    """Return rows of metrics.json as a table with one column per number.

    Args:
        rows: rows of metrics.json.

    Returns:
        Columns model, kind, split, protocol, manoeuvre (and selected where a model was chosen),
        windows, diverged, n, then rmse_u, rmse_v, rmse_r (m/s, m/s, rad/s), the same for mae and
        nrmse with nrmse_mean, note (such as "2/12 diverged"; diverged windows count with the
        error of `constant_velocity`), and position_error_end (m), heading_error_end (rad), or
        depth_error_end (m) and attitude_error_end (rad) for vessels that dive.
    """
    import pandas as pd

    return pd.DataFrame([_flatten_row(row) for row in rows])


def _flatten_row(row: MetricsRow) -> dict[str, str | float | None]:
    flat_row: dict[str, str | float | None] = {
        "model": row.model,
        "kind": row.kind,
        "split": row.split,
        "protocol": row.protocol,
        "manoeuvre": row.manoeuvre,
    }
    if row.selected is not None:
        flat_row["selected"] = row.selected
    flat_row |= {"windows": row.windows, "diverged": row.diverged, "n": row.n}
    for name, errors in {"rmse": row.rmse, "mae": row.mae, "nrmse": row.nrmse}.items():
        flat_row |= {f"{name}_{channel}": value for channel, value in errors.items()}
    # next to the score, which contains constant-velocity errors for diverged windows
    flat_row["note"] = describe_divergence(row)
    return flat_row | {f"{name}_error_end": e for name, e in row.final_pose_errors.items()}
