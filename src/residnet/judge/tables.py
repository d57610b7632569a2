"""Results as tables: rows of metrics.json as one pandas table with a column per number."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from residnet.judge.metrics import SCHEMA
from residnet.judge.verdict.sentences import diverged_note

if TYPE_CHECKING:
    import pandas as pd

_LABELS = ("model", "kind", "split", "protocol", "manoeuvre", "selected")
_COUNTS = ("windows", "diverged", "n")
_BY_CHANNEL = ("rmse", "mae", "nrmse")
_ENDS = ("position_error_end", "heading_error_end")


def metrics_content(
    run: str,
    units: Mapping[str, str],
    scales: Mapping[str, float],
    selected: str,
    selected_ensemble: str | None,
    rows: Sequence[Mapping[str, Any]],
) -> dict[str, Any]:
    """Return the contents of metrics.json.

    Args:
        run: name of the run.
        units: unit of each state.
        scales: what nrmse divides by.
        selected: name of the single model that the validation data chose.
        selected_ensemble: name of the best ensemble; None where there is none.
        rows: of all splits, without `selected`.
    """
    marked = [{**row, "selected": row["model"] == selected} for row in rows]
    return {
        "schema": SCHEMA,
        "run": run,
        "channels": dict(units),
        "scales": dict(scales),
        "selected": selected,
        "selected_ensemble": selected_ensemble,
        "rows": marked,
    }


def metrics_table(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows of metrics.json as a table with one column per number.

    Args:
        rows: of metrics.json, as `evaluate` or the file gives them.

    Returns:
        Columns model, kind, split, protocol, manoeuvre (and selected where the rows have it),
        windows, diverged, n, then rmse_u, rmse_v, rmse_r (m/s, m/s, rad/s), the same for mae and
        nrmse with nrmse_mean, note (such as "2/12 diverged", where such windows count with the
        error of `zero`), and position_error_end (m), heading_error_end (rad).
    """
    import pandas as pd

    return pd.DataFrame([_flat(row) for row in rows])


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    out = {name: row[name] for name in (*_LABELS, *_COUNTS) if name in row}
    for name in _BY_CHANNEL:
        out |= {f"{name}_{channel}": value for channel, value in row[name].items()}
    # beside the score, since the diverged windows in it are no errors of the model
    out["note"] = diverged_note(row)
    return out | {name: row[name] for name in _ENDS}
