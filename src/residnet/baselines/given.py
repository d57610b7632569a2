"""Baselines with fixed coefficients: the hull of a vessel file, published equations, or none."""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from typing import Annotated, Literal, Self, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.baselines.base import Baseline, IdentifiedConfig, require_channels
from residnet.core.columns import zero_acceleration
from residnet.core.config import Config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import CHANNEL_UNITS, VELOCITY_NAMES, to_si
from residnet.core.samples import Samples
from residnet.physics.hull import AccelerationHullConfig, HullConfig
from residnet.physics.signals import FORCE_CHANNELS
from residnet.physics.symmetry import get_dof
from residnet.physics.terms import TermLibrary, parse_axis_terms, parse_term
from residnet.physics.vessel import load_vessel
from residnet.regression.estimator import Solution

TermCoefficients = dict[str, float]


@final
class FixedBaseline(Baseline):
    """Baseline nu_dot = theta [n, J] phi(z) [..., J] with fixed coefficients.

    Args:
        coefficients_by_axis: coefficients of u_dot, v_dot and r_dot by term; other states have no
            terms.
        names: channels of the model.
        is_fitted: whether the coefficients were fitted to other data (correction E9 of document
            000).
    """

    def __init__(
        self,
        coefficients_by_axis: Sequence[TermCoefficients],
        names: Sequence[str],
        *,
        is_fitted: bool = False,
    ) -> None:
        super().__init__()
        terms = list(
            dict.fromkeys(
                term for axis_coefficients in coefficients_by_axis for term in axis_coefficients
            )
        )
        self.library = TermLibrary(terms, names)
        self.n_dof = get_dof(names).n_dynamic
        self.is_fitted = is_fitted
        # roll has no published equation: its acceleration is zero
        empty_axes = [dict[str, float]()] * (self.n_dof - len(coefficients_by_axis))
        theta = [
            [axis_coefficients.get(term, 0.0) for term in terms]
            for axis_coefficients in (*coefficients_by_axis, *empty_axes)
        ]
        # a baseline without terms has nothing to store
        self.theta = nn.Buffer(
            torch.tensor(theta, dtype=torch.float64).reshape(self.n_dof, len(terms)),
            persistent=len(terms) > 0,
        )

    def forward(self, z: Tensor) -> Tensor:
        if self.library.n_terms == 0:
            return zero_acceleration(z, self.n_dof)
        phi: Tensor = self.library(z)
        return phi @ self.theta.to(z.dtype).T

    def parameter_counts(self) -> list[float]:
        """Return the number of terms per axis if they were fitted to data, otherwise zeros."""
        return [float(n_terms) * self.is_fitted for n_terms in (self.theta != 0).sum(1)]

    def inertia_matrix(self) -> Tensor | None:
        """Return the inertia matrix [3, 3], the inverse of the coefficients of the forces.

        None if they have no inverse, or the model includes roll.
        """
        terms = self.library.terms
        columns = [terms.index(name) for name in FORCE_CHANNELS if name in terms]
        if len(columns) < len(FORCE_CHANNELS) or self.n_dof > len(FORCE_CHANNELS):
            return None
        # nu_dot = M^-1 tau + ...: the coefficients of the forces are the inverse of M
        force_columns = self.theta[:, columns].to(torch.float64)
        # columns are scaled, because kg and kg m^2 cannot be compared
        is_invertible = float(torch.linalg.cond(force_columns / force_columns.abs().amax(0))) < 1e6
        return torch.linalg.inv(force_columns) if is_invertible else None


