"""The interface of heading policies that can be exported: memory by name and range, and a card."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from residnet.control.base import Policy
from residnet.control.heading.turning import Turning


class HeadingKeeper(Policy, ABC):
    """A heading policy with K, T and speed of its vessel, a rudder, and a memory with ranges.

    Attributes:
        gain: K of its vessel in 1/s.
        time: T of its vessel in s.
        speed: at which K and T hold, in m/s.
        limit: of the rudder in rad.
        rate: of the rudder in rad/s; infinite where it stands at its command at once.
        dt: step in s.
    """

    def __init__(self, turning: Turning, limit: float, rate: float | None, dt: float) -> None:
        super().__init__()
        self.gain, self.time, self.speed = turning.gain, turning.time, turning.speed
        self.limit, self.dt = limit, dt
        self.rate = math.inf if rate is None else rate

    @abstractmethod
    def read_from(self, state: Sequence[str]) -> None:
        """Take heading, speed and yaw rate from a state with these names."""

    def at(self, dt: float) -> None:
        """Take steps of dt seconds from now on."""
        self.dt = dt

    @abstractmethod
    def memory_ranges(self, turn: float, angle: float) -> dict[str, tuple[float, float]]:
        """Return what the entries of the memory can be, [low, high] by name, with some room.

        Args:
            turn: fastest yaw rate in rad/s that is measured.
            angle: largest rudder angle in rad, relative to that of a course where one is followed.
        """

    @abstractmethod
    def described(self) -> dict[str, Any]:
        """Return what the card of an exported policy says of its structure."""
