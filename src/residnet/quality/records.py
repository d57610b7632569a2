"""Typed contents of the file of data checks."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from residnet.core.records import FileRecord, FileRows, Record

COMPATIBILITY_FILE = "compatibility.json"
"""File of a run folder with the instrument errors of measured logs."""
Level = Literal["note", "will mislead", "fatal"]
"""Severity of a finding: a remark, a fault that misleads a fit, a log without use for a fit."""


class FindingRow(Record):
    """One fault or remark about a log.

    Attributes:
        level: severity.
        code: kind of finding.
        text: one line with figures.
        action: recommended action; empty without one.
        effect: relative change of dead reckoning or of a velocity without the fault; None if it
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
        findings: findings in the order of the checks.
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
        first: one sentence about the most severe finding; empty without findings.
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


class InstrumentErrorRow(Record):
    """One instrument error of a log.

    Attributes:
        name: name of the error.
        unit: SI unit.
        value: estimate.
        standard_error: standard error of the estimate.
        is_determined: whether sensors determine it; otherwise the smoothness of the motion does,
            and the standard error makes no interval.
        is_significant: whether it differs from zero by 3.5 standard errors and more than smoothness
            explains; a clock also by half a sample.
    """

    name: str
    unit: str
    value: float
    standard_error: float
    is_determined: bool
    is_significant: bool


class CurrentTest(Record):
    """Likelihood-ratio test of a current between velocities through the water and positions.

    Attributes:
        north: component of the current in m/s.
        east: component of the current in m/s.
        standard_error: larger one of the standard errors of both components in m/s.
        statistic: likelihood ratio, reduced by the autocorrelation of the residuals.
        p_value: probability of such a statistic without a current.
        is_significant: whether the current is significant and large enough for a fit.
    """

    north: float
    east: float
    standard_error: float
    statistic: float
    p_value: float
    is_significant: bool


class CompatibilityRow(Record):
    """Data compatibility analysis of one log.

    Attributes:
        log: name of the log.
        meaning: most likely meaning of its velocities; empty if none are measured.
        runner_up: next meaning.
        margin: difference of the BIC between both, reduced by the autocorrelation of the residuals.
        errors: instrument errors.
        current: test of a current; None without velocities.
        reason: why there is no analysis; empty if there is one.
    """

    log: str
    meaning: str = ""
    runner_up: str = ""
    margin: float = 0.0
    errors: tuple[InstrumentErrorRow, ...] = ()
    current: CurrentTest | None = None
    reason: str = ""


class CompatibilityFile(FileRows[CompatibilityRow]):
    """compatibility.json: instrument errors and meanings of the velocities, a row for each log."""
