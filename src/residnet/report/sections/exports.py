"""The section of a report on what a run exported for controllers, and what it could not."""

from __future__ import annotations

import json
from pathlib import Path

from residnet.core.errors import UsageError
from residnet.report.blocks import Block, Bullets, Cell, Section, Table

EXPORTS = "exports.json"
"""File of a run folder that says what came of each export."""


def exports_section(run: Path) -> Section | None:
    """Return the section from the folder of a run; None where the run exported nothing.

    Raises:
        UsageError: where exports.json is not readable.
    """
    file = run / EXPORTS
    if not file.is_file():
        return None
    try:
        rows = [
            (str(row["model"]), str(row["file"] or ""), str(row["fault"] or ""))
            for row in json.loads(file.read_text(encoding="utf-8"))["exports"]
        ]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{file}: not readable as a list of exports ({error})") from None
    blocks: list[Block] = []
    faults = [fault for _, _, fault in rows if fault]
    if faults:
        blocks.append(Bullets([f"Not exported: {fault}." for fault in faults], warning=True))
    table = Table(["model", "file", "result"])
    for model, name, fault in rows:
        result = "not exported" if fault else "the file gives the model's own answers"
        table.add(model, [Cell(name, mark="text"), Cell(result, mark="bad" if fault else "text")])
    blocks.append(table)
    return Section("Exports for controllers", blocks)
