"""Whether the user has vouched for parts that residnet cannot store as data (`--trust`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_trusted: ContextVar[bool] = ContextVar("residnet_trusted", default=False)


def is_trusted() -> bool:
    """Return whether parts outside of the allow-lists may be made and loaded here."""
    return _trusted.get()


@contextmanager
def trusting(trust: bool = True) -> Iterator[None]:
    """Allow parts outside of the allow-lists within the context.

    Args:
        trust: whether the user has vouched for them; False changes nothing.
    """
    token = _trusted.set(trust or _trusted.get())
    try:
        yield
    finally:
        _trusted.reset(token)


def set_trusted(trust: bool) -> None:
    """Set whether they are allowed in this process, as a worker takes over its parent's setting."""
    _trusted.set(trust)
