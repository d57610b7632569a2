"""What the data doctor found in all logs, in two sentences: a tally, and what to correct first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

LEVELS = ("note", "will mislead", "fatal")
_MOST_KINDS = 4


@dataclass(frozen=True)
class Summary:
    """The findings above a note, counted.

    Attributes:
        logs: number of logs that were looked at.
        misled: number of logs with a finding above a note.
        kinds: code of a finding above a note -> number of logs that have it, the worst first;
            findings between logs count as one.
        tally: one sentence with these numbers.
        first: one sentence that begins with "First fix this:"; empty where there is nothing.
    """

    logs: int
    misled: int
    kinds: Mapping[str, int] = field(default_factory=dict)
    tally: str = ""
    first: str = ""

    @property
    def lines(self) -> list[str]:
        """The sentences that there are."""
        return [line for line in (self.tally, self.first) if line]


def summary(inspection: Mapping[str, Any]) -> Summary:
    """Return the tally of an inspection, and the finding to look at first.

    Findings are ranked by level, then by the largest measured effect on a fit, then by the number
    of logs that have them.

    Args:
        inspection: content of doctor.json, or of `residnet inspect --json`.
    """
    logs: Sequence[Mapping[str, Any]] = inspection.get("logs") or []
    found = [
        (str(entry["name"]), finding)
        for entry in logs
        for finding in entry["findings"]
        if finding["level"] != "note"
    ]
    misled = len({name for name, _ in found})
    found += [
        ("together", finding)
        for finding in inspection.get("together") or []
        if finding["level"] != "note"
    ]
    if not found:
        what = "the log" if len(logs) == 1 else f"the {len(logs)} logs"
        return Summary(len(logs), 0, tally=f"Data doctor: nothing in {what} would mislead a fit.")
    members: dict[str, list[tuple[str, Mapping[str, Any]]]] = {}
    for name, finding in found:
        members.setdefault(str(finding["code"]), []).append((name, finding))
    where = {code: len({name for name, _ in part}) for code, part in members.items()}
    worst = {code: max((_weight(finding) for _, finding in part)) for code, part in members.items()}
    order = sorted(members, key=lambda code: (*worst[code], where[code]), reverse=True)
    kinds = {code: where[code] for code in order}
    name, finding = max(members[order[0]], key=lambda pair: _weight(pair[1]))
    return Summary(
        len(logs), misled, kinds, _tally(len(logs), misled, kinds), _first(name, finding)
    )


def _weight(finding: Mapping[str, Any]) -> tuple[int, float]:
    return LEVELS.index(finding["level"]), float(finding.get("effect") or 0.0)


def _tally(logs: int, misled: int, kinds: Mapping[str, int]) -> str:
    shown = [f"{code.replace('_', ' ')} ({count})" for code, count in kinds.items()][:_MOST_KINDS]
    rest = len(kinds) - len(shown)
    more = f" and {rest} other kinds" if rest > 1 else " and one other kind" if rest else ""
    verb = "holds" if logs == 1 else "hold"
    of = "the log" if logs == 1 else f"{misled} of {logs} logs"
    if not misled:
        of, verb = "the logs together", "hold"
    return f"Data doctor: {of} {verb} something that would mislead a fit: {', '.join(shown)}{more}."


def _first(name: str, finding: Mapping[str, Any]) -> str:
    where = "" if name == "together" else f"{name}: "
    effect = finding.get("effect")
    size = f" It changes a fit by {100.0 * effect:.0f} %." if effect else ""
    action = f"; {finding['action']}" if finding["action"] else ""
    return f"First fix this: {where}{finding['text']}{action}.{size}"
