"""The report's part on the data doctor: what would mislead a fit to these logs, and what it noted
besides.
"""

from __future__ import annotations

from typing import Any

from residnet.report.run_reader import Row, RunFiles
from residnet.report.tables import Cell, Table

_LEVELS = ("fatal", "will mislead")


def section(run: RunFiles) -> dict[str, Any]:
    """Table of findings above a note by kind, the number of logs, and the notes of each log; empty
    where the run has no doctor.json.
    """
    logs = run.doctor.get("logs") or []
    if not logs:
        return {}
    said = [(str(entry["name"]), finding) for entry in logs for finding in entry["findings"]]
    said += [("together", finding) for finding in run.doctor.get("together") or []]
    loud = [(name, finding) for name, finding in said if finding["level"] != "note"]
    notes: dict[str, list[Row]] = {name: [] for name, _ in said}
    for name, finding in said:
        if finding["level"] == "note":
            notes[name].append(finding)
    sick = len({name for name, _ in loud} - {"together"})
    return {
        "table": _table(loud) if loud else None,
        "logs": len(logs),
        "sick": sick,
        "notes": list(notes.items()),
    }


def _table(loud: list[tuple[str, Row]]) -> Table:
    table = Table(heads=["level", "logs", "for example", "what to do"], corner="finding")
    kinds = sorted({(_LEVELS.index(finding["level"]), str(finding["code"])) for _, finding in loud})
    for level, code in kinds:
        members = [
            (name, finding)
            for name, finding in loud
            if (finding["level"], finding["code"]) == (_LEVELS[level], code)
        ]
        name, finding = members[0]
        cells = [
            Cell(_LEVELS[level], mark="bad" if level == 0 else ""),
            Cell(str(len({other for other, _ in members}))),
            Cell(str(finding["text"]), note=name, mark="text"),
            Cell(str(finding["action"]), mark="text"),
        ]
        table.rows.append((code.replace("_", " "), cells))
    return table
