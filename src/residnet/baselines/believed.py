"""The known part as given: the hull of a vessel file (document 002 section 4.1.1).

A factor on its mass, Coriolis and damping matrices makes it wrong on purpose.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Literal, Self, final

import torch
from pydantic import Field, model_validator
from torch import Tensor

from residnet.baselines.base import Baseline, IdentifiedConfig, require
from residnet.core.config import Config
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY
from residnet.core.samples import Samples
from residnet.physics.hull import HullConfig, OdinConfig
from residnet.physics.signals import FORCE_CHANNELS
from residnet.physics.terms import TermLibrary, parse_term
from residnet.physics.vessel import load_vessel
from residnet.regression.solutions import Solution

Row = dict[str, float]


class HullEquations(Config):
    """The accelerations of a hull written out, in SI.

    The terms are products of u, v, r, tau_x, tau_y and tau_n.

    Attributes:
        u: coefficients of u_dot by term.
        v: coefficients of v_dot by term.
        r: coefficients of r_dot by term.
    """

    u: Row
    v: Row
    r: Row

    @model_validator(mode="after")
    def _terms(self) -> HullEquations:
        for axis, row in zip(VELOCITY, self.rows(), strict=True):
            for term in row:
                try:
                    factors = parse_term(term, VELOCITY + FORCE_CHANNELS)
                except ConfigError as error:
                    raise ValueError(f"{axis}: {error}") from None
                if any(factor.power < 0 for factor in factors):
                    raise ValueError(f"{axis}: term '{term}' divides by what may be zero")
        return self

    def rows(self) -> tuple[Row, Row, Row]:
        """Return the coefficients of u_dot, v_dot and r_dot."""
        return self.u, self.v, self.r


@final
class BelievedBaseline(Baseline):
    """A baseline nu_dot = theta [3, J] phi(z) [..., J] whose numbers stay as they were given."""

    def __init__(self, equations: HullEquations, names: Sequence[str]) -> None:
        super().__init__()
        rows = equations.rows()
        terms = list(dict.fromkeys(term for row in rows for term in row))
        self.library = TermLibrary(terms, names)
        self.register_buffer(
            "theta",
            torch.tensor(
                [[row.get(term, 0.0) for term in terms] for row in rows], dtype=torch.float64
            ),
        )
        self.theta: Tensor

    def forward(self, z: Tensor) -> Tensor:
        """Return nu_dot [..., 3] at channels z [..., nz]."""
        phi: Tensor = self.library(z)
        return phi @ self.theta.to(z.dtype).T

    def parameter_count(self) -> list[float]:
        """Return zeros: nothing was fitted."""
        return [0.0, 0.0, 0.0]

    def mass(self) -> Tensor | None:
        """Return the inertia [3, 3], the inverse of what forces do to accelerations.

        None where that has no inverse.
        """
        columns = [
            self.library.terms.index(name) for name in FORCE_CHANNELS if name in self.library.terms
        ]
        by_force = self.theta[:, columns].to(torch.float64)
        invertible = (
            len(columns) == len(FORCE_CHANNELS)
            and float(torch.linalg.cond(by_force / by_force.abs().amax(0))) < 1e6
        )
        return torch.linalg.inv(by_force) if invertible else None


class BelievedConfig(IdentifiedConfig):
    """The hull of a vessel file with its parameters as they are; nothing is identified.

    Needs the channels tau_x, tau_y and tau_n: as inputs, or made by `signals.forces`.

    Attributes:
        vessel: name or file of a vessel whose hull is given by matrices or accelerations (kinds
            fossen, mass_matrix, odin); a saved model has the hull's equations in its place, without
            the factor.
        scale: factor on the mass, Coriolis and damping matrices.
    """

    kind: Literal["believed"] = "believed"
    vessel: str | HullEquations
    scale: Annotated[float, Field(gt=0)] = 1.0

    @model_validator(mode="after")
    def _known(self) -> BelievedConfig:
        self.equations()
        return self

    def equations(self) -> HullEquations:
        """Return the equations of the vessel, without the factor.

        Raises:
            ValueError: where there is no such vessel, or its hull has no equations of this form.
        """
        if isinstance(self.vessel, HullEquations):
            return self.vessel
        try:
            vessel = load_vessel(self.vessel)
            if not isinstance(vessel, HullConfig | OdinConfig):
                raise ValueError(
                    f"vessel: '{self.vessel}' is of kind '{vessel.kind}'; a believed hull needs one"
                    " of kind fossen, mass_matrix or odin"
                )
            terms, coefficients = vessel.hull().equations()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        rows: list[Row] = []
        for row in coefficients:
            sums: Row = {}
            for term, value in zip((*terms, *FORCE_CHANNELS), row, strict=True):
                sums[term] = sums.get(term, 0.0) + value
            rows.append({term: value for term, value in sums.items() if value != 0.0})
        return HullEquations(u=rows[0], v=rows[1], r=rows[2])

    def resolved(self) -> Self:
        """Return the config with the equations in place of the vessel's name."""
        return self.model_copy(update={"vessel": self.equations()})

    def build(self, names: Sequence[str]) -> BelievedBaseline:
        """Return the module with its numbers, for channels `names`."""
        require(names, (*VELOCITY, *FORCE_CHANNELS), "baseline 'believed'")
        # M, C and D times one factor: only the forces act differently
        rows = [
            {
                term: value / self.scale if term in FORCE_CHANNELS else value
                for term, value in row.items()
            }
            for row in self.equations().rows()
        ]
        return BelievedBaseline(HullEquations(u=rows[0], v=rows[1], r=rows[2]), names)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return one solution without numbers: there is nothing to fit."""
        return [Solution({}, {})]
