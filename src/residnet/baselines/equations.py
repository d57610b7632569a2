"""Published equations, scored beside what is identified here.

They are accelerations as terms with given coefficients.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.baselines.base import Baseline, IdentifiedConfig
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import CHANNEL_UNITS, VELOCITY, to_si
from residnet.core.samples import Samples
from residnet.physics.terms import TermLibrary, parse_term
from residnet.regression.solutions import Solution

Row = dict[str, float]


@final
class EquationsBaseline(Baseline):
    """A baseline nu_dot = theta [3, J] phi(z) [..., J] with published coefficients theta."""

    def __init__(self, rows: Sequence[Row], names: Sequence[str]) -> None:
        super().__init__()
        terms = list(dict.fromkeys(term for row in rows for term in row))
        self.library = TermLibrary(terms, names)
        theta = [[row.get(term, 0.0) for term in terms] for row in rows]
        self.register_buffer(
            "theta", torch.tensor(theta, dtype=torch.float64).reshape(3, len(terms))
        )
        self.theta: Tensor

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz]."""
        phi: Tensor = self.library(z)
        return phi @ self.theta.to(z.dtype).T

    def parameter_count(self) -> list[float]:
        """Return the number of terms of each axis.

        They were fitted, if to other data (correction E9 of document 000).
        """
        return [float(count) for count in (self.theta != 0).sum(1)]


class EquationsConfig(IdentifiedConfig):
    """Published equations of the accelerations; nothing is identified.

    Examples are eqs. (6.24)-(6.32) and (7.2)-(7.7) of document 000.

    Attributes:
        u: coefficients of u_dot by term; a term that is left out is zero.
        v: coefficients of v_dot by term.
        r: coefficients of r_dot by term.
        units: units in which the coefficients take channels, where not SI (document 000 has
            revolutions in rpm).
        source: where the equations stand.
    """

    kind: Literal["equations"] = "equations"
    u: Row = Field(default_factory=dict)
    v: Row = Field(default_factory=dict)
    r: Row = Field(default_factory=dict)
    units: dict[str, str] = Field(default_factory=dict)
    source: str = ""

    @model_validator(mode="after")
    def _any(self) -> EquationsConfig:
        if not (self.u or self.v or self.r):
            raise ValueError("no axis has a term; give coefficients by term under u, v or r")
        for name, unit in self.units.items():
            try:
                to_si(unit, CHANNEL_UNITS.get(name))
            except UsageError as error:
                raise ValueError(f"units.{name}: {error}") from None
        return self

    def rows(self, names: Sequence[str]) -> list[Row]:
        """Return the coefficients of each axis in SI, for channels `names`.

        Raises:
            ConfigError: where a term names a channel that the model lacks, or a function of one
                that is not in SI.
        """
        out: list[Row] = []
        for axis, row in zip(VELOCITY, (self.u, self.v, self.r), strict=True):
            converted: Row = {}
            for term, value in row.items():
                for factor in parse_term(term, names):
                    if factor.name not in self.units:
                        continue
                    if factor.function:
                        raise ConfigError(
                            f"baseline 'equations', {axis}, term '{term}': {factor.symbol} needs"
                            f" {factor.name} in SI; leave its unit out"
                        )
                    value /= to_si(self.units[factor.name]) ** factor.power
                converted[term] = value
            out.append(converted)
        return out

    def build(self, names: Sequence[str]) -> EquationsBaseline:
        """Return the module with its numbers, for channels `names`."""
        return EquationsBaseline(self.rows(names), names)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return one solution without numbers: there is nothing to fit."""
        return [Solution({}, {})]
