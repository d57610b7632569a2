"""Which series and fields of a recording are to be read: what a config names, or everything."""

from __future__ import annotations

from collections.abc import Iterable
from typing import final

from residnet.data.readers.recording import key_of, same_topic

CLOCK_ONLY = "(clock)"
"""Stands for a field where only the times of a topic are wanted."""


@final
class Wanted:
    """Topics and fields that are to be read.

    Args:
        named: pairs of topic (None: the only one there is) and field; None wants everything. An
            empty field wants all of its topic.
    """

    def __init__(self, named: Iterable[tuple[str | None, str]] | None = None) -> None:
        self._named = None if named is None else tuple(named)

    def __call__(self, topic: str) -> bool:
        """Return whether anything of a topic is wanted."""
        return self._named is None or any(self._same(name, topic) for name, _ in self._named)

    def field(self, topic: str, path: str) -> bool:
        """Return whether a field or a part of it is wanted (`orientation.w` of `orientation`)."""
        key = key_of(path)
        fields = [key_of(field) for name, field in self._named or () if self._same(name, topic)]
        return self._named is None or any(
            not field or key == field or key.startswith(field + "_") for field in fields
        )

    @staticmethod
    def _same(name: str | None, topic: str) -> bool:
        return name is None or same_topic(name, [topic]) is not None


EVERYTHING = Wanted()
