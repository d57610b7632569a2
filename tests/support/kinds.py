"""Values of a known kind: a test that names its own vessel, head or baseline knows what it gets."""

from __future__ import annotations

from typing import TypeVar

T = TypeVar("T")


def of_kind(value: object, kind: type[T]) -> T:
    """Return the value, which must be of this kind."""
    assert isinstance(value, kind), f"expected a {kind.__name__}, given a {type(value).__name__}"
    return value
