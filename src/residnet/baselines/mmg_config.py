"""Configuration of the MMG standard model of a ship."""

from __future__ import annotations

from abc import ABC
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal, Self, final

from pydantic import Field, model_validator

from residnet.baselines.config import IdentifiedConfig, require_channels
from residnet.baselines.mmg_parameters import (
    PARAMETER_NAMES,
    MMGHull,
    MMGPropeller,
    MMGRudder,
    ParameterPrior,
    brix_rudder_means,
    clarke_priors,
    default_priors,
    inoue_priors,
    kijima_rudder_means,
)
from residnet.core.names import VELOCITY_NAMES, suggest_name
from residnet.core.sample_origins import SampleOrigins

if TYPE_CHECKING:
    from residnet.baselines.base import Baseline
    from residnet.baselines.mmg import MMGBaseline, MMGForces, SemiEmpiricalBaseline
    from residnet.core.samples import Samples
    from residnet.regression.estimator import Solution


_REGRESSIONS = {"kijima": default_priors, "inoue": inoue_priors, "clarke": clarke_priors}
"""Functions from a hull to the priors, by name of the regressions."""
_RUDDER_MEANS = {"kijima": kijima_rudder_means, "brix": brix_rudder_means}
"""Functions from a hull to prior means of the rudder-hull interaction, by name."""


class MMGParticularsConfig(IdentifiedConfig, ABC):
    """Particulars of a ship with one propeller and one rudder, and the regressions on them.

    Attributes:
        hull: particulars of the hull.
        propeller: particulars of the propeller.
        rudder: particulars of the rudder.
        beliefs: prior mean and standard deviation by non-dimensional parameter, for parameters that
            differ from the defaults; a standard deviation of 0 fixes the parameter.
        revolutions: channel of the propeller revolutions, 1/s.
        angle: channel of the rudder angle, rad, positive to starboard.
        formulas: regressions of the prior means of added masses and linear hull derivatives from
            the main particulars: `kijima` (Kijima et al. 1990), `inoue` (Inoue, Hirano and Kijima
            1981) or `clarke` (Clarke, Gedling and Hine 1983).
        rudder_formulas: prior means of the interaction of rudder and hull: `usual` values of
            merchant ships, regressions of `kijima` (Kijima et al. 1990), or the flow straightening
            of `brix` (Brix 1993).
    """

    hull: MMGHull
    propeller: MMGPropeller
    rudder: MMGRudder
    beliefs: dict[str, tuple[float, Annotated[float, Field(ge=0)]]] = Field(default_factory=dict)
    revolutions: str = "n"
    angle: str = "delta"
    formulas: Literal["kijima", "inoue", "clarke"] = "kijima"
    rudder_formulas: Literal["usual", "kijima", "brix"] = "usual"

    @model_validator(mode="after")
    def _validate_beliefs(self) -> Self:
        for name in self.beliefs:
            if name not in PARAMETER_NAMES:
                raise ValueError(
                    f"beliefs: no parameter '{name}'{suggest_name(name, PARAMETER_NAMES)}"
                )
        return self

    def check_channels(self, names: Sequence[str]) -> None:
        require_channels(names, self.required_channels, f"the baseline '{self.kind}'")

    def has_regressors(self, names: Sequence[str]) -> bool:
        return False

    def has_inertia_matrix(self, names: Sequence[str]) -> bool:
        return False

    @property
    def required_channels(self) -> tuple[str, ...]:
        """Channels of velocities, propeller revolutions and rudder angle."""
        return (*VELOCITY_NAMES, self.revolutions, self.angle)

    def priors(self) -> list[ParameterPrior]:
        """Return the prior of every parameter, in the order of `PARAMETER_NAMES`."""
        priors = _REGRESSIONS[self.formulas](self.hull)
        if self.rudder_formulas != "usual":
            means = _RUDDER_MEANS[self.rudder_formulas](self.hull)
            priors |= {name: priors[name]._replace(mean=mean) for name, mean in means.items()}
        # priors of a config have no description
        configured_priors = {
            name: ParameterPrior(*mean_and_std, "") for name, mean_and_std in self.beliefs.items()
        }
        return list((priors | configured_priors).values())

    def build_forces(self, names: Sequence[str]) -> MMGForces:
        """Build the force model for channels `names`.

        Raises:
            ConfigError: if a channel is missing.
        """
        from residnet.baselines.mmg import MMGForces

        self.check_channels(names)
        columns = [list(names).index(name) for name in self.required_channels]
        return MMGForces(self.hull, self.propeller, self.rudder, columns)


@final
class MMGConfig(MMGParticularsConfig):
    """MMG standard model of a ship with one propeller and one rudder.

    The model follows Yasukawa and Yoshimura (2015). Every parameter has a prior with a mean and
    a standard deviation, which default to usual values. The fit is the maximum a posteriori
    estimate from the measured accelerations. A `refit` of this baseline on free runs continues from
    it and yields the standard errors of the prediction intervals.

    Attributes:
        correlation: number of successive acceleration samples with the information of one
            independent sample.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
        prior_weight: `fixed` takes the standard deviations of the priors unchanged; `evidence`
            multiplies them by the factor of at least 1 with the largest marginal likelihood, which
            reduces the weight of regressions that the logs contradict.
    """

    kind: Literal["mmg"] = "mmg"
    correlation: int = Field(default=100, ge=1, le=100_000)
    manoeuvres: tuple[str, ...] = ()
    prior_weight: Literal["fixed", "evidence"] = "fixed"

    def is_parametric(self, names: Sequence[str]) -> bool:
        return True

    def build(self, names: Sequence[str]) -> MMGBaseline:
        """Build the baseline for channels `names`, with every parameter at its prior mean."""
        from residnet.baselines.mmg import MMGBaseline

        return MMGBaseline(self.build_forces(names), self.priors())

    def validate_samples(self, samples: SampleOrigins) -> None:
        samples.require_manoeuvres(self.manoeuvres)

    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        from residnet.baselines.mmg import MMGBaseline, fit_mmg

        assert isinstance(baseline, MMGBaseline)
        return [fit_mmg(self, baseline, samples)]


@final
class SemiEmpiricalConfig(MMGParticularsConfig):
    """MMG model by regressions from main particulars alone, without a fit.

    The parameters are the prior means: usual values of a merchant ship, and added masses and linear
    hull derivatives by `formulas`. Their standard errors are the standard deviations of the priors.
    It is a reference for identified models, and a start without logs of manoeuvres.

    Attributes:
        kind: name of this baseline in a config.
    """

    kind: Literal["semi_empirical"] = "semi_empirical"

    def is_parametric(self, names: Sequence[str]) -> bool:
        return False

    def build(self, names: Sequence[str]) -> SemiEmpiricalBaseline:
        """Build the baseline with every parameter at its prior mean."""
        from residnet.baselines.mmg import SemiEmpiricalBaseline

        return SemiEmpiricalBaseline(
            self.build_forces(names), [prior.mean for prior in self.priors()]
        )

    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the regressions; the samples are not used."""
        from residnet.baselines.mmg import axis_of_parameter
        from residnet.regression.estimator import Coefficient, Solution

        table = tuple(
            Coefficient(axis_of_parameter(name), name, prior.mean, prior.sd)
            for name, prior in zip(PARAMETER_NAMES, self.priors(), strict=True)
        )
        return [Solution({}, {}, table)]
