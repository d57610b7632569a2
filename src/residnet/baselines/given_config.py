"""Configuration of baselines with fixed coefficients."""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal, Self, final

from pydantic import Field, model_validator

from residnet.baselines.config import IdentifiedConfig, require_channels
from residnet.core.config import Config
from residnet.core.errors import ConfigError, UsageError
from residnet.core.names import CHANNEL_UNITS, FORCE_CHANNELS, VELOCITY_NAMES, to_si
from residnet.physics.hull import AccelerationHullConfig, HullConfig
from residnet.physics.terms import parse_axis_terms, parse_term
from residnet.physics.vessel import load_vessel

if TYPE_CHECKING:
    from residnet.baselines.base import Baseline
    from residnet.baselines.given import FixedBaseline
    from residnet.core.samples import Samples
    from residnet.regression.estimator import Solution

TermCoefficients = dict[str, float]


class FixedBaselineConfig(IdentifiedConfig, ABC):
    """Base of the configs of baselines whose coefficients are given and not fitted."""

    @final
    def is_parametric(self, names: Sequence[str]) -> bool:
        return False

    @final
    def has_regressors(self, names: Sequence[str]) -> bool:
        return False

    @final
    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return a solution without state, because there are no parameters to fit."""
        from residnet.regression.estimator import Solution

        return [Solution({}, {})]


class ZeroBaselineConfig(FixedBaselineConfig):
    """Baseline with zero accelerations (constant velocity).

    A head on this baseline is a black-box model, which learns the acceleration itself.
    """

    kind: Literal["still"] = "still"

    def check_channels(self, names: Sequence[str]) -> None:
        """Accept any channels."""

    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        return False

    def build(self, names: Sequence[str]) -> FixedBaseline:
        from residnet.baselines.given import FixedBaseline

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

    Examples are eqs. (6.24)-(6.32) and (7.2)-(7.7) of Halvorsen 2019.

    Attributes:
        units: units of channels in the equations if not SI (Halvorsen 2019 has revolutions in rpm).
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

    def coefficients_in_si(self, names: Sequence[str]) -> list[TermCoefficients]:
        """Return the coefficients of u_dot, v_dot and r_dot by term, SI.

        Raises:
            ConfigError: if a term is invalid or contains an unknown channel.
        """
        require_channels(names, (), "baseline 'equations'")
        return [
            {
                term: self._coefficient_in_si(axis, term, value, names)
                for term, value in axis_coefficients.items()
            }
            for axis, axis_coefficients in zip(
                VELOCITY_NAMES, self.axis_coefficients(), strict=True
            )
        ]

    def check_channels(self, names: Sequence[str]) -> None:
        self.coefficients_in_si(names)

    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        if any(name not in names for name in FORCE_CHANNELS):
            return False
        return super().has_inertia_matrix(names)

    def build(self, names: Sequence[str]) -> FixedBaseline:
        from residnet.baselines.given import FixedBaseline

        return FixedBaseline(self.coefficients_in_si(names), names, is_fitted=True)


class HullEquations(AxisCoefficients):
    """Equations of the accelerations of a hull, in SI units.

    The terms are products of u, v, r, tau_x, tau_y and tau_n.
    """

    @model_validator(mode="after")
    def _validate_terms(self) -> HullEquations:
        parse_axis_terms(dict(self), VELOCITY_NAMES + FORCE_CHANNELS)
        return self


class BelievedConfig(FixedBaselineConfig):
    """Hull of a vessel file with fixed parameters (Jervan 2020, section 4.1.1).

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
        if isinstance(self.vessel, HullEquations):
            return self
        try:
            self._load_hull(self.vessel).check_parameters()
        except ConfigError as error:
            raise ValueError(str(error)) from None
        return self

    @staticmethod
    def _load_hull(name: str) -> HullConfig | AccelerationHullConfig:
        """Read the hull of a vessel file.

        Raises:
            ConfigError: if the vessel does not exist.
            ValueError: if its hull has no equations of this form.
        """
        vessel = load_vessel(name)
        if not isinstance(vessel, HullConfig | AccelerationHullConfig):
            raise ValueError(
                f"vessel: '{name}' is of kind '{vessel.kind}'; a believed hull needs one"
                " of kind fossen, mass_matrix or odin"
            )
        return vessel

    def hull_equations(self) -> HullEquations:
        """Return the equations of the vessel without the scale factor.

        Raises:
            ValueError: if the vessel does not exist, or its hull has no equations of this form.
        """
        if isinstance(self.vessel, HullEquations):
            return self.vessel
        try:
            hull = self._load_hull(self.vessel).build_hull()
            terms, coefficients = hull.acceleration_equations()
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

    def check_channels(self, names: Sequence[str]) -> None:
        require_channels(names, (*VELOCITY_NAMES, *FORCE_CHANNELS), "baseline 'believed'")

    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        # the mass matrix of a vessel file was checked; other equations may have no inverse
        return isinstance(self.vessel, str) or super().has_inertia_matrix(names)

    def build(self, names: Sequence[str]) -> FixedBaseline:
        from residnet.baselines.given import FixedBaseline

        self.check_channels(names)
        # with M, C and D multiplied by one factor the free motion is unchanged: the factor cancels,
        # except that forces cause smaller accelerations
        force_scales = dict.fromkeys(FORCE_CHANNELS, self.scale)
        coefficients_by_axis = [
            {term: value / force_scales.get(term, 1.0) for term, value in axis_coefficients.items()}
            for axis_coefficients in self.hull_equations().axis_coefficients()
        ]
        return FixedBaseline(coefficients_by_axis, names)
