"""Linear least squares with cluster-robust standard errors, and Levenberg-Marquardt descent."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import (
    Coefficient,
    Estimator,
    EstimatorData,
    Regressors,
    Solution,
    assign_group_folds,
    iterate_chunks,
    require_overdetermined,
    to_dense,
)

_COLLINEARITY_TOLERANCE = 1e-9
"""Ratio to the largest singular value below which centred columns count as collinear."""
_MIN_COLLINEAR_LOADING = 0.1
"""Loading in the smallest singular vector, relative to the largest one, above which an error
message lists a column as collinear.
"""
_INTERCEPT = "1"
"""Name of the column of ones."""
_ROUNDING_FACTOR = 10
"""Largest rounding error of a zero eigenvalue of a Gram matrix, relative to its largest
eigenvalue, in units of the number of columns times the machine precision.
"""
_MIN_EIGENVALUE = 1e-300
"""Lower bound of the eigenvalue in the denominator of a condition number."""
_N_PENALTIES = 40
"""Number of penalties on the regularisation path of scikit-learn's elastic net."""
_MAX_ITERATIONS = 3000
"""Maximum number of coordinate-descent iterations per penalty."""
_TOLERANCE = 1e-4
"""Duality gap at which coordinate descent ends."""
_MIN_DAMPING = 1e-8
"""Smallest damping other than zero. Its effect on a step is negligible."""
_MAX_DAMPING_TRIALS = 8
"""Number of dampings tried without a decrease before a point counts as the minimum."""

Point = TypeVar("Point")


@final
class LeastSquares(Estimator):
    """Ordinary least squares without intercept, or with relative ridge penalties.

    Columns are scaled to unit root mean square first, so that a penalty is relative to the sum of
    squares of each column. Standard errors are cluster-robust over groups (Liang and Zeger 1986),
    because residuals at 10-20 Hz are strongly correlated and the formula for independent residuals
    underestimates the errors several times. With fewer than two groups that formula is used.

    Args:
        penalties: relative ridge penalties, 0 for ordinary least squares. `fit` returns one
            solution per penalty; all are computed from the same Gram matrix.
    """

    def __init__(self, penalties: Sequence[float] = (0.0,)) -> None:
        self.penalties = tuple(penalties)

    def _solve(self, data: EstimatorData) -> list[Solution]:
        x, y, groups, names, outputs = data
        n_samples, n_columns = x.shape
        require_overdetermined(x, f"coefficients ({', '.join(names)})")
        scale = _sum_over_chunks(x, lambda _, chunk: chunk.square().sum(0)).div(n_samples).sqrt()
        if bool((scale <= 0).any()):
            zero_columns = [
                name
                for name, column_scale in zip(names, scale.tolist(), strict=True)
                if column_scale <= 0
            ]
            raise FitError(
                f"regressor '{zero_columns[0]}' is zero in all {n_samples} samples, so its"
                " coefficient is not identifiable; remove the regressor or record data that"
                " excite it"
            )
        # two passes over the data give the normal equations of the scaled columns
        gram = _sum_over_chunks(x, lambda _, chunk: (chunk / scale).T @ (chunk / scale)) / n_samples
        cross_moments = (
            _sum_over_chunks(x, lambda rows, chunk: (chunk / scale).T @ y[rows]) / n_samples
        )
        # an eigenvalue at rounding level means collinear columns; report the two largest loadings
        eigenvalues, eigenvectors = torch.linalg.eigh(gram)
        condition = float(torch.sqrt(eigenvalues[-1] / eigenvalues[0].clamp(min=_MIN_EIGENVALUE)))
        rounding_error = (
            _ROUNDING_FACTOR * len(names) * torch.finfo(gram.dtype).eps * float(eigenvalues[-1])
        )
        if float(eigenvalues[0]) + min(self.penalties) < rounding_error:
            loadings = eigenvectors[:, 0].abs()
            order = loadings.argsort(descending=True).tolist()
            collinear_names = [names[i] for i in order[:2]]
            is_pair = bool(loadings[order[2:]].le(_MIN_COLLINEAR_LOADING * loadings.max()).all())
            if is_pair and _INTERCEPT in collinear_names:
                collinear_names.remove(_INTERCEPT)
                raise FitError(
                    f"regressor '{collinear_names[0]}' is constant on these data, so its effect is"
                    f" not identifiable (condition number {condition:.1e}); move an input that the"
                    " training logs hold from `inputs` to `unexcited`, train on logs that vary it,"
                    " or set a ridge penalty"
                )
            raise FitError(
                f"regressors '{collinear_names[0]}' and '{collinear_names[1]}' are collinear on"
                f" these data (condition number {condition:.1e}); remove one, excite them"
                " separately, or set a ridge penalty"
            )
        solutions = []
        for penalty in self.penalties:
            # sandwich estimator of the covariance, in the units of the unscaled columns
            inverse = torch.linalg.inv(gram + penalty * torch.eye(n_columns, dtype=y.dtype))
            coefficients = inverse @ cross_moments
            score_covariance = _score_covariance(x, y, scale, coefficients, gram, groups)
            covariance = (
                inverse @ score_covariance @ inverse / n_samples**2 / torch.outer(scale, scale)
            )
            solution = Solution(
                {"ridge": penalty} if len(self.penalties) > 1 else {},
                {"coefficients": coefficients / scale[:, None]},
                notes={"condition": condition},
                covariance=covariance,
            )
            estimates = solution.coefficients.tolist()
            standard_errors = solution.standard_errors.tolist()
            table = tuple(
                Coefficient(output, name, estimates[j][k], standard_errors[j][k])
                for k, output in enumerate(outputs)
                for j, name in enumerate(names)
            )
            solutions.append(replace(solution, table=table))
        return solutions


