"""Baselines that are linear in their coefficients, nu_dot = Theta phi(z), regressors by name.

Single terms such as u r in yaw may have either sign. Where sway and yaw go together in the logs,
least squares can give such a term a sign that feeds the yaw and let the sway take it out again: the
fit is good, and the model is not damped.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, final

import torch
from pydantic import Field, model_validator
from torch import Tensor, nn

from residnet.baselines.base import Baseline, IdentifiedConfig, ParametricBaseline, of_manoeuvres
from residnet.baselines.sets import Roles, SetName, expand, merged
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY
from residnet.core.samples import Samples, derivatives_along
from residnet.physics.signals import VelocityBound
from residnet.physics.symmetry import (
    ChannelNames,
    axis_parities,
    dissipates,
    live_of,
    living,
    mirrored_terms,
    without_dead,
    wrong_parity,
)
from residnet.physics.terms import TermLibrary
from residnet.regression.estimator import Coefficient, Solution, chosen, regressors
from residnet.regression.least_squares import LeastSquares

_BEYOND = 0.5
"""Share of a channel's training range, on either side, in which a bounded model is as fitted."""
RowTerms = dict[Literal["u", "v", "r", "w", "p", "q"], tuple[str, ...]]
Penalty = Annotated[float, Field(ge=0)]


