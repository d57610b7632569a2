"""Typed contents of the file on the currents of logs."""

from __future__ import annotations

import math

from residnet.core.records import FileRows, Record


class CurrentRow(Record):
    """The estimated constant current of one log.

    Attributes:
        log: name of the log.
        fitted: whether the current was fitted together with the coefficients.
        current_north: velocity of the water to the north in m/s.
        current_east: velocity of the water to the east in m/s.
        standard_error: standard errors of both in m/s.
        p_value: probability of such an estimate without a current, by an F test; None if it was
            not tested.
    """

    log: str
    fitted: bool
    current_north: float
    current_east: float
    standard_error: tuple[float, float]
    p_value: float | None = None

    @property
    def speed(self) -> float:
        """The speed of the current in m/s."""
        return math.hypot(self.current_north, self.current_east)


class CurrentsFile(FileRows[CurrentRow]):
    """currents.json: the currents of all logs."""