@final
class CentredLeastSquares(Estimator):
    """Ordinary least squares with an intercept, from a QR factorisation of the centred columns.

    The QR factor of nearly collinear columns has twice the significant digits of their Gram matrix.
    """

    def _solve(self, data: EstimatorData) -> list[Solution]:
        x = to_dense(data.x)
        y = data.y
        names = data.names
        require_overdetermined(x, "basis functions")
        mean_x = x.mean(0)
        mean_y = y.mean(0)
        x_centred = x - mean_x
        y_centred = y - mean_y
        _, singular_values, right_vectors = torch.linalg.svd(x_centred, full_matrices=False)
        if float(singular_values[-1]) <= _COLLINEARITY_TOLERANCE * float(singular_values[0]):
            loadings = right_vectors[-1].abs()
            collinear_columns = (
                (loadings > _MIN_COLLINEAR_LOADING * loadings.max()).nonzero()[:, 0].tolist()
            )
            raise FitError(
                f"basis functions {', '.join(names[j] for j in collinear_columns)} are collinear on"
                " these samples; remove one, or use ridge or plsr"
            )
        coefficients = torch.linalg.lstsq(x_centred, y_centred).solution
        state = {"coefficients": coefficients, "intercept": mean_y - mean_x @ coefficients}
        return [
            Solution(
                {}, state, notes={"condition": float(singular_values[0] / singular_values[-1])}
            )
        ]


@final
class ElasticNet(Estimator):
    """Elastic net with an intercept, fitted per output, its penalty chosen by cross-validation.

    Columns are not scaled; the caller scales them.

    Args:
        l1_ratio: share of the L1 penalty, above 0; 1 is the lasso.
        folds: number of folds of the cross-validation; None for a fold per group.
    """

    def __init__(self, l1_ratio: float = 1.0, *, folds: int | None = None) -> None:
        self.l1_ratio = l1_ratio
        self.folds = folds

    def _solve(self, data: EstimatorData) -> list[Solution]:
        # scikit-learn takes a second to import
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.linear_model import ElasticNetCV

        x, y = to_dense(data.x), data.y
        fold_index = assign_group_folds(data.groups, self.folds)
        # scikit-learn accepts indices of training and test samples
        cv_splits = [
            ((fold_index != k).nonzero()[:, 0].numpy(), (fold_index == k).nonzero()[:, 0].numpy())
            for k in range(int(fold_index.max()) + 1)
        ]
        coefficients = []
        intercepts = []
        penalties = []
        for output in range(y.shape[1]):
            elastic_net = ElasticNetCV(
                l1_ratio=self.l1_ratio,
                cv=cv_splits,
                alphas=_N_PENALTIES,
                max_iter=_MAX_ITERATIONS,
                tol=_TOLERANCE,
            )
            with warnings.catch_warnings():
                # the smallest penalties of the path need not converge: cross-validation does not
                # select them
                warnings.simplefilter("ignore", ConvergenceWarning)
                elastic_net.fit(x.numpy(), y[:, output].numpy())
            coefficients.append(torch.from_numpy(elastic_net.coef_))
            intercepts.append(float(elastic_net.intercept_))
            penalties.append(float(elastic_net.alpha_))
        state = {
            "coefficients": torch.stack(coefficients, dim=1),
            "intercept": torch.tensor(intercepts, dtype=y.dtype),
        }
        return [Solution({"alpha": penalties}, state)]


