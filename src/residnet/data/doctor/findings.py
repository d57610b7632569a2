"""The outcome of the data doctor: findings, and the report that holds them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.summary import LEVELS, summary

Level = Literal["note", "will mislead", "fatal"]
SCHEMA = "residnet.inspection/1"


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

    @property
    def line(self) -> str:
        """Level, text and what to do."""
        return f"{self.level}: {self.text}" + (f"; {self.action}" if self.action else "")

    def excused(self, masked: np.ndarray) -> Finding:
        """Return the finding as a note where masks [T] leave out every sample that it concerns."""
        if (
            self.at is None
            or self.level == "note"
            or not self.at.any()
            or not masked[self.at].all()
        ):
            return self
        return dataclasses.replace(self, level="note", action="the config masks these samples")

    def content(self) -> dict[str, Any]:
        """Return the finding as plain values for JSON."""
        figures = {
            name: float(value) if math.isfinite(value) else None
            for name, value in self.figures.items()
        }
        return {
            "level": self.level,
            "code": self.code,
            "text": self.text,
            "action": self.action,
            "effect": self.effect,
            "figures": figures,
        }


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
        order = sorted(
            self.findings,
            key=lambda finding: (-LEVELS.index(finding.level), -(finding.effect or 0.0)),
        )
        return [f"{self.name}: {finding.line}" for finding in order]

    def content(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        return {
            "name": self.name,
            "source": self.source,
            "misled": self.misled,
            "findings": [finding.content() for finding in self.findings],
        }


def inspection(reports: Sequence[Report], together: Report) -> dict[str, Any]:
    """Return all reports for JSON, schema residnet.inspection/1, with their tally."""
    misled = any(report.misled for report in (*reports, together))
    content = {
        "schema": SCHEMA,
        "misled": misled,
        "logs": [report.content() for report in reports],
        "together": together.content()["findings"],
    }
    counted = summary(content)
    return {**content, "tally": counted.tally, "first": counted.first}


def imported(remarks: Iterable[dict[str, Any]]) -> list[Finding]:
    """Return what a reader noted on the way in (`Log.meta["findings"]`)."""
    return [
        Finding(
            entry["level"],
            entry["code"],
            entry["text"],
            dict(entry.get("figures", {})),
            entry.get("action", ""),
        )
        for entry in remarks
    ]


def show(value: float, unit: str) -> str:
    """Return a value in SI as text; angles in degrees, which people read more easily."""
    if unit.startswith("rad"):
        return f"{math.degrees(value):.3g} {unit.replace('rad', 'deg', 1)}"
    return f"{value:.3g} {unit}" if unit != "-" else f"{value:.3g}"


def share_of(part: float) -> str:
    """Return a share in per cent."""
    return f"{100.0 * part:.2g} %" if part < 0.1 else f"{100.0 * part:.0f} %"


# values too large by this factor -> what happened to them
_SLIPS = {
    180.0 / math.pi: "deg taken as rad",
    math.pi / 180.0: "rad taken as deg",
    3600.0 / 1852.0: "knots taken as m/s",
    1852.0 / 3600.0: "m/s taken as knots",
    3.6: "km/h taken as m/s",
    1.0 / 3.6: "m/s taken as km/h",
    1.0 / 0.3048: "feet taken as metres",
    0.3048: "metres taken as feet",
    1000.0: "mm taken as m",
    0.001: "m taken as mm",
    100.0: "cm taken as m",
    0.01: "m taken as cm",
}


def unit_slip(factor: float) -> str:
    """Return what mistake of units makes values too large by `factor`; empty where none is near."""
    if factor <= 0.0:
        return ""
    best = min(_SLIPS, key=lambda known: abs(math.log(known / factor)))
    return _SLIPS[best] if abs(math.log(best / factor)) < 0.08 else ""


def with_channels(log: Log, **channels: np.ndarray) -> Log:
    """Return the log with some channels changed."""
    return log.replace(channels={**log.channels, **channels})


def shifted(names: Sequence[str], lag: float) -> Callable[[Log], Log]:
    """Return the correction of channels that trail by `lag` in s."""

    def repair(log: Log) -> Log:
        return with_channels(
            log, **{name: np.interp(log.t + lag, log.t, log[name]) for name in names}
        )

    return repair


def scaled(names: Sequence[str], factor: float) -> Callable[[Log], Log]:
    """Return the correction of channels that are too large by `factor`."""

    def repair(log: Log) -> Log:
        return with_channels(log, **{name: log[name] / factor for name in names})

    return repair


def raised(name: str, offset: float) -> Callable[[Log], Log]:
    """Return the correction of a channel that is too small by `offset`, SI."""

    def repair(log: Log) -> Log:
        return with_channels(log, **{name: log[name] + offset})

    return repair
