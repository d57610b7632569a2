"""Findings of the data doctor, the registry of checks, and the inspection reports."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from residnet.core.log import Log
from residnet.core.units import unit_confusions
from residnet.quality.records import FindingRow, InspectionFile, LogInspection
from residnet.quality.records import Level as Level

LEVELS = ("note", "will mislead", "fatal")
SCHEMA: Final = "residnet.inspection/1"
_MAX_SUMMARY_KINDS = 4
"""Number of kinds of findings in a summary, which must fit into one line."""


@dataclass(frozen=True)
class Finding:
    """One fault or remark about a log.

    Attributes:
        level: `note`, `will mislead` (a fit is wrong unless the user acts) or `fatal` (the log is
            useless for a fit).
        code: identifier of the kind of finding, constant between versions.
        text: one line with figures.
        figures: numbers in SI units.
        action: recommended action; empty without one.
        sample_mask: affected samples [T] bool; None if the finding is not about single samples.
        effect: relative change of the dead-reckoning error or of a velocity if the fault is removed
            from the log (`residnet.quality.effects`), 0 if small; None if it was not measured.
        repair: returns a log with the fault corrected; None if no correction is known.
        is_record_fault: whether the recording itself is faulty, so that it must be corrected
            regardless of its effect on a fit.
        invalidates_samples: whether the affected samples are wrong, so that later checks must not
            use them.
    """

    level: Level
    code: str
    text: str
    figures: dict[str, float] = field(default_factory=dict)
    action: str = ""
    sample_mask: np.ndarray | None = field(default=None, repr=False, compare=False)
    effect: float | None = None
    repair: Callable[[Log], Log] | None = field(default=None, repr=False, compare=False)
    is_record_fault: bool = field(default=False, repr=False, compare=False)
    invalidates_samples: bool = field(default=False, repr=False, compare=False)

    @property
    def line(self) -> str:
        """One line with level, text and action."""
        return f"{self.level}: {self.text}" + (f"; {self.action}" if self.action else "")

    def downgrade_if_masked(self, mask: np.ndarray) -> Finding:
        """Return the finding as a note if a mask [T] excludes every affected sample."""
        is_masked = (
            self.sample_mask is not None
            and self.sample_mask.any()
            and bool(mask[self.sample_mask].all())
        )
        if not is_masked or self.level == "note":
            return self
        return dataclasses.replace(self, level="note", action="the config masks these samples")

    def to_row(self) -> FindingRow:
        """Return the finding as a row of doctor.json."""
        return FindingRow(
            level=self.level,
            code=self.code,
            text=self.text,
            action=self.action,
            effect=self.effect,
            figures={
                name: float(value) if math.isfinite(value) else None
                for name, value in self.figures.items()
            },
        )


_CheckFunction = Callable[[Any, "Check"], Iterable[Finding]]


@dataclass(frozen=True)
class Check:
    """Registered check of a log.

    The function of a check receives the check itself and calls it to create a finding, for example
    `yield check("u is constant")`. Code, level and action of the check are the defaults.

    Attributes:
        stage: stage of the inspection, see `residnet.quality.STAGE_DESCRIPTIONS`.
        code: default code of its findings.
        level: default level of its findings.
        fix: default of `Finding.action` of its findings.
        function: called with a log (or several) and the check; yields findings.
        required_channels: channels without which the check is skipped.
        is_record_fault: see `Finding`.
        invalidates_samples: see `Finding`.
        on_subsample: whether a long log is replaced by `LogStatistics.subsample`, because the check
            is statistical and does not report single samples.
    """

    stage: str
    code: str
    level: Level
    fix: str
    function: _CheckFunction
    required_channels: tuple[str, ...] = ()
    is_record_fault: bool = False
    invalidates_samples: bool = False
    on_subsample: bool = False

    def __call__(
        self,
        text: str,
        figures: Mapping[str, Any] | None = None,
        *,
        code: str = "",
        level: Level | None = None,
        fix: str | None = None,
        sample_mask: np.ndarray | None = None,
        repair: Callable[[Log], Log] | None = None,
    ) -> Finding:
        """Create a finding of this check; arguments that are not given default to the check.

        Args:
            text: one line with figures.
            figures: numbers in SI units.
            code: code of the finding.
            level: level of the finding.
            fix: recommended action, see `Finding.action`.
            sample_mask: affected samples [T] bool.
            repair: returns a log with the fault corrected.
        """
        return Finding(
            self.level if level is None else level,
            code or self.code,
            text,
            {name: float(value) for name, value in (figures or {}).items()},
            self.fix if fix is None else fix,
            sample_mask,
            repair=repair,
            is_record_fault=self.is_record_fault,
            invalidates_samples=self.invalidates_samples,
        )


CHECKS: list[Check] = []
"""All checks in the order of execution."""


def check(
    stage: str, code: str, level: Level = "will mislead", fix: str = "", **options: Any
) -> Callable[[_CheckFunction], _CheckFunction]:
    """Register a function as a check; the arguments are the attributes of `Check`."""

    def register(function: _CheckFunction) -> _CheckFunction:
        CHECKS.append(Check(stage, code, level, fix, function, **options))
        return function

    return register


def run_checks(stage: str, statistics: Any) -> list[Finding]:
    """Run the checks of a stage.

    Args:
        stage: see `residnet.quality.STAGE_DESCRIPTIONS`.
        statistics: `LogStatistics` of one log, or the `LogSet` of several.
    """
    findings: list[Finding] = []
    # NumPy warns about stretches of NaN, which the findings report themselves
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for check_ in CHECKS:
            if check_.stage == stage and all(
                name in statistics for name in check_.required_channels
            ):
                findings += check_.function(
                    statistics.subsample if check_.on_subsample else statistics, check_
                )
    return findings


@dataclass(frozen=True)
class InspectionReport:
    """Findings about one log, or about a set of logs.

    Attributes:
        name: name of the log; `together` for a set of logs.
        findings: findings in the order of the stages.
        source: file of the log; empty if unknown.
    """

    name: str
    findings: tuple[Finding, ...]
    source: str = ""

    @property
    def has_problems(self) -> bool:
        """Whether any finding is worse than a note, so that a fit would be misled."""
        return any(finding.level != "note" for finding in self.findings)

    def find_by_code(self, code: str) -> tuple[Finding, ...]:
        """Return the findings of one kind (`Finding.code`)."""
        return tuple(finding for finding in self.findings if finding.code == code)

    def to_lines(self) -> list[str]:
        """Return the report as text, one line per finding, the most severe first."""
        sorted_findings = sorted(
            self.findings,
            key=lambda reported_finding: _severity_key(reported_finding.to_row()),
            reverse=True,
        )
        return [f"{self.name}: {finding.line}" for finding in sorted_findings]

    def to_record(self) -> LogInspection:
        """Return the report as a part of doctor.json."""
        return LogInspection(
            name=self.name,
            source=self.source,
            misled=self.has_problems,
            findings=tuple(finding.to_row() for finding in self.findings),
        )


def convert_reader_findings(reader_notes: Iterable[Mapping[str, Any]]) -> list[Finding]:
    """Convert the remarks of a reader (`Log.meta["findings"]`) to findings."""
    return [Finding(**{"action": "", "figures": {}, **entry}) for entry in reader_notes]


def build_inspection(
    reports: Sequence[InspectionReport], between_logs: InspectionReport
) -> InspectionFile:
    """Return the contents of doctor.json.

    Args:
        reports: report on each log.
        between_logs: report on the set of logs.
    """
    inspection = InspectionFile(
        schema=SCHEMA,
        misled=any(report.has_problems for report in (*reports, between_logs)),
        logs=tuple(report.to_record() for report in reports),
        together=between_logs.to_record().findings,
    )
    summary = summarize_inspection(inspection)
    return inspection.model_copy(update={"tally": summary.tally, "first": summary.first_action})


@dataclass(frozen=True)
class InspectionSummary:
    """Counts of the findings that are worse than a note.

    Attributes:
        n_logs: number of inspected logs.
        n_logs_with_problems: number of logs with a finding that is worse than a note.
        n_logs_by_code: code of such a finding -> number of logs that have it, the most severe
            first; findings about the set of logs count as one log.
        tally: one sentence with these numbers.
        first_action: one sentence about the most severe finding; empty without findings.
    """

    n_logs: int
    n_logs_with_problems: int
    n_logs_by_code: Mapping[str, int] = field(default_factory=dict)
    tally: str = ""
    first_action: str = ""

    @property
    def sentences(self) -> list[str]:
        """The non-empty sentences."""
        return [line for line in (self.tally, self.first_action) if line]


def _severity_key(finding: FindingRow) -> tuple[int, float]:
    return LEVELS.index(finding.level), finding.effect or 0.0


def summarize_inspection(inspection: InspectionFile) -> InspectionSummary:
    """Count the findings of an inspection and select the most severe one.

    Findings are ranked by level, then by the largest measured effect on a fit, then by the number
    of logs that have them.

    Args:
        inspection: content of doctor.json, or the output of `residnet inspect --json`.
    """
    findings_by_code: dict[str, list[tuple[str, FindingRow]]] = {}
    for name, finding in inspection.named_findings:
        if finding.level != "note":
            findings_by_code.setdefault(finding.code, []).append((name, finding))
    n_logs = len(inspection.logs)
    if not findings_by_code:
        logs_text = "the log" if n_logs == 1 else f"the {n_logs} logs"
        return InspectionSummary(
            n_logs, 0, tally=f"Data checks: nothing in {logs_text} would mislead a fit."
        )
    logs_by_code = {
        code: {name for name, _ in code_findings}
        for code, code_findings in findings_by_code.items()
    }
    severity_by_code = {
        code: max(_severity_key(finding) for _, finding in code_findings)
        for code, code_findings in findings_by_code.items()
    }
    sorted_codes = sorted(
        findings_by_code,
        key=lambda code: (*severity_by_code[code], len(logs_by_code[code])),
        reverse=True,
    )
    n_logs_with_problems = len(set.union(*logs_by_code.values()) - {"together"})
    kind_texts = [
        f"{code.replace('_', ' ')} ({len(logs_by_code[code])})"
        for code in sorted_codes[:_MAX_SUMMARY_KINDS]
    ]
    n_omitted = len(sorted_codes) - len(kind_texts)
    omitted_text = (
        f" and {n_omitted} other kinds"
        if n_omitted > 1
        else " and one other kind"
        if n_omitted
        else ""
    )
    have = "has" if n_logs_with_problems == 1 else "have"
    count_text = "the log has" if n_logs == 1 else f"{n_logs_with_problems} of {n_logs} logs {have}"
    # a finding about the set of logs belongs to no single log
    subject_text = count_text if n_logs_with_problems else "the logs as a set have"
    tally = (
        f"Data checks: {subject_text} faults that would mislead a fit:"
        f" {', '.join(kind_texts)}{omitted_text}."
    )
    name, first_finding = max(
        findings_by_code[sorted_codes[0]],
        key=lambda name_and_finding: _severity_key(name_and_finding[1]),
    )
    log_prefix = "" if name == "together" else f"{name}: "
    action = f"; {first_finding.action}" if first_finding.action else ""
    effect = _severity_key(first_finding)[1]
    effect_text = f" It changes a fit by {100.0 * effect:.0f} %." if effect else ""
    first_action = f"First fix this: {log_prefix}{first_finding.text}{action}.{effect_text}"
    return InspectionSummary(
        n_logs,
        n_logs_with_problems,
        {code: len(logs_by_code[code]) for code in sorted_codes},
        tally,
        first_action,
    )


def format_quantity(quantity: float, unit: str) -> str:
    """Format an SI value with its unit; angles are converted to degrees."""
    if unit.startswith("rad"):
        return f"{math.degrees(quantity):.3g} {unit.replace('rad', 'deg', 1)}"
    return f"{quantity:.3g} {unit}" if unit != "-" else f"{quantity:.3g}"


def format_share(share: float) -> str:
    """Format a fraction as a percentage, with two digits below 10 %."""
    return f"{100.0 * share:.2g} %" if share < 0.1 else f"{100.0 * share:.0f} %"


def describe_unit_confusion(factor: float, *dimensions: str) -> str:
    """Return the confusion of units that explains a scale factor, in brackets.

    Args:
        factor: factor by which the values are too large.
        dimensions: SI units of the dimensions in question.

    Returns:
        For example ` (deg taken as rad)`; empty if no confusion is within 8 % of the factor.
    """
    if factor <= 0.0:
        return ""
    # where dimensions have the same factor, the text of the first dimension remains
    text_by_factor = {
        unit_factor: text
        for si in reversed(dimensions)
        for unit_factor, text in unit_confusions(si).items()
    }
    nearest_factor = min(
        text_by_factor,
        key=lambda unit_factor: abs(math.log(unit_factor / factor)),
        default=1.0,
    )
    return (
        f" ({text_by_factor[nearest_factor]})"
        if text_by_factor and abs(math.log(nearest_factor / factor)) < 0.08
        else ""
    )


def with_channels(log: Log, **channels: np.ndarray) -> Log:
    """Return the log with some channels replaced."""
    return log.replace(channels={**log.channels, **channels})


def make_correction(
    names: Sequence[str], factor: float = 1.0, offset: float = 0.0, delay: float = 0.0
) -> Callable[[Log], Log]:
    """Create a function that corrects scale, offset and delay of channels of a log.

    Args:
        names: channels to correct.
        factor: factor by which the values are too large.
        offset: offset in SI units that is added after scaling.
        delay: delay of the channels in s.
    """

    def correct_channel(log: Log, name: str) -> np.ndarray:
        corrected = np.interp(log.t + delay, log.t, log[name]) if delay else log[name]
        return np.asarray(corrected / factor + offset)

    return lambda log: with_channels(log, **{name: correct_channel(log, name) for name in names})
