"""Typed contents of the file of data checks."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from residnet.core.records import FileRecord, Record

Level = Literal["note", "will mislead", "fatal"]
"""Severity of a finding: a remark, a fault that misleads a fit, a log without use for a fit."""


class FindingRow(Record):
    """One fault or remark about a log.

    Attributes:
        level: severity.
        code: kind of finding.
        text: one line with figures.
        action: recommended action; empty if there is none.
        effect: relative change of the predictions of a one-step fit without the fault; None if it
            was not measured.
        figures: numbers in SI units; None for a number that is not finite.
    """

    level: Level
    code: str
    text: str
    action: str
    effect: float | None = None
    figures: dict[str, float | None] = Field(default_factory=dict)


class LogInspection(Record):
    """The findings about one log.

    Attributes:
        name: name of the log.
        source: file of the log; empty if unknown.
        misled: whether a finding is worse than a note.
        findings: in the order of the checks.
    """

    name: str
    source: str
    misled: bool
    findings: tuple[FindingRow, ...]


class InspectionFile(FileRecord):
    """doctor.json: the findings of the data checks.

    Attributes:
        misled: whether a finding is worse than a note.
        logs: findings by log.
        together: findings about the set of logs.
        tally: one sentence with the numbers of findings.
        first: one sentence about the most severe finding; empty if there is none.
    """

    schema_name: Literal["residnet.inspection/1"] = Field(alias="schema")
    misled: bool
    logs: tuple[LogInspection, ...]
    together: tuple[FindingRow, ...]
    tally: str = ""
    first: str = ""

    @property
    def named_findings(self) -> list[tuple[str, FindingRow]]:
        """All findings with the name of the log; `together` for the set of logs."""
        findings = [(log.name, finding) for log in self.logs for finding in log.findings]
        return findings + [("together", finding) for finding in self.together]
