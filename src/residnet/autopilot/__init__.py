"""Controllers and guidance that close the loop around any model, and the tasks that compare them.

This package is a wing: the core does not import it. Its tasks, manoeuvres and commands are declared
in entry_points.toml.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from residnet.autopilot.base import ClosedLoop, Policy, RecordedReference, Reference
    from residnet.autopilot.heading.classical import BangBangHeading, HeadingPD
    from residnet.autopilot.motion import (
        AllocatedPolicy,
        FeedForward,
        HullFeedForward,
        MotionPID,
        NoFeedForward,
        ReferenceFilter,
    )
    from residnet.autopilot.motion_config import MotionPIDConfig, ReferenceFilterConfig

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

_MODULE_OF_NAME = {
    **dict.fromkeys(("ClosedLoop", "Policy", "RecordedReference", "Reference"), "base"),
    **dict.fromkeys(("BangBangHeading", "HeadingPD"), "heading.classical"),
    **dict.fromkeys(("AllocatedPolicy", "MotionPID", "ReferenceFilter"), "motion"),
    **dict.fromkeys(("FeedForward", "HullFeedForward", "NoFeedForward"), "motion"),
    **dict.fromkeys(("MotionPIDConfig", "ReferenceFilterConfig"), "motion_config"),
}


def __getattr__(name: str) -> Any:
    """Import a class when it is first used: the command line must not wait for PyTorch."""
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF_NAME[name]}"), name)
