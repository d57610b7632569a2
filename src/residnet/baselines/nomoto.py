"""Nomoto's steering models (document 003 eqs. (12)-(15), document 004 section 5.1.2).

They are identified by least squares on derivatives.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import ClassVar, Literal

import torch

from residnet.baselines.base import Baseline, IdentifiedConfig, of_manoeuvres, require
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.errors import FitError
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.core.samples import Samples
from residnet.regression.least_squares import LeastSquares, linear_solution
from residnet.regression.solutions import Coefficient, Ratio, Solution


class _SteeringConfig(IdentifiedConfig):
    """The part that both Nomoto models share.

    T_u u_dot + u = K_u drive + b_u (eq. (12)) and T r_dot + r = K steer + b (eq. (13)).

    Attributes:
        drive: channel that drives surge.
        steer: channel that turns the vessel.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
    """

    sway: ClassVar[tuple[str, ...]]
    held: ClassVar[tuple[tuple[int, str], ...]] = ()

    drive: str = "n"
    steer: str = "delta"
    manoeuvres: tuple[str, ...] = ()

    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the terms of each axis; the first is the rate that settles."""
        return ("u", self.drive, "1"), self.sway, ("r", self.steer, "1")

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        """Return the module, coefficients zero, for channels `names`."""
        require(names, ("u", "v", "r", self.drive, self.steer), "a Nomoto baseline")
        return RegressorBaseline(self.rows(), names, self.held)

    def require_samples(self, samples: Samples) -> None:
        """Check that there are manoeuvres to fit on.

        Raises:
            FitError: where there are none of the kinds that are asked for.
        """
        of_manoeuvres(samples, self.manoeuvres)

    def lag(self, baseline: RegressorBaseline, samples: Samples, axis: int) -> Solution:
        """Fit one axis as a first-order lag by least squares.

        Raises:
            FitError: where the data do not determine it, or it does not settle.
        """
        chosen, terms = of_manoeuvres(samples, self.manoeuvres), self.rows()[axis]
        columns = baseline.library(chosen.z)[
            :, [baseline.library.terms.index(term) for term in terms]
        ]
        (fit,) = LeastSquares().fit(
            columns,
            chosen.target[:, [axis]],
            chosen.group,
            names=terms,
            outputs=(ACCELERATION[axis],),
        )
        slope, error, name = float(fit.coefficients[0, 0]), float(fit.errors[0, 0]), VELOCITY[axis]
        if slope >= 0:
            raise FitError(
                f"a Nomoto model needs {name} to settle, but {name}_dot rises with {name}"
                f" ({slope:.2g} +- {error:.1g} 1/s): the vessel is unstable on course or hardly"
                " excited; take a baseline of kind 'regressors' or fit on other `manoeuvres`"
            )
        return fit


def _parameters(
    axis: int, terms: Sequence[str], fit: Solution, ratios: Mapping[str, Ratio]
) -> list[Coefficient]:
    """Return parameters that are ratios of the coefficients of an axis, errors to first order."""
    theta = fit.coefficients[:, 0]
    assert fit.covariance is not None
    covariance = fit.covariance[0]
    out = []
    for name, ratio in ratios.items():
        below = terms.index(ratio.denominator)
        gradient = torch.zeros_like(theta)
        value = ratio.of(dict(zip(terms, theta.tolist(), strict=True)))
        gradient[below] = -value / theta[below]
        if ratio.numerator is not None:
            gradient[terms.index(ratio.numerator)] += ratio.sign / theta[below]
        out.append(
            Coefficient(
                ACCELERATION[axis],
                name,
                value,
                float((gradient @ covariance @ gradient).clamp(min=0).sqrt()),
                ratio,
            )
        )
    return out


class NomotoConfig(_SteeringConfig):
    """Nomoto's model of first order, T r_dot + r = K steer + b.

    Surge is a first-order lag of the drive; sway, of which the model knows nothing, dies out with
    T.
    """

    sway = ("v",)
    held = ((1, "v"),)

    kind: Literal["nomoto"] = "nomoto"

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the one solution.

        Its table holds the coefficients, then T, K and b of each lag.

        Raises:
            FitError: where the data do not determine a coefficient, or a lag does not settle.
        """
        assert isinstance(baseline, RegressorBaseline)
        surge, yaw = self.lag(baseline, samples, 0), self.lag(baseline, samples, 2)
        assert yaw.covariance is not None
        slope, covariance = yaw.coefficients[:1], yaw.covariance[:, :1, :1]
        decay = linear_solution({}, slope, covariance, self.sway, (ACCELERATION[1],), {})
        rows = self.rows()
        found = baseline.solution((surge, decay, yaw), {})
        more = _parameters(0, rows[0], surge, _lag_of("u", self.drive, "_u")) + _parameters(
            2, rows[2], yaw, _lag_of("r", self.steer, "")
        )
        return [Solution({}, found.state, (*found.table, *more))]


class NomotoSideslipConfig(_SteeringConfig):
    """Nomoto's model with side slip (document 003 eqs. (14), (15)).

    T_beta beta_dot + beta = -K_beta r + b_beta, written for v = u beta.
    """

    sway = ("v", "u r", "u")

    kind: Literal["nomoto_sideslip"] = "nomoto_sideslip"

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the one solution.

        Its table holds the coefficients, then T, K and b of each lag.

        Raises:
            FitError: where the data do not determine a coefficient, or a lag does not settle.
        """
        assert isinstance(baseline, RegressorBaseline)
        fits = [self.lag(baseline, samples, axis) for axis in range(3)]
        rows = self.rows()
        found = baseline.solution(fits, {})
        slip = {
            "T_beta": Ratio(-1.0, None, "v"),
            "K_beta": Ratio(1.0, "u r", "v"),
            "b_beta": Ratio(-1.0, "u", "v"),
        }
        ratios = (_lag_of("u", self.drive, "_u"), slip, _lag_of("r", self.steer, ""))
        more = [
            c for axis in range(3) for c in _parameters(axis, rows[axis], fits[axis], ratios[axis])
        ]
        return [Solution({}, found.state, (*found.table, *more))]


def _lag_of(state: str, drive: str, suffix: str) -> dict[str, Ratio]:
    """Return T, K and b of T x_dot + x = K drive + b, from x_dot = a x + k drive + c."""
    return {
        f"T{suffix}": Ratio(-1.0, None, state),
        f"K{suffix}": Ratio(-1.0, drive, state),
        f"b{suffix}": Ratio(-1.0, "1", state),
    }
