"""Permission of the user to load code that is not on the allow-lists (`--trust`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_trusted: ContextVar[bool] = ContextVar("residnet_trusted", default=False)


def is_trusted() -> bool:
    """Return whether classes and functions outside of the allow-lists may be loaded."""
    return _trusted.get()


@contextmanager
def trusting(trust: bool = True) -> Iterator[None]:
    """Allow classes and functions outside of the allow-lists within the context.

    Args:
        trust: whether the user gave permission; False changes nothing.
    """
    token = _trusted.set(trust or _trusted.get())
    try:
        yield
    finally:
        _trusted.reset(token)


def set_trusted(trust: bool) -> None:
    """Set the permission of this process; a worker process copies it from its parent."""
    _trusted.set(trust)
