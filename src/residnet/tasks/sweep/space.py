"""What a sweep varies: the values of a key, by a list or by a range."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from pydantic import Field, JsonValue, model_validator

from residnet.core.config import Config


class Values(Config):
    """Values that a key of the base takes: `choices`, or a range from `low` to `high`.

    Attributes:
        choices: any values of the key, lists and mappings included; null for a range.
        low: least value of a range, in the key's SI unit; with `high` a whole number, the values
            are whole numbers.
        high: greatest value of a range.
        log: the range is covered evenly in its logarithm.
        points: of the range on a grid, ends included; null for all whole numbers.
    """

    choices: tuple[JsonValue, ...] | None = Field(default=None, min_length=1)
    low: int | float | None = None
    high: int | float | None = None
    log: bool = False
    points: int | None = Field(default=None, ge=2, le=10_000)

    @model_validator(mode="after")
    def _one_kind(self) -> Values:
        if self.choices is not None:
            if self.low is not None or self.high is not None or self.points or self.log:
                raise ValueError("give choices, or low and high, not both")
            texts = [json.dumps(choice) for choice in self.choices]
            if len(set(texts)) < len(texts):
                raise ValueError("choices: each only once")
        elif self.low is None or self.high is None:
            raise ValueError("give choices, or low and high")
        elif not self.low < self.high:
            raise ValueError(f"low ({self.low:g}) must be less than high ({self.high:g})")
        elif self.log and self.low <= 0:
            raise ValueError(f"low ({self.low:g}) must be above zero where log is true")
        return self

    @property
    def whole(self) -> bool:
        """Whether a range holds whole numbers only."""
        return isinstance(self.low, int) and isinstance(self.high, int)

    def distribution(self) -> Any:
        """Return the Optuna distribution; a choice is its JSON text there."""
        from optuna.distributions import (
            CategoricalDistribution,
            FloatDistribution,
            IntDistribution,
        )

        if self.choices is not None:
            return CategoricalDistribution([json.dumps(choice) for choice in self.choices])
        assert self.low is not None
        assert self.high is not None
        if self.whole:
            return IntDistribution(int(self.low), int(self.high), log=self.log)
        return FloatDistribution(float(self.low), float(self.high), log=self.log)

    def grid(self) -> list[Any]:
        """Return all values of a grid, as the distribution knows them.

        Raises:
            ValueError: for a range without a number of points.
        """
        if self.choices is not None:
            return [json.dumps(choice) for choice in self.choices]
        assert self.low is not None
        assert self.high is not None
        if self.points is None:
            if not self.whole:
                raise ValueError("a grid needs the number of points of a range")
            return list(range(int(self.low), int(self.high) + 1))
        spaced = np.geomspace if self.log else np.linspace
        found = spaced(self.low, self.high, self.points)
        # the ends themselves, or rounding may leave the range
        found[0], found[-1] = self.low, self.high
        if self.whole:
            return sorted({round(float(value)) for value in found})
        return [float(value) for value in found]

    def extremes(self) -> list[Any]:
        """Return values that a check tries: all choices, or the ends of a range."""
        return self.grid() if self.choices is not None else [self.low, self.high]


def override(key: str, value: Any) -> str:
    """Return the override that sets a key to a value of its distribution."""
    return f"{key}={value if isinstance(value, str) else json.dumps(value)}"
