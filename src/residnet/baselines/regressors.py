"""Baselines that are linear in their coefficients, nu_dot = Theta phi(z), with named regressors.

Least squares does not ensure a damped model. A term such as u r in yaw may have either sign, and if
sway and yaw are correlated in the logs, negative damping of this term can be cancelled by terms in
sway: the fit is good, but the model is unstable. The option `dissipative` removes such terms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor, nn

from residnet.baselines.base import ParametricBaseline, select_manoeuvres
from residnet.core.errors import ConfigError
from residnet.core.names import VELOCITY_NAMES
from residnet.core.samples import Samples, directional_derivatives
from residnet.physics.signals import SoftVelocityLimit
from residnet.physics.similarity import Particulars, estimate_lateral_dynamics, is_rudder
from residnet.physics.symmetry import (
    ChannelNames,
    acts_along_own_velocity,
    get_axis_parities,
    get_dof,
    mirror_terms,
    violates_symmetry,
)
from residnet.physics.term_library import TermLibrary
from residnet.regression.estimator import Coefficient, Solution, evaluate_regressors, select_columns
from residnet.regression.least_squares import LeastSquares

if TYPE_CHECKING:
    from residnet.baselines.regressors_config import RegressorsConfig

_RANGE_MARGIN = 0.5
"""Widening of the training range to either side before a bounded model clamps, as a share of it."""


@final
class RegressorBaseline(ParametricBaseline):
    """Baseline that is linear in its coefficients, nu_dot [..., n] = theta [n, J] phi(z).

    All axes share the library of J terms. The coefficient of a term that an axis does not have is
    zero.
    """

    def __init__(
        self,
        terms_by_axis: Sequence[Sequence[str]],
        names: Sequence[str],
        fixed_coefficients: Sequence[tuple[int, str]] = (),
        is_dissipative: bool = False,
        is_bounded: bool = False,
    ) -> None:
        """Create the baseline with zero coefficients.

        Args:
            terms_by_axis: terms of each axis.
            names: channels of the model.
            fixed_coefficients: (axis, term) of coefficients that a refit does not change.
            is_dissipative: whether terms with negative damping are excluded.
            is_bounded: whether channels are clamped outside their widened training range, with a
                restoring acceleration on the velocities.
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
        self.bound: SoftVelocityLimit | None = (
            SoftVelocityLimit(_RANGE_MARGIN, len(names), dof.n_dynamic) if is_bounded else None
        )

    def forward(self, z: Tensor) -> Tensor:
        # coefficients of terms that an axis lacks are masked, because a refit may change theta
        weights = (self.theta * self.term_mask).to(z.dtype)
        if self.bound is not None:
            clamped: Tensor = self.bound.clamp(z)
            phi: Tensor = self.library(clamped)
            restoring_acceleration: Tensor = self.bound.restoring_acceleration(clamped, z)
            return phi @ weights.T + restoring_acceleration
        terms: Tensor = self.library(z)
        return terms @ weights.T

    def parameter_counts(self) -> list[float]:
        """Return the number of nonzero coefficients per axis."""
        return [float(n_nonzero) for n_nonzero in ((self.theta * self.term_mask) != 0).sum(1)]

    def term_columns(self, axis: int) -> list[int]:
        """Return the columns of the library that the equation of an axis contains."""
        columns: list[int] = torch.nonzero(self.term_mask[axis] > 0).flatten().tolist()
        return columns

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
        """Return the Fisher information [P, P] per sample.

        The variance of each axis is the variance of the least-squares residuals.
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
        """Return the precision matrix [P, P] of a prior for port/starboard symmetry."""
        phi, variance = self._terms_and_residual_variance(samples)
        terms = self.library.terms
        mean_squares = phi.square().mean(0)
        mirror_image_of_term = mirror_terms(terms, samples.names)
        if mirror_image_of_term is None:
            # some terms have a known parity even if the mirror image of a channel is unknown
            has_wrong_parity = [
                violates_symmetry(term, i, samples.names)
                for i in range(self.n_dof)
                for term in terms
            ]
            mirror_image_of_term = {}
        else:
            has_wrong_parity = [False] * (self.n_dof * len(terms))
        precision = torch.diag(
            torch.tensor(has_wrong_parity, dtype=torch.float64) * mean_squares.repeat(self.n_dof)
        )
        for axis, axis_sign in enumerate(get_axis_parities(samples.names)):
            for term_index, (image, sign) in mirror_image_of_term.items():
                # the contrast is zero for symmetric coefficients. A term of the wrong parity is its
                # own image with the opposite sign: both entries add, so that the factors are 0.5
                contrast = torch.zeros(self.n_dof * len(terms), dtype=torch.float64)
                contrast[axis * len(terms) + term_index] += 0.5
                contrast[axis * len(terms) + image] -= 0.5 * sign * axis_sign
                precision += mean_squares[term_index] * torch.outer(contrast, contrast)
        # a penalty of the squared asymmetric acceleration, relative to the residual variance of the
        # axis
        precision = precision / variance.repeat_interleave(len(terms))[:, None]
        free_index = self.free_indices()
        return precision[free_index][:, free_index]

    def destabilising_terms(self) -> list[int]:
        """Return indices of free coefficients with the sign of negative damping."""
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
        """Return the index of the free coefficient that destabilises each undamped axis most."""
        if not self.is_dissipative:
            return []
        free_index = self.free_indices().tolist()
        # d nu_dot_i / d nu_i at samples of the data, term by term
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
        """Return the terms [N, J] and the residual variance [n]."""
        phi = self.library(samples.z)
        residuals = samples.target - phi @ (self.theta * self.term_mask).detach().T
        return phi, residuals.square().mean(0)

    def combine_axis_fits(
        self, axis_fits: Mapping[int, Solution], hyperparameters: dict[str, Any]
    ) -> Solution:
        """Combine the solutions of the axes; their tables give the coefficients by term."""
        theta = torch.zeros_like(self.theta)
        covariance = theta.new_zeros(self.n_dof, self.library.n_terms, self.library.n_terms)
        is_covariance_known = True
        for axis, fit in axis_fits.items():
            columns = [self.library.terms.index(coefficient.term) for coefficient in fit.table]
            for column, coefficient in zip(columns, fit.table, strict=True):
                theta[axis, column] = coefficient.value
            if fit.covariance is None:
                is_covariance_known = False
            elif columns:
                covariance[axis][torch.tensor(columns)[:, None], torch.tensor(columns)] = (
                    fit.covariance[0]
                )
        table = tuple(
            coefficient for axis in sorted(axis_fits) for coefficient in axis_fits[axis].table
        )
        return Solution(
            hyperparameters,
            {"theta": theta},
            table,
            covariance=covariance if is_covariance_known else None,
        )


_SLOPE_SAMPLES = 400
"""Minimum number of samples after thinning for the median of derivatives; chosen by hand."""


def _own_velocity_slopes(library: TermLibrary, samples: Samples) -> Tensor:
    """Return the derivatives [n, K, J] of the terms by each dynamic state at K samples."""
    z = samples.z[:: max(1, len(samples) // _SLOPE_SAMPLES)].double()
    dynamic_states = get_dof(samples.names).dynamic_states
    directions = z.new_zeros(len(dynamic_states), *z.shape)
    for axis, name in enumerate(dynamic_states):
        directions[axis, :, samples.names.index(name)] = 1.0
    return directional_derivatives(library, z, directions)


def _find_undamped_term(theta: Tensor, slopes: Tensor) -> int | None:
    """Return the term with the most negative damping if the median damping is negative.

    Args:
        theta: coefficients of the axis [J].
        slopes: derivatives of the terms by the velocity of the axis [K, J].

    Returns:
        The index of the term; None if the axis is damped.
    """
    # a positive derivative of an acceleration by its own velocity is negative damping
    if not len(slopes) or float((slopes @ theta).median()) <= 0.0:
        return None
    contributions = slopes.mean(0) * theta
    largest = int(contributions.argmax())
    return largest if float(contributions[largest]) > 0.0 else None


def _find_common_undamped_term(
    solutions: Sequence[Solution], terms: Sequence[str], slopes: Tensor
) -> set[str]:
    """Return the undamped term that all solutions have in common, as a set; empty if none."""
    undamped_terms = []
    for solution in solutions:
        coefficient_values = {coefficient.term: coefficient.value for coefficient in solution.table}
        theta = torch.tensor(
            [coefficient_values.get(term, 0.0) for term in terms], dtype=slopes.dtype
        )
        term = _find_undamped_term(theta, slopes)
        undamped_terms.append(set() if term is None else {terms[term]})
    return set.intersection(*undamped_terms)


def fit_regressors(
    config: RegressorsConfig, baseline: RegressorBaseline, samples: Samples
) -> list[Solution]:
    """Fit a baseline by least squares or ridge regression; one solution for each penalty.

    Raises:
        FitError: if the data do not determine a coefficient.
    """
    selected_samples = select_manoeuvres(samples, config.manoeuvres)
    estimator = LeastSquares(config.ridge if isinstance(config.ridge, tuple) else (config.ridge,))
    terms = baseline.library.terms
    term_values = evaluate_regressors(baseline.library, selected_samples.z, range(len(terms)))

    def fit_axis(axis: int, columns: list[int]) -> list[Solution]:
        return estimator.fit(
            select_columns(term_values, columns),
            selected_samples.target[:, [axis]],
            selected_samples.group,
            names=[terms[j] for j in columns],
            outputs=(baseline.output_names[axis],),
        )

    # inactive velocities are zero, and rates of angles follow from kinematics: none is fitted
    learned_axes = get_dof(selected_samples.names).active_velocity_indices
    axis_fits = {}
    velocity_slopes = (
        _own_velocity_slopes(baseline.library, selected_samples) if config.dissipative else None
    )
    for axis in learned_axes:
        destabilising: set[str] = set()
        undamped: set[str] = set()
        while True:
            columns = [
                j for j in baseline.term_columns(axis) if terms[j] not in destabilising | undamped
            ]
            axis_solutions = fit_axis(axis, columns)
            if config.dissipative and (
                new_destabilising := _find_common_destabilising_terms(
                    axis_solutions, axis, selected_samples.names
                )
            ):
                destabilising |= new_destabilising
            elif velocity_slopes is not None and (
                new_undamped := _find_common_undamped_term(
                    axis_solutions, terms, velocity_slopes[axis]
                )
            ):
                # terms that were removed by their sign are tried again, because their sign may
                # change without the undamped term
                destabilising = set()
                undamped = undamped | new_undamped
            else:
                break
        axis_fits[axis] = axis_solutions
    if config.particulars is not None:
        _apply_semi_empirical_prior(config.particulars, baseline, selected_samples, axis_fits)
    axis_solutions = [
        baseline.combine_axis_fits(
            dict(zip(learned_axes, axis_candidates, strict=True)),
            axis_candidates[0].hyperparameters,
        )
        for axis_candidates in zip(*axis_fits.values(), strict=True)
    ]
    if not config.bounded:
        return axis_solutions
    velocity_limit = SoftVelocityLimit(_RANGE_MARGIN, len(selected_samples.names), baseline.n_dof)
    velocity_limit.calibrate(selected_samples)
    state = {f"bound.{name}": value for name, value in velocity_limit.state_dict().items()}
    return [replace(solution, state={**solution.state, **state}) for solution in axis_solutions]


_REGRESSION_ERROR = 0.3
"""Relative standard deviation of a semi-empirical derivative, before the evidence widens it."""
_PRIOR_FACTORS = (1.0, 2.0, 4.0, 8.0, 16.0)
"""Factors on this standard deviation, of which the evidence chooses one."""


def _apply_semi_empirical_prior(
    particulars: Particulars,
    baseline: RegressorBaseline,
    samples: Samples,
    axis_fits: dict[int, list[Solution]],
) -> None:
    """Combine the least-squares solutions of sway and yaw with semi-empirical derivatives.

    The prior is on the derivatives of the accelerations by v and r at the service speed, to which
    several terms such as v and u v contribute. The estimates are normal with the covariance of
    least squares, so that the posterior and the marginal likelihood have closed forms (MacKay 1992,
    Bayesian Interpolation, Neural Computation 4(3)). One factor widens the prior of all of them.

    Args:
        particulars: main particulars and service speed.
        baseline: the baseline.
        samples: training samples.
        axis_fits: solutions of each axis, one for each penalty; those of sway and yaw are replaced.

    Raises:
        ConfigError: if the model has other velocities than u, v and r.
    """
    dynamics = estimate_lateral_dynamics(particulars)
    assert dynamics is not None, "the config was validated"
    names = list(samples.names)
    if get_dof(samples.names).dynamic_states != VELOCITY_NAMES:
        raise ConfigError("baseline 'regressors': particulars are for models of u, v and r")
    # straight-ahead motion at service speed; propellers at their mean, rudders amidships
    z = samples.z.double().mean(0, keepdim=True)
    for column, name in enumerate(names):
        if name in VELOCITY_NAMES or is_rudder(name):
            z[:, column] = particulars.speed if name == "u" else 0.0
    directions = z.new_zeros(2, 1, len(names))
    directions[0, 0, names.index("v")] = 1.0
    directions[1, 0, names.index("r")] = 1.0
    # derivatives of the terms by v and r [2, J]
    slopes = directional_derivatives(baseline.library, z, directions)[:, 0]
    targets = torch.tensor(dynamics, dtype=torch.float64)
    for index in range(len(axis_fits[1])):
        least_squares_solutions = {axis: axis_fits[axis][index] for axis in (1, 2)}
        posteriors = [
            _combine_with_prior(least_squares_solutions, baseline, slopes, targets, factor)
            for factor in _PRIOR_FACTORS
        ]
        best = max(range(len(posteriors)), key=lambda k: posteriors[k][0])
        for axis, solution in posteriors[best][1].items():
            axis_fits[axis][index] = solution


def _combine_with_prior(
    least_squares_solutions: Mapping[int, Solution],
    baseline: RegressorBaseline,
    slopes: Tensor,
    targets: Tensor,
    factor: float,
) -> tuple[float, dict[int, Solution]]:
    """Return the log evidence and the posterior solutions of sway and yaw for a width of the prior.

    Args:
        least_squares_solutions: solution of sway and of yaw.
        baseline: the baseline.
        slopes: derivatives of the terms by v and r [2, J].
        targets: semi-empirical derivatives of the accelerations of sway and yaw [2, 2].
        factor: factor on the standard deviation of the regressions.
    """
    log_evidence = 0.0
    posteriors = {}
    for axis, solution in least_squares_solutions.items():
        columns = [baseline.library.terms.index(entry.term) for entry in solution.table]
        design = slopes[:, columns]
        target = targets[axis - 1]
        assert solution.covariance is not None, "least squares has a covariance"
        covariance = solution.covariance[0]
        estimate = torch.tensor([entry.value for entry in solution.table], dtype=torch.float64)
        # a velocity without terms in this axis has no derivative that a prior could change
        is_used = design.abs().amax(1) > 0.0
        design = design[is_used]
        target = target[is_used]
        noise = torch.diag((factor * _REGRESSION_ERROR * target).square())
        innovation = target - design @ estimate
        innovation_covariance = design @ covariance @ design.T + noise
        log_evidence -= 0.5 * float(
            innovation @ torch.linalg.solve(innovation_covariance, innovation)
            + torch.linalg.slogdet(innovation_covariance).logabsdet
        )
        gain = torch.linalg.solve(innovation_covariance, design @ covariance).T
        posterior = estimate + gain @ innovation
        posterior_covariance = covariance - gain @ design @ covariance
        errors = posterior_covariance.diagonal().clamp(min=0.0).sqrt()
        table = tuple(
            replace(entry, value=value, standard_error=error)
            for entry, value, error in zip(
                solution.table, posterior.tolist(), errors.tolist(), strict=True
            )
        )
        posteriors[axis] = replace(solution, table=table, covariance=posterior_covariance[None])
    return log_evidence, posteriors


def _find_common_destabilising_terms(
    solutions: Sequence[Solution], axis: int, names: Sequence[str]
) -> set[str]:
    """Return the terms with the sign of negative damping in every solution."""
    destabilising_terms = [
        {
            coefficient.term
            for coefficient in solution.table
            if coefficient.value > 0.0 and acts_along_own_velocity(coefficient.term, axis, names)
        }
        for solution in solutions
    ]
    return set.intersection(*destabilising_terms)
