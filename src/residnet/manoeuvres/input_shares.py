"""Shares of the inputs of a learned model in propulsion and steering commands."""

from __future__ import annotations

from pydantic import Field

from residnet.core.config import Config, Quantity, Seconds
from residnet.core.errors import ConfigError
from residnet.core.names import CHANNEL_UNITS

_RATE_UNITS = {"rad": "rad/s", "1/s": "1/s^2", "m": "m/s", "-": "1/s"}


class InputShare(Config):
    """The mapping from the commands of a manoeuvre to one input of a learned model.

    The commands are the normalised propulsion command and steering command.

    Values are numbers in the SI unit of the input, or texts with a unit.

    Attributes:
        drive: value at the full propulsion command.
        steer: value at the full steering command to starboard.
        centre: value without demand.
        limit: largest deviation from `centre` to both sides; None for the sum of propulsion command
            and steering command.
        rate: largest change per second; None for no rate limit.
        lag: time constant of the first-order response to a command; 0 for an immediate response.
        delay: time between a command and its first effect.
    """

    drive: float | str = 0.0
    steer: float | str = 0.0
    centre: float | str = 0.0
    limit: float | str | None = None
    rate: float | str | None = None
    lag: Seconds = Field(default=0.0, ge=0)
    delay: Seconds = Field(default=0.0, ge=0)

    @property
    def has_dynamics(self) -> bool:
        """Whether the input differs from its command: by a rate limit, a lag or a delay."""
        return self.rate is not None or self.lag > 0.0 or self.delay > 0.0

    def to_si(self, name: str) -> list[float]:
        """Return drive, steer, centre, limit and rate of the input `name` in SI.

        Raises:
            ConfigError: if a value has a wrong unit, or the input does not depend on the
                propulsion and steering commands.
        """
        unit = CHANNEL_UNITS.get(name, "-")
        value = Quantity(unit)
        rate = Quantity(_RATE_UNITS[unit]) if unit in _RATE_UNITS else None
        max_rate = float("inf")
        try:
            drive, steer, centre = map(value.convert, (self.drive, self.steer, self.centre))
            limit = abs(drive) + abs(steer) if self.limit is None else value.convert(self.limit)
            if self.rate is not None:
                max_rate = float(self.rate) if rate is None else rate.convert(self.rate)
        except ValueError as error:
            raise ConfigError(f"inputs.{name}: {error}") from None
        if limit <= 0 or max_rate <= 0:
            raise ConfigError(
                f"inputs.{name}: limit and rate must be above zero, and drive or steer must not be"
                f" zero; got a limit of {limit:g} and a rate of {max_rate:g}"
            )
        return [drive, steer, centre, limit, max_rate]
