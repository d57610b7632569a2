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
from residnet.core.units import slips

Level = Literal["note", "will mislead", "fatal"]
LEVELS = ("note", "will mislead", "fatal")
SCHEMA = "residnet.inspection/1"
_MOST_KINDS = 4
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
        at: [T] bool, the samples concerned, where it concerns single samples.
        effect: what it does to a fit, measured: the share by which what a cheap one-step fit
            predicts changes without it; None where that was not measured.
        channels: that the samples concerned belong to, where it concerns single samples.
        repair: returns a log with the fault corrected, where the finding says how; what it changes
            is measured.
        certain: a fault of the record itself, to be corrected whatever a fit makes of it.
        spoils: the samples concerned are wrong, and no later check may rely on them.
    """

    level: Level
    code: str
    text: str
    figures: dict[str, float] = field(default_factory=dict)
    action: str = ""
    at: np.ndarray | None = field(default=None, repr=False, compare=False)
    effect: float | None = None
    channels: tuple[str, ...] = ()
    repair: Callable[[Log], Log] | None = field(default=None, repr=False, compare=False)
    certain: bool = field(default=False, repr=False, compare=False)
    spoils: bool = field(default=False, repr=False, compare=False)

    @property
    def line(self) -> str:
        """Level, text and what to do."""
        return f"{self.level}: {self.text}" + (f"; {self.action}" if self.action else "")

    def excused(self, masked: np.ndarray) -> Finding:
        """Return the finding as a note where masks [T] leave out every sample that it concerns."""
        concerned = self.at is not None and self.at.any() and bool(masked[self.at].all())
        if not concerned or self.level == "note":
            return self
        return dataclasses.replace(self, level="note", action="the config masks these samples")

    def content(self) -> dict[str, Any]:
        """Return the finding as plain values for JSON."""
        figures = {
            name: float(value) if math.isfinite(value) else None
            for name, value in self.figures.items()
        }
        plain = {name: getattr(self, name) for name in ("level", "code", "text", "action")}
        return {**plain, "effect": self.effect, "figures": figures}


@dataclass(frozen=True)
class Check:
    """One thing that the doctor looks for.

    Called with a text it makes the finding of this check; what is not given is that of the check.

    Attributes:
        stage: when it looks, and at which state of a log (`residnet.data.doctor.STAGES`).
        code: of its findings.
        level: of its findings.
        fix: what to do about them.
        needs: channels without which it has nothing to say.
        certain: see `Finding`.
        spoils: see `Finding`.
        few: it tells nothing of single samples, and evenly spread stretches of a long log say what
            the whole says (`Record.few`).
        body: the function; given a log under examination (or several) and the check.
    """

    stage: str
    code: str
    level: Level
    fix: str
    needs: tuple[str, ...]
    certain: bool
    spoils: bool
    few: bool
    body: Callable[[Any, Check], Iterable[Finding]]

    def __call__(
        self,
        text: str,
        figures: Mapping[str, Any] | None = None,
        *,
        code: str = "",
        level: Level | None = None,
        fix: str | None = None,
        at: np.ndarray | None = None,
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
            at,
            channels=channels,
            repair=repair,
            certain=self.certain,
            spoils=self.spoils,
        )


CHECKS: list[Check] = []
"""All checks, in the order in which they look."""

_Body = Callable[[Any, Check], Iterable[Finding]]


def check(
    stage: str,
    code: str,
    level: Level = "will mislead",
    fix: str = "",
    *,
    needs: tuple[str, ...] = (),
    certain: bool = False,
    spoils: bool = False,
    few: bool = False,
) -> Callable[[_Body], _Body]:
    """Register a function as a check; the arguments are the attributes of `Check`."""

    def register(body: _Body) -> _Body:
        CHECKS.append(Check(stage, code, level, fix, needs, certain, spoils, few, body))
        return body

    return register


def run(stage: str, subject: Any) -> list[Finding]:
    """Return what the checks of a stage find in a log, or between several."""
    found: list[Finding] = []
    # a stretch without a number is no news to who measured it
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for one in CHECKS:
            if one.stage == stage and all(name in subject for name in one.needs):
                found += one.body(subject.few if one.few else subject, one)
    return found


@dataclass(frozen=True)
class Report:
    """What the doctor found in one log, or in several logs beside each other.

    Attributes:
        name: the log; `together` for several.
        findings: in the order import, clock, values, frames, inputs, excitation.
        source: file that it came from; empty where there is none.
    """

    name: str
    findings: tuple[Finding, ...]
    source: str = ""

    @property
    def misled(self) -> bool:
        """Whether a fit to this log would be misled: any finding is above a note."""
        return any(finding.level != "note" for finding in self.findings)

    def joined(self, further: Sequence[Finding]) -> Report:
        """Return the report with further findings."""
        return dataclasses.replace(self, findings=(*self.findings, *further))

    def find(self, code: str) -> tuple[Finding, ...]:
        """Return the findings of one code."""
        return tuple(finding for finding in self.findings if finding.code == code)

    def lines(self) -> list[str]:
        """Return the report as text, one line per finding, the worst first."""
        order = sorted(self.findings, key=lambda one: _weight(one.content()), reverse=True)
        return [f"{self.name}: {finding.line}" for finding in order]

    def content(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        findings = [finding.content() for finding in self.findings]
        about = {"name": self.name, "source": self.source, "misled": self.misled}
        return {**about, "findings": findings}


def imported(remarks: Iterable[Mapping[str, Any]]) -> list[Finding]:
    """Return what a reader noted on the way in (`Log.meta["findings"]`)."""
    return [Finding(**{"action": "", "figures": {}, **entry}) for entry in remarks]


def inspection(reports: Sequence[Report], together: Report) -> dict[str, Any]:
    """Return all reports for JSON, schema residnet.inspection/1, with their tally."""
    content = {
        "schema": SCHEMA,
        "misled": any(report.misled for report in (*reports, together)),
        "logs": [report.content() for report in reports],
        "together": together.content()["findings"],
    }
    counted = summary(content)
    return {**content, "tally": counted.tally, "first": counted.first}


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


def _weight(finding: Mapping[str, Any]) -> tuple[int, float]:
    return LEVELS.index(finding["level"]), float(finding.get("effect") or 0.0)


def summary(inspection: Mapping[str, Any]) -> Summary:
    """Return the tally of an inspection, and the finding to look at first.

    Findings are ranked by level, then by the largest measured effect on a fit, then by the number
    of logs that have them.

    Args:
        inspection: content of doctor.json, or of `residnet inspect --json`.
    """
    logs: Sequence[Mapping[str, Any]] = inspection.get("logs") or []
    together = {"name": "together", "findings": inspection.get("together") or []}
    members: dict[str, list[tuple[str, Mapping[str, Any]]]] = {}
    for entry in (*logs, together):
        for finding in entry["findings"]:
            if finding["level"] != "note":
                members.setdefault(str(finding["code"]), []).append((str(entry["name"]), finding))
    count = len(logs)
    if not members:
        what = "the log" if count == 1 else f"the {count} logs"
        return Summary(count, 0, tally=f"Data doctor: nothing in {what} would mislead a fit.")
    where = {code: {name for name, _ in part} for code, part in members.items()}
    worst = {code: max(_weight(finding) for _, finding in part) for code, part in members.items()}
    order = sorted(members, key=lambda code: (*worst[code], len(where[code])), reverse=True)
    misled = len(set.union(*where.values()) - {"together"})
    shown = [f"{code.replace('_', ' ')} ({len(where[code])})" for code in order[:_MOST_KINDS]]
    rest = len(order) - len(shown)
    more = f" and {rest} other kinds" if rest > 1 else " and one other kind" if rest else ""
    some = "the log holds" if count == 1 else f"{misled} of {count} logs hold"
    of = some if misled else "the logs together hold"
    tally = f"Data doctor: {of} something that would mislead a fit: {', '.join(shown)}{more}."
    name, first = max(members[order[0]], key=lambda pair: _weight(pair[1]))
    place = "" if name == "together" else f"{name}: "
    action = f"; {first['action']}" if first["action"] else ""
    effect = _weight(first)[1]
    size = f" It changes a fit by {100.0 * effect:.0f} %." if effect else ""
    text = f"First fix this: {place}{first['text']}{action}.{size}"
    return Summary(count, misled, {code: len(where[code]) for code in order}, tally, text)


def show(value: float, unit: str) -> str:
    """Return a value in SI as text; angles in degrees, which people read more easily."""
    if unit.startswith("rad"):
        return f"{math.degrees(value):.3g} {unit.replace('rad', 'deg', 1)}"
    return f"{value:.3g} {unit}" if unit != "-" else f"{value:.3g}"


def share_of(part: float) -> str:
    """Return a share in per cent."""
    return f"{100.0 * part:.2g} %" if part < 0.1 else f"{100.0 * part:.0f} %"


def slip_in_words(factor: float, *dimensions: str) -> str:
    """Return the mistake of units that makes values too large by a factor, in brackets.

    Empty where none of these dimensions, each told by its SI unit, has one within 8 %.
    """
    if factor <= 0.0:
        return ""
    known = {size: text for si in reversed(dimensions) for size, text in slips(si).items()}
    best = min(known, key=lambda size: abs(math.log(size / factor)), default=1.0)
    return f" ({known[best]})" if known and abs(math.log(best / factor)) < 0.08 else ""


def with_channels(log: Log, **channels: np.ndarray) -> Log:
    """Return the log with some channels changed."""
    return log.replace(channels={**log.channels, **channels})


def correction(
    names: Sequence[str], factor: float = 1.0, offset: float = 0.0, lag: float = 0.0
) -> Callable[[Log], Log]:
    """Return the repair of channels too large by `factor`, too small by `offset`, `lag` s late."""

    def right(log: Log, name: str) -> np.ndarray:
        values = np.interp(log.t + lag, log.t, log[name]) if lag else log[name]
        return np.asarray(values / factor + offset)

    return lambda log: with_channels(log, **{name: right(log, name) for name in names})