class FixedBaselineConfig(IdentifiedConfig, ABC):
    """Configuration of a baseline with fixed coefficients."""

    @final
    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return a solution without state, because there are no parameters to fit."""
        return [Solution({}, {})]


class ZeroBaselineConfig(FixedBaselineConfig):
    """Baseline with zero accelerations (constant velocity).

    A head on this baseline is a black-box model, which learns the acceleration itself.
    """

    kind: Literal["still"] = "still"

    def build(self, names: Sequence[str]) -> FixedBaseline:
        return FixedBaseline([], names)


class AxisCoefficients(Config):
    """Coefficients of accelerations that are sums of terms.

    Attributes:
        u: coefficients of u_dot by term; missing terms are zero.
        v: coefficients of v_dot by term.
        r: coefficients of r_dot by term.
    """

    u: TermCoefficients = Field(default_factory=dict)
    v: TermCoefficients = Field(default_factory=dict)
    r: TermCoefficients = Field(default_factory=dict)

    def axis_coefficients(self) -> tuple[TermCoefficients, TermCoefficients, TermCoefficients]:
        """Return the coefficients of u_dot, v_dot and r_dot."""
        return self.u, self.v, self.r


class EquationsConfig(AxisCoefficients, FixedBaselineConfig):
    """Published equations of the accelerations, whose coefficients are not fitted.

    Examples are eqs. (6.24)-(6.32) and (7.2)-(7.7) of document 000.

    Attributes:
        units: units of channels in the equations if not SI (document 000 has revolutions in rpm).
        source: reference of the equations.
    """

    kind: Literal["equations"] = "equations"
    units: dict[str, str] = Field(default_factory=dict)
    source: str = ""

    @model_validator(mode="after")
    def _validate_equations(self) -> EquationsConfig:
        if not any(self.axis_coefficients()):
            raise ValueError("no axis has a term; give coefficients by term under u, v or r")
        for name, unit in self.units.items():
            try:
                to_si(unit, CHANNEL_UNITS.get(name))
            except UsageError as error:
                raise ValueError(f"units.{name}: {error}") from None
        return self

    def _coefficient_in_si(self, axis: str, term: str, value: float, names: Sequence[str]) -> float:
        for factor in parse_term(term, names):
            if factor.name not in self.units:
                continue
            # a function of a channel in another unit is no multiple of that in SI
            if factor.function:
                raise ConfigError(
                    f"baseline 'equations', {axis}, term '{term}': {factor.symbol} needs"
                    f" {factor.name} in SI; leave its unit out"
                )
            # a coefficient per rpm^2 becomes one per (1/s)^2, and so on for every factor of the
            # term
            value /= to_si(self.units[factor.name]) ** factor.power
        return value

    def build(self, names: Sequence[str]) -> FixedBaseline:
        require_channels(names, (), "baseline 'equations'")
        coefficients_by_axis = [
            {
                term: self._coefficient_in_si(axis, term, value, names)
                for term, value in axis_coefficients.items()
            }
            for axis, axis_coefficients in zip(
                VELOCITY_NAMES, self.axis_coefficients(), strict=True
            )
        ]
        return FixedBaseline(coefficients_by_axis, names, is_fitted=True)


class HullEquations(AxisCoefficients):
    """Equations of the accelerations of a hull, in SI units.

    The terms are products of u, v, r, tau_x, tau_y and tau_n.
    """

    @model_validator(mode="after")
    def _validate_terms(self) -> HullEquations:
        parse_axis_terms(dict(self), VELOCITY_NAMES + FORCE_CHANNELS)
        return self


class BelievedConfig(FixedBaselineConfig):
    """Hull of a vessel file with fixed parameters (document 002 section 4.1.1).

    A scale factor on the mass, Coriolis and damping matrices introduces a known model error. The
    model needs the channels tau_x, tau_y and tau_n, as inputs or computed by `signals.forces`.

    Attributes:
        vessel: name or file of a vessel whose hull is given by matrices or accelerations (kinds
            fossen, mass_matrix, odin). A saved model has the equations of the hull instead, without
            the factor.
        scale: factor of the mass, Coriolis and damping matrices.
    """

    kind: Literal["believed"] = "believed"
    vessel: str | HullEquations
    scale: Annotated[float, Field(gt=0)] = 1.0

    @model_validator(mode="after")
    def _validate_vessel(self) -> BelievedConfig:
        self.hull_equations()
        return self

    def hull_equations(self) -> HullEquations:
        """Return the equations of the vessel without the scale factor.

        Raises:
            ValueError: if the vessel does not exist, or its hull has no equations of this form.
        """
        if isinstance(self.vessel, HullEquations):
            return self.vessel
        try:
            vessel = load_vessel(self.vessel)
            if not isinstance(vessel, HullConfig | AccelerationHullConfig):
                raise ValueError(
                    f"vessel: '{self.vessel}' is of kind '{vessel.kind}'; a believed hull needs one"
                    " of kind fossen, mass_matrix or odin"
                )
            terms, coefficients = vessel.build_hull().acceleration_equations()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        u, v, r = (
            {
                term: coefficient
                for term, coefficient in zip(
                    (*terms, *FORCE_CHANNELS), axis_coefficients, strict=True
                )
                if coefficient != 0.0
            }
            for axis_coefficients in coefficients
        )
        return HullEquations(u=u, v=v, r=r)

    def without_file_references(self) -> Self:
        """Return the config with the equations instead of the name of the vessel."""
        return self.model_copy(update={"vessel": self.hull_equations()})

    def build(self, names: Sequence[str]) -> FixedBaseline:
        require_channels(names, (*VELOCITY_NAMES, *FORCE_CHANNELS), "baseline 'believed'")
        # with M, C and D multiplied by one factor the free motion is unchanged: the factor cancels,
        # except that forces cause smaller accelerations
        force_scales = dict.fromkeys(FORCE_CHANNELS, self.scale)
        coefficients_by_axis = [
            {term: value / force_scales.get(term, 1.0) for term, value in axis_coefficients.items()}
            for axis_coefficients in self.hull_equations().axis_coefficients()
        ]
        return FixedBaseline(coefficients_by_axis, names)