@final
class RegressorBaseline(ParametricBaseline):
    """A baseline that is linear in its coefficients, nu_dot [..., n] = theta [n, J] phi(z).

    A term that an axis does not have keeps a zero.
    """

    def __init__(
        self,
        rows: Sequence[Sequence[str]],
        names: Sequence[str],
        held: Sequence[tuple[int, str]] = (),
        dissipative: bool = False,
        bounded: bool = False,
    ) -> None:
        """From the terms of each axis; `held`: (axis, term) of coefficients that a refit through
        rollouts must leave as they are; `dissipative`: no term may feed energy;
        `bounded`: channels far beyond their training range are taken at its edge, and velocities
        are pulled back.
        """
        terms = list(dict.fromkeys(term for row in rows for term in row))
        live = live_of(names)
        super().__init__(torch.zeros(live.size, len(terms), dtype=torch.float64))
        self.dof, self.axes, self.outputs = live.size, live.moving, live.rates
        self.library = TermLibrary(terms, names)
        allowed = torch.tensor(
            [[term in row for term in terms] for row in rows], dtype=torch.float64
        )
        self.allowed = nn.Buffer(allowed, persistent=False)
        self.held = tuple((axis, terms.index(term)) for axis, term in held)
        self.dissipative = dissipative
        self.names = names if isinstance(names, ChannelNames) else tuple(names)
        self.bound: VelocityBound | None = (
            VelocityBound(_BEYOND, len(names), live.size) if bounded else None
        )

    def forward(self, z: Tensor) -> Tensor:
        weights = (self.theta * self.allowed).to(z.dtype)
        if self.bound is not None:
            held: Tensor = self.bound.held(z)
            phi: Tensor = self.library(held)
            back: Tensor = self.bound.back(held, z)
            return phi @ weights.T + back
        known: Tensor = self.library(z)
        return known @ weights.T

    def parameter_count(self) -> list[float]:
        """Return the number of coefficients of each axis that are not zero."""
        return [float(count) for count in ((self.theta * self.allowed) != 0).sum(1)]

    def columns(self, axis: int) -> list[int]:
        """Return the places of the terms that an axis has."""
        return [j for j in range(self.library.count) if bool(self.allowed[axis, j] > 0)]

    def free_indices(self) -> Tensor:
        free = self.allowed > 0
        for axis, column in self.held:
            free[axis, column] = False
        return torch.nonzero(free.flatten()).squeeze(1)

    def free_names(self) -> list[tuple[str, str]]:
        terms = self.library.terms
        return [
            (self.outputs[i // len(terms)], terms[i % len(terms)])
            for i in self.free_indices().tolist()
        ]

    def information(self, samples: Samples) -> Tensor:
        """Return the mean information of a sample [P, P].

        Each axis weighs by the variance that least squares leaves of it.
        """
        phi, variance = self._residual(samples)
        gram = phi.T @ phi / len(samples)
        free = self.free_indices()
        blocks = [gram / variance[axis] for axis in range(self.dof)]
        whole: Tensor = torch.block_diag(*blocks)
        return whole[free][:, free]

    def prior(self) -> tuple[Tensor, Tensor]:
        none = torch.zeros(self.free_indices().numel(), dtype=torch.float64)
        return none, none

    def asymmetry(self, samples: Samples) -> Tensor:
        """Return the mean information of a sample [P, P] about what breaks the mirror symmetry."""
        phi, variance = self._residual(samples)
        terms, energy = self.library.terms, phi.square().mean(0)
        images = mirrored_terms(terms, samples.names)
        if images is None:
            # of single terms some parity may be known where that of all channels is not
            wrong = [wrong_parity(t, i, samples.names) for i in range(self.dof) for t in terms]
            images = {}
        else:
            wrong = [False] * (self.dof * len(terms))
        out = torch.diag(torch.tensor(wrong, dtype=torch.float64) * energy.repeat(self.dof))
        for axis, turned in enumerate(axis_parities(samples.names)):
            for place, (other, sign) in images.items():
                # a quarter: the image of a term of the wrong parity is the term with minus
                apart = torch.zeros(self.dof * len(terms), dtype=torch.float64)
                apart[axis * len(terms) + place] += 0.5
                apart[axis * len(terms) + other] -= 0.5 * sign * turned
                out += energy[place] * torch.outer(apart, apart)
        out = out / variance.repeat_interleave(len(terms))[:, None]
        free = self.free_indices()
        return out[free][:, free]

    def feeding(self) -> list[int]:
        """Return the free coefficients, by their number among these, that feed energy."""
        if not self.dissipative:
            return []
        count = self.library.count
        flat = self.theta.flatten().tolist()
        return [
            i
            for i, place in enumerate(self.free_indices().tolist())
            if flat[place] > 0.0
            and dissipates(self.library.terms[place % count], place // count, self.names)
        ]

    def undamped(self, samples: Samples) -> list[int]:
        """Return the free coefficients, by their number, that feed an axis most where it is fed."""
        if not self.dissipative:
            return []
        free = self.free_indices().tolist()
        slopes, theta = _own_slopes(self.library, samples), self.theta.detach()
        found = [(axis, _undamped(theta[axis], slopes[axis])) for axis in range(self.dof)]
        places = [axis * self.library.count + term for axis, term in found if term is not None]
        return [free.index(place) for place in places if place in free]

    def updated_table(self, table: Sequence[Coefficient], errors: Tensor) -> list[Coefficient]:
        terms = self.library.terms
        rows = {
            name: dict(zip(terms, self.theta[axis].tolist(), strict=True))
            for axis, name in enumerate(self.outputs)
        }
        known = dict(zip(self.free_names(), errors.tolist(), strict=True))
        return [
            (
                replace(c, value=c.ratio.of(rows[c.axis]))
                if c.ratio is not None
                else replace(
                    c, value=rows[c.axis][c.term], error=known.get((c.axis, c.term), c.error)
                )
            )
            for c in table
        ]

    def _residual(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Return the terms [N, J], and the variance [n] of what they leave."""
        phi = self.library(samples.z)
        left = samples.target - phi @ (self.theta * self.allowed).detach().T
        return phi, left.square().mean(0)

    def solution(self, fits: Mapping[int, Solution], choice: dict[str, Any]) -> Solution:
        """Return the solution of all axes from that of each, whose table names its terms."""
        theta = torch.zeros_like(self.theta)
        for axis, fit in fits.items():
            for entry in fit.table:
                theta[axis, self.library.terms.index(entry.term)] = entry.value
        table = tuple(entry for axis in sorted(fits) for entry in fits[axis].table)
        return Solution(choice, {"theta": theta}, table)


def living_rows(rows: Sequence[Sequence[str]], names: Sequence[str]) -> list[tuple[str, ...]]:
    """Return the terms of what moves that are not zero at all times.

    An axis has none where it is zero itself, is an angle whose rate is known, or is behind `rows`.
    """
    live = live_of(names)
    given = [*rows, *[()] * (live.size - len(rows))]
    return [
        tuple(term for term in row if living(term, names)) if axis in live.learned else ()
        for axis, row in enumerate(given)
    ]


_POINTS = 400
"""Samples, up to twice as many, that tell slopes; chosen by hand: a median needs few."""


def _own_slopes(library: TermLibrary, samples: Samples) -> Tensor:
    """Return the slopes [n, K, J] of the terms along what moves at samples spread evenly."""
    z = samples.z[:: max(1, len(samples) // _POINTS)].double()
    moving = live_of(samples.names).moving
    ahead = z.new_zeros(len(moving), *z.shape)
    for axis, name in enumerate(moving):
        ahead[axis, :, samples.names.index(name)] = 1.0
    return derivatives_along(library, z, ahead)


def _undamped(theta: Tensor, slopes: Tensor) -> int | None:
    """Return the term that feeds an axis most where half of the samples feed it; None for none.

    Args:
        theta: coefficients of the axis, [J].
        slopes: of the terms along the velocity of the axis, [K, J].
    """
    if not len(slopes) or float((slopes @ theta).median()) <= 0.0:
        return None
    shares = slopes.mean(0) * theta
    most = int(shares.argmax())
    return most if float(shares[most]) > 0.0 else None


def _turning(solutions: Sequence[Solution], terms: Sequence[str], slopes: Tensor) -> set[str]:
    """Return the term, if any, that turns an axis' damping about in every solution."""
    found = []
    for one in solutions:
        values = {c.term: c.value for c in one.table}
        theta = torch.tensor([values.get(term, 0.0) for term in terms], dtype=slopes.dtype)
        term = _undamped(theta, slopes)
        found.append(set() if term is None else {terms[term]})
    return set.intersection(*found)


class RegressorsConfig(IdentifiedConfig):
    """Least squares (or ridge) of accelerations on named regressors.

    Attributes:
        sets: regressors of every axis by the name of a set, written out for the model's channels:
            `linear`; `fossen` (linear and quadratic damping, Coriolis products, propeller and
            rudder); `abkowitz` (third-order Taylor series about straight ahead); `astern` (what
            tells a propeller that turns astern); `wind`; `polynomial_1`, `polynomial_2` (all
            products of velocities and inputs, the ridge models of document 001 section 2.2).
        terms: further regressors of every axis, or of each axis `u`, `v`, `r` (and `p` of a roll,
            `w`, `p`, `q` of six); with neither sets nor terms: the constant and every channel.
        drive: channels that the sets take as thrust; empty: n, or tau_x where the model makes
            forces.
        steer: channels that the sets take as steering; empty: delta, or tau_n where the model makes
            forces.
        ridge: penalty as a share of each regressor's energy, 0 for ordinary least squares; of
            several the one whose free run is best on validation data.
        manoeuvres: kinds of manoeuvre to fit on; empty for all.
        dissipative: terms along an axis' own velocity, such as u|u| in surge or v|r| in sway, whose
            sign would feed energy are left out, and the others fitted again; so is, where an axis
            is not damped at most of the samples, the term that feeds it most, such as u r in yaw.
            A refit does the same.
        bounded: terms take velocities and inputs that are far outside their training range (by half
            its width) at the edge of that, and such velocities are pulled back, so that the model
            cannot run away.
    """

    kind: Literal["regressors"] = "regressors"
    sets: tuple[SetName, ...] = ()
    terms: tuple[str, ...] | RowTerms = ()
    drive: tuple[str, ...] = ()
    steer: tuple[str, ...] = ()
    ridge: Penalty | Annotated[tuple[Penalty, ...], Field(min_length=2)] = 0.0
    manoeuvres: tuple[str, ...] = ()
    dissipative: bool = False
    bounded: bool = False

    @model_validator(mode="after")
    def _rows(self) -> RegressorsConfig:
        if isinstance(self.terms, dict) and not {*VELOCITY} <= set(self.terms):
            raise ValueError(f"terms per axis need all of u, v, r; given {sorted(self.terms)}")
        if (self.drive or self.steer) and not self.sets:
            raise ValueError(
                "drive and steer say what `sets` are written out for; give sets, or leave them out"
            )
        return self

    def rows(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the regressors of each axis for channels `names`.

        One that sets and terms both name stands once, as it was named first. Velocities that are
        zero at all times have none, and no term holds them.
        """
        return living_rows(self._named(names), names)

    def _named(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the regressors of each axis as the settings name them."""
        axes = live_of(names).layout.velocities
        if isinstance(self.terms, dict) and set(self.terms) != set(axes):
            raise ConfigError(
                f"terms: the axes of the model are {', '.join(axes)}; given {sorted(self.terms)}"
            )
        given = (
            [
                tuple(row)
                for _, row in sorted(self.terms.items(), key=lambda one: axes.index(one[0]))
            ]
            if isinstance(self.terms, dict)
            else [tuple(self.terms)] * len(axes)
        )
        if self.sets:
            shared = expand(self.sets, Roles.of(names, self.drive, self.steer))
            return [merged((*shared, *row), names) for row in given]
        return [row or ("1", *without_dead(names)) for row in given] if self.terms == () else given

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        return RegressorBaseline(
            self.rows(names), names, dissipative=self.dissipative, bounded=self.bounded
        )

    def require_samples(self, samples: Samples) -> None:
        of_manoeuvres(samples, self.manoeuvres)

    def solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        assert isinstance(baseline, RegressorBaseline)
        picked = of_manoeuvres(samples, self.manoeuvres)
        estimator = LeastSquares(self.ridge if isinstance(self.ridge, tuple) else (self.ridge,))
        terms = baseline.library.terms
        phi = regressors(baseline.library, picked.z, range(len(terms)))

        def fitted(axis: int, columns: list[int]) -> list[Solution]:
            return estimator.fit(
                chosen(phi, columns),
                picked.target[:, [axis]],
                picked.group,
                names=[terms[j] for j in columns],
                outputs=(baseline.outputs[axis],),
            )

        # an axis that is zero at all times, or whose rate is known, has nothing to fit
        live = live_of(picked.names).learned
        fits = {}
        slopes = _own_slopes(baseline.library, picked) if self.dissipative else None
        for axis in live:
            feeding: set[str] = set()
            turning: set[str] = set()
            while True:
                columns = [j for j in baseline.columns(axis) if terms[j] not in feeding | turning]
                found = fitted(axis, columns)
                if fed := self._feeding(found, axis, picked.names):
                    feeding |= fed
                elif slopes is not None and (turned := _turning(found, terms, slopes[axis])):
                    # what fed energy beside this term may not without it
                    feeding, turning = set(), turning | turned
                else:
                    break
            fits[axis] = found
        found = [
            baseline.solution(dict(zip(live, axes, strict=True)), axes[0].choice)
            for axes in zip(*fits.values(), strict=True)
        ]
        if not self.bounded:
            return found
        bound = VelocityBound(_BEYOND, len(picked.names), baseline.dof)
        bound.calibrate(picked)
        state = {f"bound.{name}": value for name, value in bound.state_dict().items()}
        return [replace(one, state={**one.state, **state}) for one in found]

    def _feeding(self, solutions: Sequence[Solution], axis: int, names: Sequence[str]) -> set[str]:
        """Return terms that feed energy in every solution and may not."""
        if not self.dissipative:
            return set()
        found = [
            {c.term for c in one.table if c.value > 0.0 and dissipates(c.term, axis, names)}
            for one in solutions
        ]
        return set.intersection(*found)
