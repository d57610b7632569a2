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

from residnet.baselines.base import (
    Baseline,
    IdentifiedConfig,
    ParametricBaseline,
    select_manoeuvres,
)
from residnet.baselines.sets import ChannelRoles, SetName, drop_equivalent_terms, expand_sets
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY_NAMES
from residnet.core.samples import Samples, directional_derivatives
from residnet.physics.signals import RestoringAcceleration
from residnet.physics.symmetry import (
    ChannelNames,
    active_channels,
    acts_along_own_velocity,
    get_axis_parities,
    get_dof,
    is_active_term,
    mirror_terms,
    violates_symmetry,
)
from residnet.physics.terms import TermLibrary
from residnet.regression.estimator import Coefficient, Solution, evaluate_regressors, select_columns
from residnet.regression.least_squares import LeastSquares

_RANGE_MARGIN = 0.5
"""Share of a channel's training range, on either side, in which a bounded model is as fitted."""
AxisTermNames = dict[Literal["u", "v", "r", "w", "p", "q"], tuple[str, ...]]
Penalty = Annotated[float, Field(ge=0)]


@final
class RegressorBaseline(ParametricBaseline):
    """A baseline that is linear in its coefficients, nu_dot [..., n] = theta [n, J] phi(z).

    A term that an axis does not have keeps a zero.
    """

    def __init__(
        self,
        terms_by_axis: Sequence[Sequence[str]],
        names: Sequence[str],
        fixed_coefficients: Sequence[tuple[int, str]] = (),
        is_dissipative: bool = False,
        is_bounded: bool = False,
    ) -> None:
        """From the terms of each axis; `held`: (axis, term) of coefficients that a refit through
        rollouts must leave as they are; `is_dissipative`: no term may feed energy;
        `is_bounded`: channels far beyond their training range are taken at its edge, and velocities
        are pulled back.
        """
        terms = list(dict.fromkeys(term for axis_terms in terms_by_axis for term in axis_terms))
        dof = get_dof(names)
        super().__init__(torch.zeros(dof.n_dynamic, len(terms), dtype=torch.float64))
        self.n_dof = dof.n_dynamic
        self.axis_names = dof.dynamic_states
        self.output_names = dof.derivative_names
        self.library = TermLibrary(terms, names)
        term_mask = torch.tensor(
            [[term in axis_terms for term in terms] for axis_terms in terms_by_axis],
            dtype=torch.float64,
        )
        self.term_mask = nn.Buffer(term_mask, persistent=False)
        self.fixed_coefficients = tuple(
            (axis, terms.index(term)) for axis, term in fixed_coefficients
        )
        self.is_dissipative = is_dissipative
        self.channel_names = names if isinstance(names, ChannelNames) else tuple(names)
        self.bound: RestoringAcceleration | None = (
            RestoringAcceleration(_RANGE_MARGIN, len(names), dof.n_dynamic) if is_bounded else None
        )

    def forward(self, z: Tensor) -> Tensor:
        weights = (self.theta * self.term_mask).to(z.dtype)
        if self.bound is not None:
            clamped: Tensor = self.bound.clamp(z)
            phi: Tensor = self.library(clamped)
            restoring_acceleration: Tensor = self.bound.restoring_acceleration(clamped, z)
            return phi @ weights.T + restoring_acceleration
        acceleration: Tensor = self.library(z)
        return acceleration @ weights.T

    def parameter_counts(self) -> list[float]:
        """Return the number of coefficients of each axis that are not zero."""
        return [float(n_nonzero) for n_nonzero in ((self.theta * self.term_mask) != 0).sum(1)]

    def term_columns(self, axis: int) -> list[int]:
        """Return the places of the terms that an axis has."""
        return [j for j in range(self.library.n_terms) if bool(self.term_mask[axis, j] > 0)]

    def free_indices(self) -> Tensor:
        is_free = self.term_mask > 0
        for axis, column in self.fixed_coefficients:
            is_free[axis, column] = False
        return torch.nonzero(is_free.flatten()).squeeze(1)

    def free_parameter_names(self) -> list[tuple[str, str]]:
        terms = self.library.terms
        return [
            (self.output_names[i // len(terms)], terms[i % len(terms)])
            for i in self.free_indices().tolist()
        ]

    def mean_information(self, samples: Samples) -> Tensor:
        """Return the mean information of a sample [P, P].

        Each axis weighs by the variance that least squares leaves of it.
        """
        phi, variance = self._terms_and_residual_variance(samples)
        mean_gram = phi.T @ phi / len(samples)
        free_index = self.free_indices()
        axis_information = [mean_gram / variance[axis] for axis in range(self.n_dof)]
        full_information: Tensor = torch.block_diag(*axis_information)
        return full_information[free_index][:, free_index]

    def prior(self) -> tuple[Tensor, Tensor]:
        zeros = torch.zeros(self.free_indices().numel(), dtype=torch.float64)
        return zeros, zeros

    def symmetry_precision(self, samples: Samples) -> Tensor:
        """Return the mean information of a sample [P, P] about what breaks the mirror symmetry."""
        phi, variance = self._terms_and_residual_variance(samples)
        terms = self.library.terms
        energy = phi.square().mean(0)
        images = mirror_terms(terms, samples.names)
        if images is None:
            # of single terms some parity may be known where that of all channels is not
            violates = [
                violates_symmetry(term, i, samples.names)
                for i in range(self.n_dof)
                for term in terms
            ]
            images = {}
        else:
            violates = [False] * (self.n_dof * len(terms))
        precision = torch.diag(
            torch.tensor(violates, dtype=torch.float64) * energy.repeat(self.n_dof)
        )
        for axis, axis_sign in enumerate(get_axis_parities(samples.names)):
            for term_index, (image, sign) in images.items():
                # a quarter: the image of a term of the wrong parity is the term with minus
                contrast = torch.zeros(self.n_dof * len(terms), dtype=torch.float64)
                contrast[axis * len(terms) + term_index] += 0.5
                contrast[axis * len(terms) + image] -= 0.5 * sign * axis_sign
                precision += energy[term_index] * torch.outer(contrast, contrast)
        precision = precision / variance.repeat_interleave(len(terms))[:, None]
        free_index = self.free_indices()
        return precision[free_index][:, free_index]

    def destabilising_terms(self) -> list[int]:
        """Return the free coefficients, by their number among these, that feed energy."""
        if not self.is_dissipative:
            return []
        n_terms = self.library.n_terms
        flat_theta = self.theta.flatten().tolist()
        return [
            i
            for i, theta_index in enumerate(self.free_indices().tolist())
            if flat_theta[theta_index] > 0.0
            and acts_along_own_velocity(
                self.library.terms[theta_index % n_terms],
                theta_index // n_terms,
                self.channel_names,
            )
        ]

    def undamped_terms(self, samples: Samples) -> list[int]:
        """Return the free coefficients, by their number, that feed an axis most where it is fed."""
        if not self.is_dissipative:
            return []
        free_index = self.free_indices().tolist()
        slopes = _own_velocity_slopes(self.library, samples)
        theta = self.theta.detach()
        undamped = [
            (axis, _find_undamped_term(theta[axis], slopes[axis])) for axis in range(self.n_dof)
        ]
        theta_indices = [
            axis * self.library.n_terms + term for axis, term in undamped if term is not None
        ]
        return [
            free_index.index(theta_index)
            for theta_index in theta_indices
            if theta_index in free_index
        ]

    def refresh_table(
        self, table: Sequence[Coefficient], standard_errors: Tensor
    ) -> list[Coefficient]:
        terms = self.library.terms
        coefficients_by_axis = {
            name: dict(zip(terms, self.theta[axis].tolist(), strict=True))
            for axis, name in enumerate(self.output_names)
        }
        standard_error_of = dict(
            zip(self.free_parameter_names(), standard_errors.tolist(), strict=True)
        )
        return [
            (
                replace(
                    coefficient,
                    value=coefficient.ratio.evaluate(coefficients_by_axis[coefficient.axis]),
                )
                if coefficient.ratio is not None
                else replace(
                    coefficient,
                    value=coefficients_by_axis[coefficient.axis][coefficient.term],
                    standard_error=standard_error_of.get(
                        (coefficient.axis, coefficient.term), coefficient.standard_error
                    ),
                )
            )
            for coefficient in table
        ]

    def _terms_and_residual_variance(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Return the terms [N, J], and the variance [n] of what they leave."""
        phi = self.library(samples.z)
        residuals = samples.target - phi @ (self.theta * self.term_mask).detach().T
        return phi, residuals.square().mean(0)

    def combine_axis_fits(
        self, axis_fits: Mapping[int, Solution], hyperparameters: dict[str, Any]
    ) -> Solution:
        """Return the solution of all axes from that of each, whose table names its terms."""
        theta = torch.zeros_like(self.theta)
        for axis, fit in axis_fits.items():
            for coefficient in fit.table:
                theta[axis, self.library.terms.index(coefficient.term)] = coefficient.value
        table = tuple(
            coefficient for axis in sorted(axis_fits) for coefficient in axis_fits[axis].table
        )
        return Solution(hyperparameters, {"theta": theta}, table)


def active_terms(
    terms_by_axis: Sequence[Sequence[str]], names: Sequence[str]
) -> list[tuple[str, ...]]:
    """Return the terms of what moves that are not zero at all times.

    An axis has none where it is zero itself, is an angle whose rate is known, or is behind `rows`.
    """
    dof = get_dof(names)
    all_axes = [*terms_by_axis, *[()] * (dof.n_dynamic - len(terms_by_axis))]
    return [
        tuple(term for term in axis_terms if is_active_term(term, names))
        if axis in dof.regressed_indices
        else ()
        for axis, axis_terms in enumerate(all_axes)
    ]


_SLOPE_SAMPLES = 400
"""Samples, up to twice as many, that tell slopes; chosen by hand: a median needs few."""


def _own_velocity_slopes(library: TermLibrary, samples: Samples) -> Tensor:
    """Return the slopes [n, K, J] of the terms along what moves at samples spread evenly."""
    z = samples.z[:: max(1, len(samples) // _SLOPE_SAMPLES)].double()
    dynamic_states = get_dof(samples.names).dynamic_states
    directions = z.new_zeros(len(dynamic_states), *z.shape)
    for axis, name in enumerate(dynamic_states):
        directions[axis, :, samples.names.index(name)] = 1.0
    return directional_derivatives(library, z, directions)


def _find_undamped_term(theta: Tensor, slopes: Tensor) -> int | None:
    """Return the term that feeds an axis most where half of the samples feed it; None for none.

    Args:
        theta: coefficients of the axis, [J].
        slopes: of the terms along the velocity of the axis, [K, J].
    """
    if not len(slopes) or float((slopes @ theta).median()) <= 0.0:
        return None
    contributions = slopes.mean(0) * theta
    largest = int(contributions.argmax())
    return largest if float(contributions[largest]) > 0.0 else None


def _find_common_undamped_term(
    solutions: Sequence[Solution], terms: Sequence[str], slopes: Tensor
) -> set[str]:
    """Return the term, if any, that turns an axis' damping about in every solution."""
    undamped_terms = []
    for solution in solutions:
        coefficient_values = {coefficient.term: coefficient.value for coefficient in solution.table}
        theta = torch.tensor(
            [coefficient_values.get(term, 0.0) for term in terms], dtype=slopes.dtype
        )
        term = _find_undamped_term(theta, slopes)
        undamped_terms.append(set() if term is None else {terms[term]})
    return set.intersection(*undamped_terms)


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
    terms: tuple[str, ...] | AxisTermNames = ()
    drive: tuple[str, ...] = ()
    steer: tuple[str, ...] = ()
    ridge: Penalty | Annotated[tuple[Penalty, ...], Field(min_length=2)] = 0.0
    manoeuvres: tuple[str, ...] = ()
    dissipative: bool = False
    bounded: bool = False

    @model_validator(mode="after")
    def _validate_terms(self) -> RegressorsConfig:
        if isinstance(self.terms, dict) and not {*VELOCITY_NAMES} <= set(self.terms):
            raise ValueError(f"terms per axis need all of u, v, r; given {sorted(self.terms)}")
        if (self.drive or self.steer) and not self.sets:
            raise ValueError(
                "drive and steer say what `sets` are written out for; give sets, or leave them out"
            )
        return self

    def axis_terms(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the regressors of each axis for channels `channel_names`.

        One that sets and terms both name stands once, as it was named first. Velocities that are
        zero at all times have none, and no term holds them.
        """
        return active_terms(self._configured_terms(names), names)

    def _configured_terms(self, names: Sequence[str]) -> list[tuple[str, ...]]:
        """Return the regressors of each axis as the settings name them."""
        axes = get_dof(names).layout.velocities
        if isinstance(self.terms, dict) and set(self.terms) != set(axes):
            raise ConfigError(
                f"terms: the axes of the model are {', '.join(axes)}; given {sorted(self.terms)}"
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

    def build(self, names: Sequence[str]) -> RegressorBaseline:
        return RegressorBaseline(
            self.axis_terms(names), names, is_dissipative=self.dissipative, is_bounded=self.bounded
        )

    def validate_samples(self, samples: Samples) -> None:
        select_manoeuvres(samples, self.manoeuvres)

    def fit_solutions(self, baseline: Baseline, samples: Samples) -> list[Solution]:
        assert isinstance(baseline, RegressorBaseline)
        selected = select_manoeuvres(samples, self.manoeuvres)
        estimator = LeastSquares(self.ridge if isinstance(self.ridge, tuple) else (self.ridge,))
        terms = baseline.library.terms
        term_values = evaluate_regressors(baseline.library, selected.z, range(len(terms)))

        def fit_axis(axis: int, columns: list[int]) -> list[Solution]:
            return estimator.fit(
                select_columns(term_values, columns),
                selected.target[:, [axis]],
                selected.group,
                names=[terms[j] for j in columns],
                outputs=(baseline.output_names[axis],),
            )

        # an axis that is zero at all times, or whose rate is known, has nothing to fit
        learned_axes = get_dof(selected.names).regressed_indices
        axis_fits = {}
        velocity_slopes = (
            _own_velocity_slopes(baseline.library, selected) if self.dissipative else None
        )
        for axis in learned_axes:
            destabilising: set[str] = set()
            undamped: set[str] = set()
            while True:
                columns = [
                    j
                    for j in baseline.term_columns(axis)
                    if terms[j] not in destabilising | undamped
                ]
                axis_solutions = fit_axis(axis, columns)
                if new_destabilising := self._destabilising_in_all(
                    axis_solutions, axis, selected.names
                ):
                    destabilising |= new_destabilising
                elif velocity_slopes is not None and (
                    new_undamped := _find_common_undamped_term(
                        axis_solutions, terms, velocity_slopes[axis]
                    )
                ):
                    # what fed energy beside this term may not without it
                    destabilising = set()
                    undamped = undamped | new_undamped
                else:
                    break
            axis_fits[axis] = axis_solutions
        axis_solutions = [
            baseline.combine_axis_fits(
                dict(zip(learned_axes, axis_candidates, strict=True)),
                axis_candidates[0].hyperparameters,
            )
            for axis_candidates in zip(*axis_fits.values(), strict=True)
        ]
        if not self.bounded:
            return axis_solutions
        restoring = RestoringAcceleration(_RANGE_MARGIN, len(selected.names), baseline.n_dof)
        restoring.calibrate(selected)
        state = {f"bound.{name}": value for name, value in restoring.state_dict().items()}
        return [replace(solution, state={**solution.state, **state}) for solution in axis_solutions]

    def _destabilising_in_all(
        self, solutions: Sequence[Solution], axis: int, names: Sequence[str]
    ) -> set[str]:
        """Return terms that feed energy in every solution and may not."""
        if not self.dissipative:
            return set()
        destabilising_terms = [
            {
                coefficient.term
                for coefficient in solution.table
                if coefficient.value > 0.0
                and acts_along_own_velocity(coefficient.term, axis, names)
            }
            for solution in solutions
        ]
        return set.intersection(*destabilising_terms)
