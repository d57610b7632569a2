"""Controllers and guidance that close the loop around any model."""

from __future__ import annotations

from residnet.autopilot.base import ClosedLoop, Policy, RecordedReference, Reference
from residnet.autopilot.heading.classical import BangBangHeading, HeadingPD
from residnet.autopilot.motion import (
    AllocatedPolicy,
    FeedForward,
    HullFeedForward,
    MotionPID,
    MotionPIDConfig,
    NoFeedForward,
    ReferenceFilter,
    ReferenceFilterConfig,
)

__all__ = [
    "AllocatedPolicy",
    "BangBangHeading",
    "ClosedLoop",
    "FeedForward",
    "HeadingPD",
    "HullFeedForward",
    "MotionPID",
    "MotionPIDConfig",
    "NoFeedForward",
    "Policy",
    "RecordedReference",
    "Reference",
    "ReferenceFilter",
    "ReferenceFilterConfig",
]
