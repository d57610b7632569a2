"""Findings of the data doctor, the checks that make them, and the reports that hold them."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from residnet.core.log import Log
from residnet.core.units import unit_confusions

Level = Literal["note", "will mislead", "fatal"]
LEVELS = ("note", "will mislead", "fatal")
SCHEMA = "residnet.inspection/1"
_MAX_SUMMARY_KINDS = 4
"""Kinds of findings that a summary names, so that it stays one line."""


@dataclass(frozen=True)
class Finding:
    """One thing that the doctor saw.

    Attributes:
        level: `note`, `will mislead` (a fit comes out wrong unless something is done) or `fatal`
            (nothing can be learned from it).
        code: what kind of finding, fixed for programs that read the report.
        text: one line with figures.
        figures: the numbers, SI.
        action: what to do about it; empty where there is nothing to do.
        sample_mask: [T] bool, the samples concerned, where it concerns single samples.
        effect: what it does to a fit, measured: the share by which what a cheap one-step fit
            predicts changes without it; None where that was not measured.
        channels: that the samples concerned belong to, where it concerns single samples.
        repair: returns a log with the fault corrected, where the finding says how; what it changes
            is measured.
        is_record_fault: a fault of the record itself, to be corrected whatever a fit makes of it.
        invalidates_samples: the samples concerned are wrong, and no later check may rely on them.
    """

    level: Level
    code: str
    text: str
    figures: dict[str, float] = field(default_factory=dict)
    action: str = ""
    sample_mask: np.ndarray | None = field(default=None, repr=False, compare=False)
    effect: float | None = None
    channels: tuple[str, ...] = ()
    repair: Callable[[Log], Log] | None = field(default=None, repr=False, compare=False)
    is_record_fault: bool = field(default=False, repr=False, compare=False)
    invalidates_samples: bool = field(default=False, repr=False, compare=False)

    @property
    def to_line(self) -> str:
        """Level, text and what to do."""
        return f"{self.level}: {self.text}" + (f"; {self.action}" if self.action else "")

    def downgrade_if_masked(self, mask: np.ndarray) -> Finding:
        """Return the finding as a note where masks [T] leave out every sample that it concerns."""
        is_masked = (
            self.sample_mask is not None
            and self.sample_mask.any()
            and bool(mask[self.sample_mask].all())
        )
        if not is_masked or self.level == "note":
            return self
        return dataclasses.replace(self, level="note", action="the config masks these samples")

    def to_json(self) -> dict[str, Any]:
        """Return the finding as plain values for JSON."""
        figures = {
            name: float(value) if math.isfinite(value) else None
            for name, value in self.figures.items()
        }
        fields = {name: getattr(self, name) for name in ("level", "code", "text", "action")}
        return {**fields, "effect": self.effect, "figures": figures}


@dataclass(frozen=True)
class Check:
    """One thing that the doctor looks for.

    Called with a text it makes the finding of this check; what is not given is that of the check.

    Attributes:
        stage: when it looks, and at which state of a log (`residnet.quality.STAGES`).
        code: of its findings.
        level: of its findings.
        fix: what to do about them.
        required_channels: channels without which it has nothing to say.
        is_record_fault: see `Finding`.
        invalidates_samples: see `Finding`.
        on_subsample: it tells nothing of single samples, and evenly spread stretches of a long log say what
            the whole says (`LogStatistics.subsample`).
        function: the function; given a log under examination (or several) and the check.
    """

    stage: str
    code: str
    level: Level
    fix: str
    required_channels: tuple[str, ...]
    is_record_fault: bool
    invalidates_samples: bool
    on_subsample: bool
    function: Callable[[Any, Check], Iterable[Finding]]

    def __call__(
        self,
        text: str,
        figures: Mapping[str, Any] | None = None,
        *,
        code: str = "",
        level: Level | None = None,
        fix: str | None = None,
        sample_mask: np.ndarray | None = None,
        channels: tuple[str, ...] = (),
        repair: Callable[[Log], Log] | None = None,
    ) -> Finding:
        """Return a finding; `figures` are its numbers, SI."""
        return Finding(
            self.level if level is None else level,
            code or self.code,
            text,
            {name: float(value) for name, value in (figures or {}).items()},
            self.fix if fix is None else fix,
            sample_mask,
            channels=channels,
            repair=repair,
            is_record_fault=self.is_record_fault,
            invalidates_samples=self.invalidates_samples,
        )


CHECKS: list[Check] = []
"""All checks, in the order in which they look."""

_CheckFunction = Callable[[Any, Check], Iterable[Finding]]


def check(
    stage: str,
    code: str,
    level: Level = "will mislead",
    fix: str = "",
    *,
    required_channels: tuple[str, ...] = (),
    is_record_fault: bool = False,
    invalidates_samples: bool = False,
    on_subsample: bool = False,
) -> Callable[[_CheckFunction], _CheckFunction]:
    """Register a function as a check; the arguments are the attributes of `Check`."""

    def register(function: _CheckFunction) -> _CheckFunction:
        CHECKS.append(
            Check(
                stage,
                code,
                level,
                fix,
                required_channels,
                is_record_fault,
                invalidates_samples,
                on_subsample,
                function,
            )
        )
        return function

    return register


def run_checks(stage: str, statistics: Any) -> list[Finding]:
    """Return what the checks of a stage find in a log, or between several."""
    findings: list[Finding] = []
    # a stretch without a number is no news to who measured it
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
    """What the doctor found in one log, or in several logs beside each other.

    Attributes:
        name: the log; `between_logs` for several.
        findings: in the order import, clock, values, frames, inputs, excitation.
        source: file that it came from; empty where there is none.
    """

    name: str
    findings: tuple[Finding, ...]
    source: str = ""

    @property
    def has_problems(self) -> bool:
        """Whether a fit to this log would be misled: any finding is above a note."""
        return any(finding.level != "note" for finding in self.findings)

    def with_findings(self, additional_findings: Sequence[Finding]) -> InspectionReport:
        """Return the report with further findings."""
        return dataclasses.replace(self, findings=(*self.findings, *additional_findings))

    def find_by_code(self, code: str) -> tuple[Finding, ...]:
        """Return the findings of one code."""
        return tuple(finding for finding in self.findings if finding.code == code)

    def to_lines(self) -> list[str]:
        """Return the report as text, one line per finding, the worst first."""
        sorted_findings = sorted(
            self.findings,
            key=lambda reported_finding: _severity_key(reported_finding.to_json()),
            reverse=True,
        )
        return [f"{self.name}: {finding.to_line}" for finding in sorted_findings]

    def to_json(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        findings = [finding.to_json() for finding in self.findings]
        metadata = {"name": self.name, "source": self.source, "misled": self.has_problems}
        return {**metadata, "findings": findings}


def convert_reader_findings(reader_notes: Iterable[Mapping[str, Any]]) -> list[Finding]:
    """Return what a reader noted on the way in (`Log.meta["findings"]`)."""
    return [Finding(**{"action": "", "figures": {}, **entry}) for entry in reader_notes]


def build_inspection(
    reports: Sequence[InspectionReport], between_logs: InspectionReport
) -> dict[str, Any]:
    """Return all reports for JSON, schema residnet.inspection/1, with their tally."""
    content = {
        "schema": SCHEMA,
        "misled": any(report.has_problems for report in (*reports, between_logs)),
        "logs": [report.to_json() for report in reports],
        "together": between_logs.to_json()["findings"],
    }
    inspection_summary = summarize_inspection(content)
    return {**content, "tally": inspection_summary.tally, "first": inspection_summary.first_action}


@dataclass(frozen=True)
class InspectionSummary:
    """The findings above a note, counted.

    Attributes:
        n_logs: number of logs that were looked at.
        n_logs_with_problems: number of logs with a finding above a note.
        n_logs_by_code: code of a finding above a note -> number of logs that have it, the worst first;
            findings between logs count as one.
        tally: one sentence with these numbers.
        first_action: one sentence that begins with "First fix this:"; empty where there is nothing.
    """

    n_logs: int
    n_logs_with_problems: int
    n_logs_by_code: Mapping[str, int] = field(default_factory=dict)
    tally: str = ""
    first_action: str = ""

    @property
    def sentences(self) -> list[str]:
        """The sentences that there are."""
        return [line for line in (self.tally, self.first_action) if line]


def _severity_key(finding: Mapping[str, Any]) -> tuple[int, float]:
    return LEVELS.index(finding["level"]), float(finding.get("effect") or 0.0)


def summarize_inspection(inspection: Mapping[str, Any]) -> InspectionSummary:
    """Return the tally of an inspection, and the finding to look at first.

    Findings are ranked by level, then by the largest measured effect on a fit, then by the number
    of logs that have them.

    Args:
        inspection: content of doctor.json, or of `residnet inspect --json`.
    """
    logs: Sequence[Mapping[str, Any]] = inspection.get("logs") or []
    between_logs = {"name": "together", "findings": inspection.get("together") or []}
    findings_by_code: dict[str, list[tuple[str, Mapping[str, Any]]]] = {}
    for log_report in (*logs, between_logs):
        for finding in log_report["findings"]:
            if finding["level"] != "note":
                findings_by_code.setdefault(str(finding["code"]), []).append(
                    (str(log_report["name"]), finding)
                )
    n_logs = len(logs)
    if not findings_by_code:
        logs_text = "the log" if n_logs == 1 else f"the {n_logs} logs"
        return InspectionSummary(
            n_logs, 0, tally=f"Data doctor: nothing in {logs_text} would mislead a fit."
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
    count_text = "the log holds" if n_logs == 1 else f"{n_logs_with_problems} of {n_logs} logs hold"
    subject_text = count_text if n_logs_with_problems else "the logs together hold"
    tally = f"Data doctor: {subject_text} something that would mislead a fit: {', '.join(kind_texts)}{omitted_text}."
    name, first_finding = max(
        findings_by_code[sorted_codes[0]],
        key=lambda name_and_finding: _severity_key(name_and_finding[1]),
    )
    log_prefix = "" if name == "together" else f"{name}: "
    action = f"; {first_finding['action']}" if first_finding["action"] else ""
    effect = _severity_key(first_finding)[1]
    effect_text = f" It changes a fit by {100.0 * effect:.0f} %." if effect else ""
    text = f"First fix this: {log_prefix}{first_finding['text']}{action}.{effect_text}"
    return InspectionSummary(
        n_logs,
        n_logs_with_problems,
        {code: len(logs_by_code[code]) for code in sorted_codes},
        tally,
        text,
    )


def format_quantity(quantity: float, unit: str) -> str:
    """Return a value in SI as text; angles in degrees, which people read more easily."""
    if unit.startswith("rad"):
        return f"{math.degrees(quantity):.3g} {unit.replace('rad', 'deg', 1)}"
    return f"{quantity:.3g} {unit}" if unit != "-" else f"{quantity:.3g}"


def format_share(share: float) -> str:
    """Return a share in per cent."""
    return f"{100.0 * share:.2g} %" if share < 0.1 else f"{100.0 * share:.0f} %"


def describe_unit_confusion(factor: float, *dimensions: str) -> str:
    """Return the mistake of units that makes values too large by a factor, in brackets.

    Empty where none of these dimensions, each told by its SI unit, has one within 8 %.
    """
    if factor <= 0.0:
        return ""
    text_by_factor = {
        unit_factor: text
        for si in reversed(dimensions)
        for unit_factor, text in unit_confusions(si).items()
    }
    nearest_factor = min(text_by_factor, key=lambda size: abs(math.log(size / factor)), default=1.0)
    return (
        f" ({text_by_factor[nearest_factor]})"
        if text_by_factor and abs(math.log(nearest_factor / factor)) < 0.08
        else ""
    )


def with_channels(log: Log, **channels: np.ndarray) -> Log:
    """Return the log with some channels changed."""
    return log.replace(channels={**log.channels, **channels})


def make_correction(
    names: Sequence[str], factor: float = 1.0, offset: float = 0.0, delay: float = 0.0
) -> Callable[[Log], Log]:
    """Return the repair of channels too large by `factor`, too small by `offset`, `delay` s late."""

    def correct_channel(log: Log, name: str) -> np.ndarray:
        corrected = np.interp(log.t + delay, log.t, log[name]) if delay else log[name]
        return np.asarray(corrected / factor + offset)

    return lambda log: with_channels(log, **{name: correct_channel(log, name) for name in names})
