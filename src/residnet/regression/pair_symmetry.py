"""Likelihood-ratio test that a port and a starboard input act as mirror images of each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

SIGN_LEVEL = 0.05
"""Significance level of the test for a wrong sign."""
GAIN_LEVEL = 0.001
"""Significance level of the test for different gains.

Gains are tested at a stricter level than usual, because the linear model is only approximately that
of a vessel and its errors change a gain slightly, but never a sign.
"""
_MAX_ROWS = 20_000
"""Number of rows above which rows are subsampled."""
_MAX_RATIO = 4.0
"""Largest ratio of gains that is searched; a larger one is a failed actuator."""
_N_RATIOS = 25
"""Number of ratios of gains in the grid search, spaced logarithmically."""
_MIN_LOG_INTERVAL = 1e-3
"""Interval of the logarithm of a ratio at which its search ends."""
_MIN_ASTERN_SHARE = 0.05
"""Share of samples of each sign from which thrust astern has coefficients of its own.

With one sign only, the functions n and |n| are the same up to the sign, and a pair with a reversed
input could not be distinguished from a symmetric one.
"""
_EIGENVALUE_RATIO = 1e-9
"""Eigenvalues below this share of the largest one count as zero."""


@dataclass(frozen=True)
class PairSymmetry:
    """Result of the test of one pair of inputs.

    Attributes:
        port: name of the port input.
        starboard: name of the starboard input.
        p_value: probability of such a likelihood ratio for a symmetric pair.
        ratio: factor of the starboard input that makes the pair symmetric, with the largest
            likelihood.
        p_value_with_sign: p-value if the starboard input has the sign of `ratio`.
        surge_signs: signs of the surge gains of port and starboard.
    """

    port: str
    starboard: str
    p_value: float
    ratio: float
    p_value_with_sign: float
    surge_signs: tuple[float, float]

    @property
    def is_symmetric(self) -> bool:
        """Whether the data do not contradict the symmetry."""
        return self.p_value >= (SIGN_LEVEL if self.ratio < 0.0 else GAIN_LEVEL)

    @property
    def is_symmetric_with_sign(self) -> bool:
        """Whether the data do not contradict the symmetry once a wrong sign is corrected."""
        return self.p_value_with_sign >= GAIN_LEVEL

    @property
    def reversed_input(self) -> str:
        """Name of the input with the wrong sign; empty if there is none."""
        if self.is_symmetric or self.ratio > 0.0:
            return ""
        return self.port if self.surge_signs[0] < self.surge_signs[1] else self.starboard

    @property
    def proposal(self) -> str:
        """Clause with the sign and gain that make the pair symmetric; empty if it is."""
        if self.is_symmetric:
            return ""
        texts = [f"reverse the sign of {self.reversed_input}"] if self.reversed_input else []
        if not self.is_symmetric_with_sign:
            texts.append(f"multiply {self.starboard} by {abs(self.ratio):.2f}")
        return " and ".join(texts)

    @property
    def description(self) -> str:
        """One line: the result of the test and the proposal."""
        return (
            f"{self.port} and {self.starboard} do not act as mirror images of each other"
            f" (likelihood-ratio test, p = {self.p_value:.1g}): {self.proposal}"
        )


def assess_pair_symmetry(
    pair: tuple[str, str],
    names: Sequence[str],
    channels: np.ndarray,
    accelerations: np.ndarray,
    group: np.ndarray,
    state_names: Sequence[str],
    axis_parities: Sequence[int],
    pair_parity: int,
) -> PairSymmetry:
    """Test whether two inputs have mirrored effects, by a model linear in its coefficients.

    Each acceleration is a linear combination of a constant, velocities and their products, other
    inputs, and three to five functions of each of the two inputs. If the starboard input,
    multiplied by a ratio, is the mirror image of the port input, its coefficients follow from those
    of port: equal in surge, opposite in sway and yaw for propellers. The hypothesis is that the
    ratio is 1, and the alternative that it is any number. A reversed motor has a ratio of -1.

    The deviance of a ratio is the sum over axes of n log(SSR_ratio / SSR_free), where the free
    model has independent coefficients and n is the effective number of samples, since residuals are
    autocorrelated. The difference of the deviances has a chi-squared distribution with one degree
    of freedom (Wilks 1938). It is divided by the dispersion, the deviance of the best ratio per
    degree of freedom, since the model is not exact (McCullagh and Nelder 1989, section 4.5.2).

    Args:
        pair: names of the port and the starboard input.
        names: names of the channels.
        channels: velocities and inputs [N, nz].
        accelerations: rates of change of the velocities [N, n].
        group: log of each sample [N], ascending.
        state_names: names of the velocities [n].
        axis_parities: +1 if the mirror image of a velocity has the same sign, else -1, [n].
        pair_parity: +1 if inputs are exchanged with equal sign (propellers), -1 for angles.
    """
    stride = -(-len(channels) // _MAX_ROWS)
    channels = channels[::stride]
    accelerations = accelerations[::stride]
    group = group[::stride]
    columns = {
        name: channels[:, k] / (float(np.sqrt(np.mean(channels[:, k] ** 2))) or 1.0)
        for k, name in enumerate(names)
    }
    unit = float(np.sqrt(np.mean(channels[:, [names.index(name) for name in pair]] ** 2))) or 1.0
    port, starboard = (channels[:, names.index(name)] / unit for name in pair)
    surge = columns["u"] if "u" in state_names else np.ones(len(channels))
    nuisance = _make_nuisance_regressors(columns, state_names, pair)
    sign_shares = [np.mean(sign * values > 0.0) for values in (port, starboard) for sign in (1, -1)]
    is_reversing = bool(min(sign_shares) >= _MIN_ASTERN_SHARE)
    port_functions = _input_functions(port, surge, is_reversing=is_reversing)
    starboard_functions = _input_functions(
        pair_parity * starboard, surge, is_reversing=is_reversing
    )
    design = np.hstack((nuisance, port_functions, starboard_functions))
    gram = design.T @ design

    axes = [k for k in range(len(state_names)) if np.ptp(accelerations[:, k]) > 0.0]
    free_fits = {}
    n_effective = {}
    for k in axes:
        response = accelerations[:, k]
        moments = design.T @ response
        fit = _fit_from_moments(gram, moments, float(response @ response))
        free_fits[k] = (fit, moments, float(response @ response))
        n_samples = _effective_sample_size(response - design @ fit.coefficients, group)
        n_effective[k] = max(n_samples - fit.rank, 0.0)

    n_functions = port_functions.shape[1]
    identity = np.eye(nuisance.shape[1] + n_functions)

    def compute_deviance(ratio: float) -> tuple[float, int]:
        """Return the deviance of a ratio and its degrees of freedom."""
        # the functions are homogeneous: those of a multiple are multiples of the functions
        factors = _input_functions(np.array([ratio]), np.ones(1), is_reversing=is_reversing)[0]
        deviance = 0.0
        degrees_of_freedom = 0
        for k in axes:
            mirrored_rows = np.zeros((n_functions, len(identity)))
            mirrored_rows[:, -n_functions:] = axis_parities[k] * np.diag(factors)
            constraint = np.vstack((identity, mirrored_rows))
            free_fit, moments, total = free_fits[k]
            fit = _fit_from_moments(constraint.T @ gram @ constraint, constraint.T @ moments, total)
            deviance += n_effective[k] * np.log(
                max(fit.sum_of_squares / free_fit.sum_of_squares, 1.0)
            )
            degrees_of_freedom += free_fit.rank - fit.rank
        return float(deviance), degrees_of_freedom

    ratio = _minimize_over_ratios(lambda ratio: compute_deviance(ratio)[0])
    smallest_deviance, degrees_of_freedom = compute_deviance(ratio)
    dispersion = max(smallest_deviance / max(degrees_of_freedom - 1, 1), 1.0)

    def compute_p_value(tested_ratio: float) -> float:
        difference = max(compute_deviance(tested_ratio)[0] - smallest_deviance, 0.0)
        # survival function of chi-squared with one degree of freedom
        return math.erfc(math.sqrt(0.5 * difference / dispersion))

    surge_signs = (1.0, 1.0)
    if "u" in state_names:
        surge_acceleration = accelerations[:, list(state_names).index("u")]
        surge_signs = _estimate_gain_signs(port, starboard, nuisance, surge_acceleration)
    p_value_with_sign = compute_p_value(float(np.sign(ratio)))
    return PairSymmetry(*pair, compute_p_value(1.0), ratio, p_value_with_sign, surge_signs)


def _estimate_gain_signs(
    port: np.ndarray, starboard: np.ndarray, nuisance: np.ndarray, acceleration: np.ndarray
) -> tuple[float, float]:
    """Return the signs of the least-squares gains of two inputs [N] in an acceleration [N]."""
    design = np.column_stack((port, starboard, nuisance))
    gains = np.linalg.lstsq(design, acceleration)[0]
    return float(np.sign(gains[0])), float(np.sign(gains[1]))


def _minimize_over_ratios(compute_deviance: Callable[[float], float]) -> float:
    """Return the ratio, positive or negative, with the smallest deviance."""
    log_limit = float(np.log(_MAX_RATIO))
    candidates = [
        sign * float(np.exp(log_size))
        for sign in (1.0, -1.0)
        for log_size in np.linspace(-log_limit, log_limit, _N_RATIOS)
    ]
    start = min(candidates, key=compute_deviance)
    sign = float(np.sign(start))
    spacing = 2.0 * log_limit / (_N_RATIOS - 1)
    log_size = _minimize_by_golden_section(
        lambda log_size: compute_deviance(sign * math.exp(log_size)),
        math.log(abs(start)) - spacing,
        math.log(abs(start)) + spacing,
    )
    return sign * math.exp(log_size)


def _minimize_by_golden_section(
    objective: Callable[[float], float], lower: float, upper: float
) -> float:
    """Return the minimum of a unimodal function (Kiefer 1953); scipy.optimize is slow to import."""
    section = 0.5 * (math.sqrt(5.0) - 1.0)
    left = upper - section * (upper - lower)
    right = lower + section * (upper - lower)
    left_value = objective(left)
    right_value = objective(right)
    while upper - lower > _MIN_LOG_INTERVAL:
        if left_value < right_value:
            upper = right
            right = left
            right_value = left_value
            left = upper - section * (upper - lower)
            left_value = objective(left)
        else:
            lower = left
            left = right
            left_value = right_value
            right = lower + section * (upper - lower)
            right_value = objective(right)
    return 0.5 * (lower + upper)


@dataclass(frozen=True)
class _LeastSquaresFit:
    """A least-squares fit.

    Attributes:
        coefficients: coefficients [p].
        sum_of_squares: sum of squared residuals.
        rank: rank of the regressors.
    """

    coefficients: np.ndarray
    sum_of_squares: float
    rank: int


def _fit_from_moments(gram: np.ndarray, moments: np.ndarray, total: float) -> _LeastSquaresFit:
    """Return the fit with the smallest norm from X'X [p, p], X'y [p] and y'y."""
    norms = np.sqrt(np.maximum(np.diag(gram), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(norms, norms))
    is_positive = eigenvalues > _EIGENVALUE_RATIO * eigenvalues[-1]
    projections = vectors[:, is_positive].T @ (moments / norms)
    coefficients = vectors[:, is_positive] @ (projections / eigenvalues[is_positive]) / norms
    explained = float((projections**2 / eigenvalues[is_positive]).sum())
    return _LeastSquaresFit(
        coefficients, max(total - explained, 1e-12 * total), int(is_positive.sum())
    )


def _input_functions(values: np.ndarray, surge: np.ndarray, *, is_reversing: bool) -> np.ndarray:
    """Return functions of an input [N, 3 or 5]: thrust and its loss by the inflow.

    With `is_reversing` the thrust astern differs from that ahead.
    """
    size = np.abs(values)
    functions = [values, values * size, size * surge]
    return np.column_stack([*functions, size, size**2] if is_reversing else functions)


def _make_nuisance_regressors(
    columns: dict[str, np.ndarray], state_names: Sequence[str], pair: tuple[str, str]
) -> np.ndarray:
    """Return a constant, velocities, their products, and other channels [N, p]."""
    velocities = [columns[name] for name in state_names]
    regressors = [np.ones_like(columns[pair[0]]), *velocities]
    for i, first in enumerate(velocities):
        for j, second in enumerate(velocities):
            regressors.append(first * np.abs(second))
            if j >= i:
                regressors.append(first * second)
    for name, values in columns.items():
        if name not in (*pair, *state_names):
            regressors += [values, values * np.abs(values)]
    return np.column_stack(regressors)


def _effective_sample_size(residuals: np.ndarray, group: np.ndarray) -> float:
    """Return the number of independent samples with the information of autocorrelated residuals.

    The integrated autocorrelation time sums the autocorrelations up to the first negative one
    (Geyer 1992), pooled over logs.
    """
    segments = np.split(residuals, np.flatnonzero(np.diff(group)) + 1)
    variance = max(float(residuals @ residuals), 1e-300)
    autocorrelation_time = 1.0
    for lag in range(1, max(len(segment) for segment in segments)):
        covariance = sum(
            float(segment[lag:] @ segment[:-lag]) for segment in segments if len(segment) > lag
        )
        if covariance <= 0.0:
            break
        autocorrelation_time += 2.0 * covariance / variance
    return len(residuals) / autocorrelation_time
