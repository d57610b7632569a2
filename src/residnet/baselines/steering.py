"""First-order models of speed and steering: Nomoto models and the linear model of Woo et al. 2018.

Nomoto models (Woo et al. 2018, eqs. (12)-(15), Gouletas 2020, section 5.1.2) are identified by
least squares on derivatives, the linear model (Woo et al. 2018, sections 2.2, 4.2.1, 4.2.2) from
steady states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from residnet.baselines.base import select_manoeuvres
from residnet.baselines.regressors import RegressorBaseline
from residnet.baselines.sets import active_terms
from residnet.core.errors import FitError
from residnet.core.names import ACCELERATION_NAMES, VELOCITY_NAMES
from residnet.core.samples import Samples
from residnet.physics.symmetry import get_dof
from residnet.regression.estimator import Coefficient, Ratio, Solution
from residnet.regression.least_squares import LeastSquares

if TYPE_CHECKING:
    from residnet.baselines.steering_config import (
        LinearSteadyConfig,
        NomotoLagConfig,
        SteadyStateBlock,
    )


def _sway_decay(yaw_coefficients: Sequence[Coefficient]) -> tuple[Coefficient, ...]:
    """Return the coefficient of a sway velocity that decays with the yaw time constant."""
    yaw_coefficient = next(
        coefficient for coefficient in yaw_coefficients if coefficient.term == "r"
    )
    return (Coefficient("v_dot", "v", yaw_coefficient.value, yaw_coefficient.standard_error),)


def _lag_ratios(state: str, drive: str, suffix: str) -> dict[str, Ratio]:
    """Return T, K and b of T x_dot + x = K drive + b as ratios of a, k, c.

    The coefficients belong to x_dot = a x + k drive + c.
    """
    numerators = {"T": None, "K": drive, "b": "1"}
    return {f"{name}{suffix}": Ratio(-1.0, term, state) for name, term in numerators.items()}


def _ratio_parameters(
    axis: int, terms: Sequence[str], fit: Solution, ratios: Mapping[str, Ratio]
) -> list[Coefficient]:
    """Compute parameters that are ratios of coefficients, with first-order error propagation."""
    theta = fit.coefficients[:, 0]
    assert fit.covariance is not None
    parameters = []
    for name, ratio in ratios.items():
        denominator_index = terms.index(ratio.denominator)
        gradient = torch.zeros_like(theta)
        value = ratio.evaluate(dict(zip(terms, theta.tolist(), strict=True)))
        # delta method: the gradient of a quotient by its numerator and denominator
        gradient[denominator_index] = -value / theta[denominator_index]
        if ratio.numerator is not None:
            gradient[terms.index(ratio.numerator)] += ratio.sign / theta[denominator_index]
        standard_error = (gradient @ fit.covariance[0] @ gradient).clamp(min=0).sqrt()
        parameters.append(
            Coefficient(ACCELERATION_NAMES[axis], name, value, float(standard_error), ratio)
        )
    return parameters


def fit_nomoto(config: NomotoLagConfig, baseline: RegressorBaseline, samples: Samples) -> Solution:
    """Fit a Nomoto model; the table has the coefficients, then T, K and b of each axis.

    Raises:
        FitError: if the data do not determine a coefficient, or an axis is unstable.
    """
    ratios = (
        _lag_ratios("u", config.drive, "_u"),
        {
            "T_beta": Ratio(-1.0, None, "v"),
            "K_beta": Ratio(1.0, "u r", "v"),
            "b_beta": Ratio(-1.0, "u", "v"),
        },
        _lag_ratios("r", config.steer, ""),
    )
    selected = select_manoeuvres(samples, config.manoeuvres)
    axis_fits = {}
    parameters = []
    for axis, terms in enumerate(active_terms(config.axis_terms(), selected.names)):
        if len(terms) > 1:
            axis_fits[axis] = _fit_lag(baseline, selected, axis, terms)
            parameters += _ratio_parameters(axis, terms, axis_fits[axis], ratios[axis])
    if 1 not in axis_fits and "v" in get_dof(selected.names).velocities:
        axis_fits[1] = Solution({}, {}, _sway_decay(axis_fits[2].table))
    solution = baseline.combine_axis_fits(axis_fits, {})
    return replace(solution, table=(*solution.table, *parameters))


def _fit_lag(
    baseline: RegressorBaseline, samples: Samples, axis: int, terms: Sequence[str]
) -> Solution:
    """Fit a first-order lag of one axis by least squares.

    Raises:
        FitError: if the data do not determine it, or it is unstable.
    """
    term_columns = [baseline.library.terms.index(term) for term in terms]
    (fit,) = LeastSquares().fit(
        baseline.library(samples.z)[:, term_columns],
        samples.target[:, [axis]],
        samples.group,
        names=terms,
        outputs=(ACCELERATION_NAMES[axis],),
    )
    slope = float(fit.coefficients[0, 0])
    standard_error = float(fit.standard_errors[0, 0])
    name = VELOCITY_NAMES[axis]
    if slope >= 0:
        raise FitError(
            f"a Nomoto model needs a stable {name}, but the coefficient of {name} in"
            f" {name}_dot is {slope:.2g} +- {standard_error:.1g} 1/s: the vessel is unstable or"
            " barely excited; use a baseline of kind 'regressors' or fit on other `manoeuvres`"
        )
    return fit


def fit_steady_states(
    config: LinearSteadyConfig, baseline: RegressorBaseline, samples: Samples
) -> Solution:
    """Fit the linear model; the notes contain the steady states and Phi (Table 1).

    Raises:
        FitError: if a required kind of manoeuvre is missing.
    """
    tables: dict[str, tuple[Coefficient, ...]] = {}
    steady_constraints: dict[str, dict[str, Any]] = {}
    for block in config.steady_state_blocks():
        # static gain and bias from the steady states, then the dynamics
        means = _steady_means(config, samples, (*block.states, block.input_name))
        design_matrix = torch.stack((means[:, -1], torch.ones_like(means[:, -1])), dim=1)
        (steady_fit,) = LeastSquares().fit(
            design_matrix,
            means[:, :-1],
            torch.arange(len(means)),
            names=(block.input_name, "1"),
            outputs=block.states,
        )
        tables |= _fit_dynamics(samples, block, steady_fit)
        for i, state in enumerate(block.states):
            (value, bias), (standard_error, bias_standard_error) = (
                values[:, i].tolist()
                for values in (steady_fit.coefficients, steady_fit.standard_errors)
            )
            steady_constraints[state] = {
                "of": block.input_name,
                "phi": value,
                "phi_error": standard_error,
            }
            steady_constraints[state] |= {"bias": bias, "bias_error": bias_standard_error}
    tables.setdefault("v", _sway_decay(tables["r"]))
    names = (*VELOCITY_NAMES, config.drive, config.steer)
    steady_states = dict(zip(names, _steady_means(config, samples, names).T.tolist(), strict=True))
    axis_fits = {i: Solution({}, {}, tables[axis]) for i, axis in enumerate(VELOCITY_NAMES)}
    solution = baseline.combine_axis_fits(axis_fits, {})
    return replace(
        solution,
        notes={"steady_states": steady_states, "steady_constraints": steady_constraints},
    )


def _steady_means(config: LinearSteadyConfig, samples: Samples, names: Sequence[str]) -> Tensor:
    """Return the mean channels [M, len(names)] of the steady part of M constant manoeuvres."""
    config.require_steady_manoeuvres(samples.origins)
    steady_samples = samples.select_manoeuvres(config.steady)
    steady_samples = steady_samples.select(steady_samples.t >= config.settled)
    groups, group_index = torch.unique(steady_samples.group, return_inverse=True)
    selected_channels = steady_samples.z[:, [samples.names.index(name) for name in names]]
    group_sums = selected_channels.new_zeros(len(groups), len(names)).index_add_(
        0, group_index, selected_channels
    )
    return group_sums / torch.bincount(group_index)[:, None]


def _fit_dynamics(
    samples: Samples, block: SteadyStateBlock, steady_fit: Solution
) -> dict[str, tuple[Coefficient, ...]]:
    """Fit the dynamics of a block; return the coefficients of each state.

    The order is A, then B = -A Phi and -A Phi_bias. Standard errors are propagated to first
    order under the assumption that the errors of A and Phi are independent.
    """
    dynamic_samples = select_manoeuvres(samples, block.manoeuvre_kinds)
    states = block.states
    phi = steady_fit.coefficients
    phi_standard_error = steady_fit.standard_errors
    states_matrix = torch.stack([dynamic_samples.channel(name) for name in states], dim=1)
    (fit,) = LeastSquares().fit(
        states_matrix - dynamic_samples.channel(block.input_name)[:, None] * phi[0] - phi[1],
        dynamic_samples.target[:, [VELOCITY_NAMES.index(name) for name in states]],
        dynamic_samples.group,
        names=states,
    )
    a = fit.coefficients
    a_standard_error = fit.standard_errors
    # x_dot = A (x - Phi tau - Phi_bias), with A transposed: rows are regressors
    coefficients = torch.cat((a, -phi @ a))
    variance = phi_standard_error.square() @ a.square() + phi.square() @ a_standard_error.square()
    standard_errors = torch.cat((a_standard_error, variance.sqrt()))
    return {
        state: tuple(
            Coefficient(
                f"{state}_dot", term, float(coefficients[j, i]), float(standard_errors[j, i])
            )
            for j, term in enumerate((*states, block.input_name, "1"))
        )
        for i, state in enumerate(states)
    }
