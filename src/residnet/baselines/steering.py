"""Speed and steering by lags: Nomoto's models, and the linear model of document 003.

Nomoto's (document 003 eqs. (12)-(15), document 004 section 5.1.2) are found by least squares on
derivatives, the linear one (document 003, sections 2.2, 4.2.1, 4.2.2) through steady states.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal, NamedTuple, final

import torch
from torch import Tensor

from residnet.baselines.base import Baseline, IdentifiedConfig, of_manoeuvres, require
from residnet.baselines.regressors import RegressorBaseline, living_rows
from residnet.core.config import Seconds
from residnet.core.errors import FitError
from residnet.core.names import ACCELERATION, VELOCITY
from residnet.core.samples import Samples
from residnet.physics.symmetry import live_of
from residnet.regression.estimator import Coefficient, Ratio, Solution
from residnet.regression.least_squares import LeastSquares


class SteeredConfig(IdentifiedConfig, ABC):
    """The part that all models of speed and steering share.

    Attributes:
        drive: channel that drives surge.
        steer: channel that turns the vessel.
    """

    needs: ClassVar[tuple[str, ...]] = VELOCITY
    """Velocities that must live."""

    kind: str
    drive: str
    steer: str

    @abstractmethod
    def rows(self) -> tuple[tuple[str, ...], ...]:
        """Return the terms of each axis; sway of `("v",)` alone dies out as the yaw rate does."""

    @final
    def build(self, names: Sequence[str]) -> RegressorBaseline:
        live = live_of(names).velocities
        acting = [self.drive] if live == ("u",) else [self.steer] if "u" not in live else []
        acting = acting or [self.drive, self.steer]
        require(names, (*self.needs, *acting), f"baseline '{self.kind}'")
        rows = living_rows(self.rows(), names)
        return RegressorBaseline(rows, names, ((1, "v"),) if rows[1] == ("v",) else ())


def _decay(yaw: Sequence[Coefficient]) -> tuple[Coefficient, ...]:
    """Return the table of a sway velocity that decays with yaw's time constant."""
    own = next(entry for entry in yaw if entry.term == "r")
    return (Coefficient("v_dot", "v", own.value, own.error),)


