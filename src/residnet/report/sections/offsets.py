"""The report's table of accelerations that a refit found each training log to have for itself."""

from __future__ import annotations

from residnet.report.run_reader import RunFiles
from residnet.report.tables import Cell, Table, number, term_unit


def section(run: RunFiles, model: str) -> Table | None:
    """Accelerations that a refit found each training log to have for itself; None where it looked
    for none.
    """
    entries = run.fit(model).get("offsets") or []
    if not entries:
        return None
    axes = list(dict.fromkeys(entry["axis"] for entry in entries))
    spread = {entry["axis"]: float(entry["spread"]) for entry in entries}
    speed = float(entries[0]["speed"])
    titles = [
        f"{axis.replace('_dot', '')}′ [{term_unit(axis, '1')}], spread {number(spread[axis], 2)},"
        f" at {number(speed, 2)} m/s"
        for axis in axes
    ]
    table = Table(
        heads=["value", "standard error"] * len(axes),
        corner="log",
        groups=[(title, 2) for title in titles],
    )
    for log in dict.fromkeys(entry["log"] for entry in entries):
        cells = []
        for entry in (entry for entry in entries if entry["log"] == log):
            value, error = float(entry["value"]), float(entry["standard_error"])
            cells += [
                Cell(number(value, 2), mark="weak" if abs(value) < 2 * error else ""),
                Cell(number(error, 2)),
            ]
        table.rows.append((log, cells))
    return table
