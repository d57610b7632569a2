"""The table of half widths that an exported model carries."""

from __future__ import annotations

from pydantic import Field, model_validator

from residnet.core.config import Config


class BandTable(Config):
    """Half widths of a model's free runs against the horizon, whatever the run is like.

    Attributes:
        level: share of the samples that they are to hold.
        steps: horizons, numbers of steps from 1 on, ascending.
        u: half widths in m/s.
        v: half widths in m/s.
        r: half widths in rad/s.
        heading: half widths in rad.
        position: radius about the predicted position in m.
        logs: number of logs that calibrated them.
        cautions: whole sentences about what they do not promise.
    """

    level: float = Field(gt=0, lt=1)
    steps: tuple[int, ...] = Field(min_length=1)
    u: tuple[float, ...]
    v: tuple[float, ...]
    r: tuple[float, ...]
    heading: tuple[float, ...]
    position: tuple[float, ...]
    logs: int = Field(ge=1)
    cautions: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _one_length(self) -> BandTable:
        if any(len(column) != len(self.steps) for column in self.columns):
            raise ValueError("u, v, r, heading and position need one half width for each of steps")
        return self

    @property
    def columns(self) -> tuple[tuple[float, ...], ...]:
        """The half widths of u, v, r, heading and position."""
        return self.u, self.v, self.r, self.heading, self.position
