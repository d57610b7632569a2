"""Headings that were not made continuous, or that a wrap has been averaged across."""

from __future__ import annotations

import math

import numpy as np

from residnet.core.log import Log
from residnet.data.doctor.findings import Finding
from residnet.data.readers.base import unwrap

_ANGLES = ("psi", "phi")
# one full circle in rad, and in degrees that were taken for rad
_CIRCLES = ((2.0 * math.pi, ""), (360.0, " of 360: degrees taken as rad"))


def wrap_findings(log: Log) -> list[Finding]:
    """Return the jumps of a heading by a full circle."""
    out = []
    for name in _ANGLES:
        if name not in log.channels:
            continue
        for circle, what in _CIRCLES:
            at = _wraps(log, name, circle)
            if at.any():
                text = (
                    f"{name} wraps {int(at.sum())} times{what}, first at t ="
                    f" {log.t[np.argmax(at)]:.2f} s: logs hold it continuous"
                )
                figures = {"count": at.sum(), "t": float(log.t[np.argmax(at)])}
                out.append(
                    Finding(
                        "will mislead",
                        "heading_wrap",
                        text,
                        figures,
                        "unwrap it before it is filtered or differentiated",
                    )
                )
    return out


def _wraps(log: Log, name: str, circle: float) -> np.ndarray:
    """Return [T] bool: samples that arrive by about a full circle.

    The step is from the sample before, or the one before that (a wrap with a sample in between).
    """
    known = np.isfinite(log[name])
    change = np.diff(log[name][known], prepend=log[name][known][:1])
    out = np.zeros(len(log), dtype=bool)
    out[known] = np.abs(np.abs(change) - circle) < 0.25 * circle
    return out


def unwrapped(log: Log) -> Log:
    """Return the log with its headings continuous."""
    channels = {
        name: unwrap(values) if name in _ANGLES else values for name, values in log.channels.items()
    }
    return log.replace(channels=channels)
