"""The findings of the data doctor: what would mislead a fit to these logs, and its notes."""

from __future__ import annotations

from residnet.report.blocks import Block, Bullets, Cell, Section, Table, Text
from residnet.report.format import minus
from residnet.report.run_reader import Content, RunFiles

_LEVELS = ("fatal", "will mislead")
"""Levels above a note, the worst first."""


def section(run: RunFiles) -> Section | None:
    """Return the findings by kind and the notes by log, None where the run has no doctor.json."""
    inspection = run.json("doctor.json")
    logs = inspection.get("logs") or []
    if not logs:
        return None
    findings = [(str(entry["name"]), finding) for entry in logs for finding in entry["findings"]]
    findings += [("together", finding) for finding in inspection.get("together") or []]
    severe = [(name, finding) for name, finding in findings if finding["level"] != "note"]
    misled = len({name for name, _ in severe} - {"together"})
    beyond = "What the masks of this run leave out does not count."
    blocks: list[Block] = []
    if severe:
        held = "log holds" if len(logs) == 1 else "logs hold"
        blocks.append(
            Text(f"{misled} of {len(logs)} {held} something that would mislead a fit. {beyond}")
        )
        blocks.append(_table(severe))
    else:
        count = "the log" if len(logs) == 1 else f"the {len(logs)} logs"
        blocks.append(Text(f"Nothing in {count} would mislead a fit. {beyond}"))
    notes: dict[str, list[str]] = {}
    for name, finding in findings:
        if finding["level"] == "note":
            action = f"; {finding['action']}" if finding["action"] else ""
            notes.setdefault(name, []).append(minus(f"{finding['text']}{action}"))
    if notes:
        by_log = [Section(name, [Bullets(texts)]) for name, texts in notes.items()]
        blocks.append(Section("Notes, log by log", by_log, folded=True))
    return Section("Data doctor", blocks)


def _table(severe: list[tuple[str, Content]]) -> Table:
    """Return one row for each kind of finding, the worst first."""
    table = Table(["finding", "level", "logs", "for example", "what to do"])
    kinds = sorted(
        {(_LEVELS.index(finding["level"]), str(finding["code"])) for _, finding in severe}
    )
    for level, code in kinds:
        members = [
            (name, finding)
            for name, finding in severe
            if (finding["level"], finding["code"]) == (_LEVELS[level], code)
        ]
        name, finding = members[0]
        table.add(
            code.replace("_", " "),
            [
                Cell(_LEVELS[level], mark="bad" if level == 0 else ""),
                str(len({other for other, _ in members})),
                Cell(minus(str(finding["text"])), note=name, mark="text"),
                Cell(str(finding["action"]), mark="text"),
            ],
        )
    return table
