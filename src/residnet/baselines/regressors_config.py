"""Configuration of baselines that are linear in named regressors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field, model_validator

from residnet.baselines.config import IdentifiedConfig
from residnet.baselines.sets import (
    ChannelRoles,
    SetName,
    active_terms,
    drop_equivalent_terms,
    expand_sets,
)
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY_NAMES
from residnet.core.sample_origins import SampleOrigins
from residnet.physics.similarity import Particulars
from residnet.physics.symmetry import (
    active_channels,
    get_dof,
)
from residnet.physics.terms import parse_term

if TYPE_CHECKING:
    from residnet.baselines.base import Baseline
    from residnet.baselines.regressors import RegressorBaseline
    from residnet.core.samples import Samples
    from residnet.regression.estimator import Solution

AxisTermNames = dict[Literal["u", "v", "r", "w", "p", "q"], tuple[str, ...]]
Penalty = Annotated[float, Field(ge=0)]


class RegressorsConfig(IdentifiedConfig):
    """Least squares or ridge regression of the accelerations on named regressors.

    Attributes:
        sets: named sets of regressors for every axis, expanded for the channels of the model:
            `linear`; `fossen` (linear and quadratic damping, Coriolis products, propeller and
            rudder); `abkowitz` (third-order Taylor series about straight-ahead motion); `astern`
            (additional terms for astern revolutions); `wind`; `polynomial_1` and `polynomial_2`
            (all products of velocities and inputs, the ridge models of Moreno-Salinas et al. 2019,
            section 2.2).
        terms: additional regressors of every axis, or per axis `u`, `v`, `r` (with roll also `p`;
            in six degrees of freedom also `w`, `p`, `q`). Without sets and terms, the regressors
            are the constant and every channel.
        drive: channels used as thrust by the sets; if empty n, or tau_x if the model has forces.
        steer: channels used as steering by the sets; if empty delta, or tau_n if the model has
            forces.
        ridge: penalty relative to the energy of each regressor, 0 for ordinary least squares. Of
            several penalties, the one with the best free run on validation data is selected.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
        dissipative: whether terms with negative damping are removed and the others fitted again.
            These are terms proportional to the velocity of their axis, such as u|u| in surge or
            v|r| in sway, with a positive coefficient; and, if the damping of an axis is negative at
            most samples, the term that contributes most, such as u r in yaw. A refit does the same.
        bounded: whether velocities and inputs are clamped if they exceed the training range by more
            than half its width, with a restoring acceleration on such velocities, so that the model
            cannot diverge.
        particulars: main particulars and service speed of the hull. Its semi-empirical derivatives
            (Clarke, Gedling and Hine 1983) are the prior of the linear sway and yaw dynamics; null
            for no prior. The width of the prior is the one with the largest marginal likelihood, so
            that few logs stay near the regressions and many logs leave them.
    """

    kind: Literal["regressors"] = "regressors"
    sets: tuple[SetName, ...] = ()
    terms: tuple[str, ...] | AxisTermNames = ()
    drive: tuple[str, ...] = ()
    steer: tuple[str, ...] = ()
    ridge: Penalty | Annotated[tuple[Penalty, ...], Field(min_length=2)] = 0.0
    manoeuvres: tuple[str, ...] = ()
    dissipative: bool = False
    bounded: bool = False
    particulars: Particulars | None = None

    @model_validator(mode="after")
    def _validate_particulars(self) -> RegressorsConfig:
        if self.particulars is not None and None in (
            self.particulars.beam,
            self.particulars.draught,
            self.particulars.mass,
        ):
            raise ValueError(
                "particulars: semi-empirical derivatives need beam, draught and mass; add them, or"
                " remove particulars"
            )
        return self

    @model_validator(mode="after")
    def _validate_terms(self) -> RegressorsConfig:
        if isinstance(self.terms, dict) and not {*VELOCITY_NAMES} <= set(self.terms):
            raise ValueError(f"terms: expected all of the axes u, v, r, got {sorted(self.terms)}")
        if (self.drive or self.steer) and not self.sets:
            raise ValueError(
                "drive and steer are channels of the terms of `sets`; give sets, or remove them"
            )
        return self

    def axis_terms(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the regressors of each axis for channels `names`.

        Duplicate regressors are removed. Inactive velocities have no regressors and occur in none.
        """
        return active_terms(self._configured_terms(names), names)

    def _configured_terms(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the regressors of each axis as configured, including inactive ones."""
        axes = get_dof(names).layout.velocities
        if isinstance(self.terms, dict) and set(self.terms) != set(axes):
            raise ConfigError(
                f"terms: expected the axes {', '.join(axes)} of the model, got {sorted(self.terms)}"
            )
        terms_by_axis = (
            [
                tuple(axis_terms)
                for _, axis_terms in sorted(
                    self.terms.items(), key=lambda item: axes.index(item[0])
                )
            ]
            if isinstance(self.terms, dict)
            else [tuple(self.terms)] * len(axes)
        )
        if self.sets:
            set_terms = expand_sets(
                self.sets, ChannelRoles.from_channels(names, self.drive, self.steer)
            )
            return [
                drop_equivalent_terms((*set_terms, *axis_terms), names)
                for axis_terms in terms_by_axis
            ]
        return (
            [axis_terms or ("1", *active_channels(names)) for axis_terms in terms_by_axis]
            if self.terms == ()
            else terms_by_axis
        )

    def check_channels(self, names: Sequence[str]) -> None:
        for axis_terms in self.axis_terms(names):
            for term in axis_terms:
                parse_term(term, names)

    def is_parametric(self, names: Sequence[str]) -> bool:
        return True

    def has_regressors(self, names: Sequence[str]) -> bool:
        return True

    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        return False

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        from residnet.baselines.regressors import RegressorBaseline

        return RegressorBaseline(
            self.axis_terms(names), names, is_dissipative=self.dissipative, is_bounded=self.bounded
        )

    def validate_samples(self, samples: SampleOrigins) -> None:
        samples.require_manoeuvres(self.manoeuvres)

    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        from residnet.baselines.regressors import RegressorBaseline, fit_regressors

        assert isinstance(baseline, RegressorBaseline)
        return fit_regressors(self, baseline, samples)
