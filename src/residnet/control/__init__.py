"""Controllers and guidance that close the loop around any model."""

from __future__ import annotations

from residnet.control.base import ClosedLoop, GivenReference, Policy, Reference

__all__ = ["ClosedLoop", "GivenReference", "Policy", "Reference"]
