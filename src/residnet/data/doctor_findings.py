"""What the data doctor says: findings, and the report that holds them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

Level = Literal["info", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One thing that the doctor saw.

    Attributes:
        level: `info`, `warning` (look at it, mask it) or `error` (a fit would be misled).
        code: what kind of finding, fixed for programs that read the report.
        text: one line with figures.
        figures: the numbers, SI.
    """

    level: Level
    code: str
    text: str
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Report:
    """What `inspect` found in one log.

    Attributes:
        name: the log.
        findings: in the order channels, clock, values, frames, excitation.
    """

    name: str
    findings: tuple[Finding, ...]

    @property
    def misled(self) -> bool:
        """Whether a fit to this log would be misled: any finding is an error."""
        return any(finding.level == "error" for finding in self.findings)

    def find(self, code: str) -> tuple[Finding, ...]:
        """Findings of one code."""
        return tuple(finding for finding in self.findings if finding.code == code)

    def lines(self) -> list[str]:
        """The report as text, one line per finding."""
        return [f"{self.name}: {finding.level}: {finding.text}" for finding in self.findings]


def show(value: float, unit: str) -> str:
    """A value in SI as text; angles in degrees, which people read more easily."""
    if unit.startswith("rad"):
        return f"{math.degrees(value):.3g} {unit.replace('rad', 'deg', 1)}"
    return f"{value:.3g} {unit}" if unit != "-" else f"{value:.3g}"
