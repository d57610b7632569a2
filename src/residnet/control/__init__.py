"""Controllers and guidance that close the loop around any model."""

from __future__ import annotations

from residnet.control.bang_bang import BangBangHeading
from residnet.control.base import ClosedLoop, GivenReference, Policy, Reference
from residnet.control.document_autopilot import DocumentAutopilot, Predictor, SimulatedPredictor
from residnet.control.heading_pid import HeadingPID

__all__ = [
    "BangBangHeading",
    "ClosedLoop",
    "DocumentAutopilot",
    "GivenReference",
    "HeadingPID",
    "Policy",
    "Predictor",
    "Reference",
    "SimulatedPredictor",
]