def _score_covariance(
    x: Regressors,
    y: Tensor,
    scale: Tensor,
    coefficients: Tensor,
    gram: Tensor,
    groups: Tensor | None,
) -> Tensor:
    """Return the covariance [n, J, J] of the score of each output.

    The score is the sum over samples of the scaled columns x / scale times the residual. With at
    least two groups its covariance is estimated from the sums of each group; otherwise residuals
    are assumed independent.

    Args:
        x: columns [N, J].
        y: outputs [N, n].
        scale: root mean square of each column [J].
        coefficients: coefficients of the scaled columns [J, n].
        gram: mean outer product of the scaled columns [J, J].
        groups: group of each sample [N]; None for independent residuals.
    """
    n_samples, n_columns = x.shape
    n_outputs = y.shape[1]
    n_groups = 0
    if groups is not None:
        unique_groups, group_index = torch.unique(groups, return_inverse=True)
        n_groups = int(unique_groups.numel())
    if n_groups < 2:
        residual_sum_of_squares = _sum_over_chunks(
            x, lambda rows, chunk: (y[rows] - chunk / scale @ coefficients).square().sum(0)
        )
        return gram * (residual_sum_of_squares / (n_samples - n_columns) * n_samples)[:, None, None]
    group_scores = torch.zeros(n_outputs, n_groups, n_columns, dtype=y.dtype)
    for rows, chunk in iterate_chunks(x):
        scaled_columns = chunk / scale
        residual = y[rows] - scaled_columns @ coefficients
        for k in range(n_outputs):
            group_scores[k].index_add_(0, group_index[rows], scaled_columns * residual[:, [k]])
    # small-sample correction G / (G - 1) of the cluster-robust estimator
    return group_scores.transpose(1, 2) @ group_scores * n_groups / (n_groups - 1)


def _sum_over_chunks(x: Regressors, contribution: Callable[[slice, Tensor], Tensor]) -> Tensor:
    """Return the sum of `contribution(rows, chunk)` over the chunks of x [N, J].

    A chunk has the regressors at a slice of rows. Chunks bound the memory of lazy regressors.
    """
    chunks = iter(iterate_chunks(x))
    rows, chunk = next(chunks)
    total = contribution(rows, chunk)
    for rows, chunk in chunks:
        total = total + contribution(rows, chunk)
    return total


@dataclass(frozen=True)
class DescentResult(Generic[Point]):
    """The minimiser of a descent and its number of accepted steps."""

    minimizer: Point
    n_steps: int


def minimize_levenberg_marquardt(
    initial_point: Point,
    linearize: Callable[[Point], tuple[float, Callable[[float], tuple[float, Point]]]],
    max_iterations: int,
    *,
    min_relative_decrease: float,
    damping: float = 1e-3,
) -> DescentResult[Point]:
    """Minimise a cost by the Levenberg-Marquardt method.

    Args:
        initial_point: starting point, of any type that `linearize` accepts.
        linearize: linearises the problem at a point. Returns the cost at the point, and a function
            from a damping to the cost and the point after the damped step.
        max_iterations: maximum number of accepted steps.
        min_relative_decrease: relative decrease of the cost below which the descent ends.
        damping: damping of the first step in units of the diagonal of the Hessian. It is divided
            by ten after a step that decreases the cost and multiplied by ten after a step that does
            not. With 0 the steps are Gauss-Newton steps while these decrease the cost.
    """
    point = initial_point
    n_steps = 0
    while n_steps < max_iterations:
        cost, try_step = linearize(point)
        for _ in range(_MAX_DAMPING_TRIALS):
            trial_cost, trial_point = try_step(damping)
            if math.isfinite(trial_cost) and trial_cost < cost:
                break
            damping = max(10.0 * damping, _MIN_DAMPING)
        else:
            break
        point = trial_point
        n_steps = n_steps + 1
        # a damping of zero stays zero: Gauss-Newton
        damping = max(damping / 10.0, min(damping, _MIN_DAMPING))
        if cost - trial_cost < min_relative_decrease * abs(cost):
            break
    return DescentResult(point, n_steps)
