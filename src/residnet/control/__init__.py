"""Controllers and guidance that close the loop around any model."""

from __future__ import annotations

from residnet.control.base import ClosedLoop, GivenReference, Policy, Reference
from residnet.control.heading.classical import BangBangHeading, HeadingPD
from residnet.control.motion import (
    Allocated,
    FeedForward,
    HullFeedForward,
    MotionPID,
    MotionPIDConfig,
    NoFeedForward,
    ReferenceFilter,
    ReferenceFilterConfig,
)

__all__ = [
    "Allocated",
    "BangBangHeading",
    "ClosedLoop",
    "FeedForward",
    "GivenReference",
    "HeadingPD",
    "HullFeedForward",
    "MotionPID",
    "MotionPIDConfig",
    "NoFeedForward",
    "Policy",
    "Reference",
    "ReferenceFilter",
    "ReferenceFilterConfig",
]