class _NomotoConfig(SteeredConfig, ABC):
    """The part that both Nomoto models share.

    T_u u_dot + u = K_u drive + b_u (eq. (12)) and T r_dot + r = K steer + b (eq. (13)).

    Attributes:
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
    """

    sway: ClassVar[tuple[str, ...]] = ("v",)

    drive: str = "n"
    steer: str = "delta"
    manoeuvres: tuple[str, ...] = ()

    @final
    def rows(self) -> tuple[tuple[str, ...], ...]:
        return ("u", self.drive, "1"), self.sway, ("r", self.steer, "1")

    @final
    def require_samples(self, samples: Samples) -> None:
        of_manoeuvres(samples, self.manoeuvres)

    @final
    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the one solution.

        Its table holds the coefficients, then T, K and b of each lag.

        Raises:
            FitError: where the data do not determine a coefficient, or a lag does not settle.
        """
        assert isinstance(baseline, RegressorBaseline)
        ratios = (
            _lag_of("u", self.drive, "_u"),
            {
                "T_beta": Ratio(-1.0, None, "v"),
                "K_beta": Ratio(1.0, "u r", "v"),
                "b_beta": Ratio(-1.0, "u", "v"),
            },
            _lag_of("r", self.steer, ""),
        )
        chosen, fits, further = of_manoeuvres(samples, self.manoeuvres), {}, []
        for axis, terms in enumerate(living_rows(self.rows(), chosen.names)):
            if len(terms) > 1:
                fits[axis] = self._lag(baseline, chosen, axis, terms)
                further += _parameters(axis, terms, fits[axis], ratios[axis])
        if 1 not in fits and "v" in live_of(chosen.names).velocities:
            fits[1] = Solution({}, {}, _decay(fits[2].table))
        found = baseline.solution(fits, {})
        return [replace(found, table=(*found.table, *further))]

    def _lag(
        self, baseline: RegressorBaseline, samples: Samples, axis: int, terms: Sequence[str]
    ) -> Solution:
        """Fit one axis as a first-order lag by least squares.

        Raises:
            FitError: where the data do not determine it, or it does not settle.
        """
        columns = [baseline.library.terms.index(term) for term in terms]
        (fit,) = LeastSquares().fit(
            baseline.library(samples.z)[:, columns],
            samples.target[:, [axis]],
            samples.group,
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


def _lag_of(state: str, drive: str, suffix: str) -> dict[str, Ratio]:
    """Return T, K and b of T x_dot + x = K drive + b, from x_dot = a x + k drive + c."""
    above = {"T": None, "K": drive, "b": "1"}
    return {f"{name}{suffix}": Ratio(-1.0, term, state) for name, term in above.items()}


def _parameters(
    axis: int, terms: Sequence[str], fit: Solution, ratios: Mapping[str, Ratio]
) -> list[Coefficient]:
    """Return parameters that are ratios of the coefficients of an axis, errors to first order."""
    theta = fit.coefficients[:, 0]
    assert fit.covariance is not None
    out = []
    for name, ratio in ratios.items():
        below = terms.index(ratio.denominator)
        gradient = torch.zeros_like(theta)
        value = ratio.of(dict(zip(terms, theta.tolist(), strict=True)))
        gradient[below] = -value / theta[below]
        if ratio.numerator is not None:
            gradient[terms.index(ratio.numerator)] += ratio.sign / theta[below]
        error = (gradient @ fit.covariance[0] @ gradient).clamp(min=0).sqrt()
        out.append(Coefficient(ACCELERATION[axis], name, value, float(error), ratio))
    return out


class NomotoConfig(_NomotoConfig):
    """Nomoto's model of first order, T r_dot + r = K steer + b.

    Surge is a first-order lag of the drive; sway, of which the model knows nothing, dies out with
    T. Where only surge or only yaw lives, only its lag is found.
    """

    needs = ()

    kind: Literal["nomoto"] = "nomoto"


class NomotoSideslipConfig(_NomotoConfig):
    """Nomoto's model with side slip (document 003 eqs. (14), (15)).

    T_beta beta_dot + beta = -K_beta r + b_beta, written for v = u beta.
    """

    sway = ("v", "u r", "u")

    kind: Literal["nomoto_sideslip"] = "nomoto_sideslip"


class _Block(NamedTuple):
    """States that one input drives, and the manoeuvres that identify how they settle."""

    states: tuple[str, ...]
    drive: str
    kinds: tuple[str, ...]


class LinearSteadyConfig(SteeredConfig):
    """The models u_dot = a u + k tau + c and (v, r)_dot = A (v, r) + B tau + C (eqs. (12), (16)).

    First the steady states of constant-input manoeuvres give x_ss = Phi tau + Phi_bias by least
    squares (eqs. (24), (32)); then x_dot = A (x - Phi tau - Phi_bias) gives A by least squares on
    derivatives (eq. (29)), and B = -A Phi (eq. (28)). Nomoto's models are identified alike.

    Attributes:
        steering_model: `linear` is (16). `nomoto` is (13), in which sway velocity decays with
            yaw's time constant. `nomoto_sideslip` is (15) with side slip written as sway velocity:
            the yaw rate alone drives sway.
        steady: kinds of manoeuvre with constant input.
        settled: time after the start of a constant manoeuvre from which its samples count as
            steady, s.
        speed: kinds of manoeuvre that identify a.
        steering: kinds of manoeuvre that identify A.
    """

    kind: Literal["linear_steady"] = "linear_steady"
    drive: str = "tau_x"
    steer: str = "tau_n"
    steering_model: Literal["linear", "nomoto", "nomoto_sideslip"] = "linear"
    steady: tuple[str, ...] = ("constant",)
    settled: Seconds = 40.0
    speed: tuple[str, ...] = ("acceleration_deceleration",)
    steering: tuple[str, ...] = ("zigzag", "three_two_one_one")

    def rows(self) -> tuple[tuple[str, ...], ...]:
        rows: dict[str, tuple[str, ...]] = {"v": ("v",)}
        for block in self._blocks():
            rows |= dict.fromkeys(block.states, (*block.states, block.drive, "1"))
        return tuple(rows[axis] for axis in VELOCITY)

    def _blocks(self) -> list[_Block]:
        yaw = _Block(("r",), self.steer, self.steering)
        steering = {
            "linear": [_Block(("v", "r"), self.steer, self.steering)],
            "nomoto": [yaw],
            "nomoto_sideslip": [_Block(("v",), "r", self.steering), yaw],
        }
        return [_Block(("u",), self.drive, self.speed), *steering[self.steering_model]]

    def require_samples(self, samples: Samples) -> None:
        """Check that there are constant manoeuvres, and those that identify speed and steering.

        Raises:
            FitError: where there are not.
        """
        self._means(samples, ())
        for kinds in (self.speed, self.steering):
            of_manoeuvres(samples, kinds)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        """Return the one solution; its notes hold the steady states and Phi (Table 1).

        Raises:
            FitError: where a kind of manoeuvre that a step needs is absent.
        """
        assert isinstance(baseline, RegressorBaseline)
        tables: dict[str, tuple[Coefficient, ...]] = {}
        phi: dict[str, dict[str, Any]] = {}
        for block in self._blocks():
            means = self._means(samples, (*block.states, block.drive))
            slope = torch.stack((means[:, -1], torch.ones_like(means[:, -1])), dim=1)
            (steady,) = LeastSquares().fit(
                slope,
                means[:, :-1],
                torch.arange(len(means)),
                names=(block.drive, "1"),
                outputs=block.states,
            )
            tables |= self._tables(samples, block, steady)
            for i, state in enumerate(block.states):
                (value, bias), (error, bias_error) = (
                    numbers[:, i].tolist() for numbers in (steady.coefficients, steady.errors)
                )
                phi[state] = {"of": block.drive, "phi": value, "phi_error": error}
                phi[state] |= {"bias": bias, "bias_error": bias_error}
        tables.setdefault("v", _decay(tables["r"]))
        names = (*VELOCITY, self.drive, self.steer)
        states = dict(zip(names, self._means(samples, names).T.tolist(), strict=True))
        fits = {i: Solution({}, {}, tables[axis]) for i, axis in enumerate(VELOCITY)}
        found = baseline.solution(fits, {})
        return [replace(found, notes={"steady_states": states, "steady_constraints": phi})]

    def _means(self, samples: Samples, names: Sequence[str]) -> Tensor:
        """Return the means [n, len(names)] of the settled part of every constant manoeuvre."""
        settled = samples.of_kinds(self.steady)
        settled = settled.where(settled.t >= self.settled)
        present, index = torch.unique(settled.group, return_inverse=True)
        if len(present) < 3:
            raise FitError(
                "baseline 'linear_steady' needs at least 3 constant-input manoeuvres of kinds"
                f" {list(self.steady)} longer than {self.settled:g} s, the data have"
                f" {len(present)}; kinds in the data: {sorted(set(samples.kinds))}"
            )
        columns = settled.z[:, [samples.names.index(name) for name in names]]
        sums = columns.new_zeros(len(present), len(names)).index_add_(0, index, columns)
        return sums / torch.bincount(index)[:, None]

    def _tables(
        self, samples: Samples, block: _Block, steady: Solution
    ) -> dict[str, tuple[Coefficient, ...]]:
        """Return the coefficients of each state of a block.

        First stands A, then B = -A Phi and -A Phi_bias, errors to first order as if those of A and
        Phi were independent.
        """
        dynamic, states = of_manoeuvres(samples, block.kinds), block.states
        phi, phi_error = steady.coefficients, steady.errors
        x = torch.stack([dynamic.column(name) for name in states], dim=1)
        (fit,) = LeastSquares().fit(
            x - dynamic.column(block.drive)[:, None] * phi[0] - phi[1],
            dynamic.target[:, [VELOCITY.index(name) for name in states]],
            dynamic.group,
            names=states,
        )
        a, a_error = fit.coefficients, fit.errors
        value = torch.cat((a, -phi @ a))
        variance = phi_error.square() @ a.square() + phi.square() @ a_error.square()
        error = torch.cat((a_error, variance.sqrt()))
        return {
            state: tuple(
                Coefficient(f"{state}_dot", term, float(value[j, i]), float(error[j, i]))
                for j, term in enumerate((*states, block.drive, "1"))
            )
            for i, state in enumerate(states)
        }
