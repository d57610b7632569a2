"""The interface of messages that map themselves to channels."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from residnet.data.readers.composing.compose import Plan
from residnet.data.readers.recording import Series


class Message(ABC):
    """A kind of message.

    Attributes:
        types: names of the message's type, without its package.
        signature: fields that tell it where the source has no types; none where it is known by its
            type only.
        conversion: how its frames become residnet's, for the log's meta.
    """

    types: ClassVar[tuple[str, ...]]
    signature: ClassVar[tuple[str, ...]] = ()
    conversion: ClassVar[str] = "REP-103 (ENU, forward-left-up) to NED, forward-starboard-down"

    def fits(self, series: Series) -> bool:
        """Return whether a series holds messages of this kind."""
        if series.kind:
            return series.kind.rsplit("/", 1)[-1] in self.types
        return bool(self.signature) and all(series.has(field) for field in self.signature)

    @abstractmethod
    def plan(self, series: Series) -> Plan:
        """Return the channels that a series of this kind gives."""
