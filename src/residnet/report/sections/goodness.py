"""The report's part on goodness of fit: one-step residuals of every model, what they remember, and
how sure their level is.
"""

from __future__ import annotations

from typing import Any

from residnet.report.run_reader import Row, RunFiles
from residnet.report.tables import Cell, Table, number, unit_of

_AXES = {"u_dot": "surge u′", "v_dot": "sway v′", "r_dot": "yaw r′"}
_WHITE = 0.05


def section(run: RunFiles) -> list[dict[str, Any]]:
    """For each axis: title, table, sentences; of the split that the report speaks of, else of
    another that there is.
    """
    splits = run.goodness.get("splits") or {}
    split = next((name for name in (run.focus, *splits) if splits.get(name)), "")
    rows: list[Row] = splits.get(split) or []
    out = []
    for axis, title in _AXES.items():
        own = [row for row in rows if row["axis"] == axis]
        if own:
            unit, factor = unit_of(run, axis.replace("_dot", ""))
            out.append(
                {
                    "title": f"{title} [{unit}/s], {split} data",
                    "table": _table(own, factor),
                    "sentences": _sentences(own),
                }
            )
    return out


def _table(rows: list[Row], factor: float) -> Table:
    """Measures and intervals of one axis, a line for each model."""
    heads = ["parameters", "RMSE", "R²", "adjusted R²", "C_p", "AIC", "BIC"]
    intervals = [
        "mean |residual|",
        "95 %, blocks",
        "95 %, printed",
        "block [s]",
        "independent samples",
        "correlation at lag 1",
        "white, p",
    ]
    table = Table(
        heads=[*heads, *intervals, "against"],
        groups=[("fit", len(heads)), ("residuals", len(intervals)), ("difference", 1)],
    )
    for row in rows:
        cells = [
            Cell(number(row["parameters"], 3)),
            Cell(number(factor * row["rmse"])),
            Cell(number(row["r2"])),
            Cell(number(row["r2_adjusted"])),
            Cell(number(factor**2 * row["cp"])),
            Cell(number(row["aic"], 4)),
            Cell(number(row["bic"], 4)),
            Cell(number(factor * row["mae"])),
            Cell(_range(row["mae_ci95"], factor)),
            Cell(_range(row["mae_ci95_independent"], factor), mark="weak"),
            Cell(number(row["block_seconds"], 2)),
            Cell(f"{row['effective']:.0f} of {row['samples']}"),
            Cell(number(row["autocorrelation"][0])),
            Cell(
                "< 0.001" if row["white_p"] < 1e-3 else number(row["white_p"], 2),
                mark="" if row["white_p"] > _WHITE else "weak",
            ),
            _difference(row.get("difference"), factor),
        ]
        table.rows.append((row["model"], cells))
    return table


def _difference(pair: Row | None, factor: float) -> Cell:
    if pair is None:
        return Cell("–")
    mark = "best" if pair["excludes_zero"] else ""
    return Cell(
        f"{number(factor * pair['mae'])} ({_range(pair['ci95'], factor)})",
        note=str(pair["to"]),
        mark=mark,
    )


def _range(bounds: list[float] | None, factor: float) -> str:
    return f"{number(factor * bounds[0])} to {number(factor * bounds[1])}" if bounds else "–"


def _sentences(rows: list[Row]) -> list[str]:
    """How much too narrow the interval of independent samples is, and whether any model leaves
    white residuals.
    """
    wider = [
        (row["mae_ci95"][1] - row["mae_ci95"][0])
        / (row["mae_ci95_independent"][1] - row["mae_ci95_independent"][0])
        for row in rows
        if row["mae_ci95"]
        and row["mae_ci95_independent"]
        and row["mae_ci95_independent"][1] > row["mae_ci95_independent"][0]
    ]
    out = []
    if wider:
        out.append(
            f"The interval as printed, as if samples were independent, is {min(wider):.1f} to"
            f" {max(wider):.1f} times too narrow."
        )
    white = [row["model"] for row in rows if row["white_p"] > _WHITE]
    out.append(
        f"Residuals that pass for white: {', '.join(white)}."
        if white
        else "No model leaves white residuals."
    )
    return out
