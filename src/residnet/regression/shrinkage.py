"""Cross-validated ridge regression and partial least squares from moments per fold.

Sources: Moreno-Salinas et al. 2019, section 2.2 (ridge regression), and Jervan 2020, section 3.2
(partial least squares). Both misprint equations; see `docs/documents/corrections.md`, M4 and J14 to
J17.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.core.samples import RunningMoments
from residnet.regression.estimator import (
    Estimator,
    EstimatorData,
    Regressors,
    Solution,
    assign_group_folds,
    iterate_chunks,
    require_overdetermined,
)

CONSTANT_TOLERANCE = 1e-9
"""Ratio of standard deviation to maximum magnitude below which a column counts as constant."""
_MIN_LATENT_SUM_OF_SQUARES = 1e-13
"""Minimum sum of squares of a latent variable relative to that of a column.

A smaller latent variable is caused by rounding or by linearly dependent columns.
"""
_EXPLAINED_TOLERANCE = 1e-13
"""Fraction of the initial covariance below which the residual covariance counts as zero."""
_MIN_NORM = 1e-300
"""Lower bound of a norm in a denominator."""
_MAX_CONSECUTIVE_ORDER = 8
"""Order up to which `fit` offers every order; above it, the orders increase by a quarter."""


class CentredMoments(NamedTuple):
    """Central moments of a subset of the samples.

    Attributes:
        n_samples: number of samples.
        mean_x: mean of the shifted x [J].
        mean_y: mean of the shifted y [n].
        xx: X'X of the centred columns [J, J].
        xy: X'Y of the centred columns [J, n].
    """

    n_samples: float
    mean_x: Tensor
    mean_y: Tensor
    xx: Tensor
    xy: Tensor


class FoldMoments:
    """Raw moments [1, X, Y]' [1, X, Y] of each fold, float64.

    The moments need one pass over the data. A training set has the sum of the moments of all folds
    minus the moments of the test fold. X and Y are shifted by their overall means first, which
    avoids cancellation.

    Args:
        sums: moments of each fold [F, 1 + J + n, 1 + J + n].
        shift_x: constants that were subtracted from the columns of x [J].
        shift_y: constants that were subtracted from the columns of y [n].
    """

    def __init__(self, sums: Tensor, shift_x: Tensor, shift_y: Tensor) -> None:
        self.sums = sums
        self.shift_x = shift_x
        self.shift_y = shift_y
        self.n_folds = sums.shape[0]
        self.n_regressors = shift_x.numel()

    @classmethod
    def from_samples(
        cls, x: Regressors, y: Tensor, fold_index: Tensor, n_folds: int
    ) -> FoldMoments:
        """Compute the moments of x [N, J] and y [N, n] with the fold of each sample [N].

        A column that varies by rounding errors only is replaced by zero, so that its coefficient is
        zero instead of huge.
        """
        column_moments = RunningMoments(x.shape[1])
        for _, chunk in iterate_chunks(x):
            column_moments.add_rows(chunk)
        max_abs = torch.maximum(column_moments.minimum.abs(), column_moments.maximum.abs())
        is_constant = column_moments.std(correction=1) <= CONSTANT_TOLERANCE * max_abs
        shift_x = column_moments.mean.masked_fill(is_constant, 0.0)
        shift_y = y.mean(0)
        width = 1 + shift_x.numel() + shift_y.numel()
        sums = torch.zeros(n_folds, width, width, dtype=y.dtype)
        for rows, chunk in iterate_chunks(x):
            outputs_chunk = y[rows]
            fold_chunk = fold_index[rows]
            chunk = chunk.masked_fill(is_constant, 0.0)
            # the product of [1, X, Y] with itself contains counts, means and all second moments
            augmented = torch.cat(
                (torch.ones_like(outputs_chunk[:, :1]), chunk - shift_x, outputs_chunk - shift_y), 1
            )
            sums += torch.stack(
                [augmented[fold_chunk == f].T @ augmented[fold_chunk == f] for f in range(n_folds)]
            )
        return cls(sums, shift_x, shift_y)

    @classmethod
    def from_grouped_samples(
        cls, x: Regressors, y: Tensor, groups: Tensor | None, n_folds: int | None
    ) -> FoldMoments:
        """Compute the moments with groups assigned to folds; one fold if `groups` is None.

        Raises:
            FitError: if there are too few groups, or not more samples than columns.
        """
        fold_index = (
            assign_group_folds(groups, n_folds) if groups is not None else y.new_zeros(len(x))
        )
        require_overdetermined(x, "basis functions")
        return cls.from_samples(x, y, fold_index, int(fold_index.max()) + 1)

    def centre(self, summed_moments: Tensor) -> CentredMoments:
        """Compute central moments from the raw moments of a subset."""
        n_regressors = self.n_regressors
        n_samples = float(summed_moments[0, 0])
        mean = summed_moments[0, 1:] / n_samples
        # the shift by the overall means makes this difference harmless
        cross = summed_moments[1:, 1:] - n_samples * torch.outer(mean, mean)
        return CentredMoments(
            n_samples,
            mean[:n_regressors],
            mean[n_regressors:],
            cross[:n_regressors, :n_regressors],
            cross[:n_regressors, n_regressors:],
        )

    def fold_squared_error(
        self, fold: int, coefficients: Tensor, training_moments: CentredMoments
    ) -> Tensor:
        """Return the sums of squared errors of C models on one fold, [C, n].

        Args:
            fold: number of the test fold.
            coefficients: coefficients of the models [C, J, n].
            training_moments: moments of the training set, which give the intercepts.
        """
        n_regressors = self.n_regressors
        fold_sums = self.sums[fold]
        intercept = training_moments.mean_y - torch.einsum(
            "j,cjk->ck", training_moments.mean_x, coefficients
        )
        weights = torch.cat((intercept[:, None, :], coefficients), dim=1)
        xx = fold_sums[: n_regressors + 1, : n_regressors + 1]
        xy = fold_sums[: n_regressors + 1, n_regressors + 1 :]
        yy = fold_sums[n_regressors + 1 :, n_regressors + 1 :].diagonal()
        # |y - X w|^2 = y'y - 2 w'X'y + w'X'X w, from the moments of the fold alone
        quadratic_form = torch.einsum("cik,ij,cjk->ck", weights, xx, weights)
        return yy - 2 * torch.einsum("cik,ik->ck", weights, xy) + quadratic_form

    def output_variance(self) -> Tensor:
        """Return the variance of each output over all samples [n]."""
        n_regressors = self.n_regressors
        summed_moments = self.sums.sum(0)
        return (
            summed_moments[n_regressors + 1 :, n_regressors + 1 :].diagonal() / summed_moments[0, 0]
        )


class _RegularizationPathEstimator(Estimator):
    """Estimator with an intercept that computes a path of models of increasing complexity.

    A complexity is a ridge penalty or a number of latent variables.

    Args:
        folds: number of folds of the cross-validation; None for a fold per group.
        is_scaled: whether columns are scaled to unit variance; otherwise they are only centred.
        has_alternatives: whether `fit` also returns the other complexities and the intercept-only
            model.
    """

    def __init__(self, *, folds: int | None, is_scaled: bool, has_alternatives: bool) -> None:
        self.folds = folds
        self.is_scaled = is_scaled
        self.has_alternatives = has_alternatives

    @abstractmethod
    def compute_path(self, xx: Tensor, xy: Tensor, n_samples: float) -> Tensor:
        """Return the coefficients [C, J, n] of C complexities from moments of scaled columns."""

    @abstractmethod
    def select_complexities(
        self, errors: Tensor | None, variance: Tensor, n_complexities: int
    ) -> list[list[int]]:
        """Return indices of complexities per output [n], one list per solution, preferred first.

        Args:
            errors: cross-validated mean squared errors [C, n]; None without folds.
            variance: variance of each output [n]; infinite for a constant output.
            n_complexities: number of complexities C.
        """

    @abstractmethod
    def describe_complexity(self, complexities: Sequence[int]) -> dict[str, Any]:
        """Return the hyperparameters of complexities per output.

        An empty sequence gives the hyperparameters of the intercept-only model.
        """

    def fit_notes(self, errors: Tensor, variance: Tensor) -> dict[str, Any]:
        """Return the cross-validated errors [C, n] as notes of the fit."""
        return {"cross_validated_error": errors.tolist()}

    @final
    def _solve(self, data: EstimatorData) -> list[Solution]:
        """Return the solution of minimum cross-validated error, then the alternatives.

        Without groups there is no cross-validation, and the settings must fix the complexity.
        """
        x, y, groups, _, _ = data
        moments = FoldMoments.from_grouped_samples(x, y, groups, self.folds)
        # an infinite variance excludes constant outputs from relative errors
        variance = moments.output_variance()
        is_varying = variance > (CONSTANT_TOLERANCE * moments.shift_y).square()
        variance = torch.where(is_varying, variance, torch.inf)
        notes: dict[str, Any] = {"terms": x.shape[1]}
        n_outputs = y.shape[1]
        zero_state = {
            "coefficients": y.new_zeros(x.shape[1], n_outputs),
            "intercept": y.new_zeros(n_outputs),
        }
        summed_moments = moments.sums.sum(0)
        all_moments = moments.centre(summed_moments)
        # the path of all samples; without groups there are no cross-validated errors
        path = self._fit_path(all_moments)
        errors = None
        if groups is not None:
            # every fold is predicted by the models fitted to the other folds
            training_moments = [
                moments.centre(summed_moments - fold_sums) for fold_sums in moments.sums
            ]
            fold_paths = [
                self._fit_path(fold_training_moments) for fold_training_moments in training_moments
            ]
            # a path may end early, so compare only complexities that every fold has
            n_complexities = min(len(fold_path) for fold_path in fold_paths)
            squared_errors = [
                moments.fold_squared_error(f, fold_path[:n_complexities], fold_training_moments)
                for f, (fold_path, fold_training_moments) in enumerate(
                    zip(fold_paths, training_moments, strict=True)
                )
            ]
            errors = torch.stack(squared_errors).sum(0) / moments.sums[:, 0, 0].sum()
            path = path[:n_complexities]
            notes = self.fit_notes(errors, variance) | notes if n_complexities else notes
        empty_solution = Solution(self.describe_complexity([]), zero_state, notes=notes)
        if len(path) == 0:
            return [empty_solution]
        solutions = []
        for complexities in self.select_complexities(errors, variance, len(path)):
            coefficients = torch.stack(
                [path[i, :, output] for output, i in enumerate(complexities)], dim=1
            )
            intercept = (
                all_moments.mean_y
                + moments.shift_y
                - (all_moments.mean_x + moments.shift_x) @ coefficients
            )
            state = {"coefficients": coefficients, "intercept": intercept}
            solutions.append(Solution(self.describe_complexity(complexities), state, notes=notes))
        return [*solutions, empty_solution] if self.has_alternatives else solutions

    def _fit_path(self, moments: CentredMoments) -> Tensor:
        """Return the coefficients [C, J, n] of all complexities."""
        scale = torch.ones_like(moments.mean_x)
        if self.is_scaled:
            scale = (moments.xx.diagonal() / moments.n_samples).sqrt()
            scale = torch.where(scale > 0, scale, torch.ones_like(scale))
        xx = moments.xx / torch.outer(scale, scale)
        xy = moments.xy / scale[:, None]
        return self.compute_path(xx, xy, moments.n_samples) / scale[None, :, None]


@final
class Ridge(_RegularizationPathEstimator):
    """Ridge regression of every output, with an intercept that is not penalised.

    The intercept-only solution has an empty list of penalties.

    Args:
        penalties: candidate penalties relative to the sum of squares of a standardised column; the
            `alpha` of scikit-learn is the penalty times the number of samples.
        folds: number of folds of the cross-validation; None for a fold per group.
        is_scaled: whether columns are scaled to unit variance; otherwise they are only centred.
        is_shared: whether all outputs have the same penalty, which minimises the sum of errors;
            otherwise the penalty is chosen per output.
        has_alternatives: whether `fit` also returns a solution per penalty, shared by all outputs,
            and the intercept-only solution.
    """

    def __init__(
        self,
        penalties: Sequence[float],
        *,
        folds: int | None = 5,
        is_scaled: bool = True,
        is_shared: bool = False,
        has_alternatives: bool = False,
    ) -> None:
        super().__init__(folds=folds, is_scaled=is_scaled, has_alternatives=has_alternatives)
        self.penalties = tuple(sorted(penalties))
        self.is_shared = is_shared

    def compute_path(self, xx: Tensor, xy: Tensor, n_samples: float) -> Tensor:
        # one eigendecomposition serves all penalties
        eigenvalues, eigenvectors = torch.linalg.eigh(xx / n_samples)
        projected = eigenvectors.T @ xy / n_samples
        penalties = torch.tensor(self.penalties, dtype=xy.dtype)
        shrunk = projected / (eigenvalues.clamp(min=0.0) + penalties[:, None])[..., None]
        path: Tensor = eigenvectors @ shrunk
        return path

    def select_complexities(
        self, errors: Tensor | None, variance: Tensor, n_complexities: int
    ) -> list[list[int]]:
        """Return the penalties of minimum error, then every penalty shared by all outputs."""
        n_outputs = variance.numel()
        if errors is None and n_complexities > 1:
            raise FitError(
                "several penalties need groups for cross-validation; give groups or one penalty"
            )
        errors = variance.new_zeros(1, n_outputs) if errors is None else errors
        best_indices = (
            [int(errors.sum(1).argmin())] * n_outputs
            if self.is_shared
            else errors.argmin(0).tolist()
        )
        return [
            best_indices,
            *([i] * n_outputs for i in range(n_complexities) if self.has_alternatives),
        ]

    def describe_complexity(self, complexities: Sequence[int]) -> dict[str, Any]:
        return {"penalty": [self.penalties[i] for i in complexities]}


@final
class PLSR(_RegularizationPathEstimator):
    """Partial least squares with several outputs (PLS2) and an intercept.

    Outputs without covariance with the columns get the solution of order 0, without coefficients.

    Args:
        order: number of latent variables; None for the minimum of the cross-validated error, which
            is the mean over the outputs relative to their variances.
        max_order: highest candidate order; None for the number of columns.
        folds: number of folds of the cross-validation; None for a fold per group.
        is_scaled: whether columns are scaled to unit variance; otherwise they are only centred.
        has_alternatives: whether `fit` also returns other orders and the solution of order 0.
    """

    def __init__(
        self,
        order: int | None = None,
        *,
        max_order: int | None = 40,
        folds: int | None = 5,
        is_scaled: bool = True,
        has_alternatives: bool = False,
    ) -> None:
        super().__init__(folds=folds, is_scaled=is_scaled, has_alternatives=has_alternatives)
        self.order = order
        self.max_order = max_order

    def compute_path(self, xx: Tensor, xy: Tensor, n_samples: float) -> Tensor:
        return pls_path(xx, xy, min(self.order or self.max_order or len(xx), len(xx)))

    def select_complexities(
        self, errors: Tensor | None, variance: Tensor, n_complexities: int
    ) -> list[list[int]]:
        """Return the fixed order or that of minimum error, then alternative orders."""
        n_outputs = variance.numel()
        order = n_complexities
        if self.order is not None:
            order = min(self.order, n_complexities)
        elif errors is None:
            raise FitError(
                "choosing the order needs groups for cross-validation; give groups or `order`"
            )
        else:
            order = int((errors / variance).mean(1).argmin()) + 1
        orders = [order]
        if self.has_alternatives:
            # every low order, then orders that increase by a quarter
            alternative_orders = [1]
            while alternative_orders[-1] < n_complexities:
                next_order = (
                    alternative_orders[-1] * 5 // 4
                    if alternative_orders[-1] >= _MAX_CONSECUTIVE_ORDER
                    else alternative_orders[-1] + 1
                )
                alternative_orders.append(min(next_order, n_complexities))
            orders += alternative_orders
        return [[k - 1] * n_outputs for k in orders]

    def describe_complexity(self, complexities: Sequence[int]) -> dict[str, Any]:
        return {"order": complexities[0] + 1 if complexities else 0}

    def fit_notes(self, errors: Tensor, variance: Tensor) -> dict[str, Any]:
        """Return the cross-validated error per order, the mean over outputs of error / variance."""
        return {"cross_validated_share": (errors / variance).mean(1).tolist()}


def pls_path(
    xx: Tensor,
    xy: Tensor,
    orders: int | Tensor,
    *,
    is_joint: bool = True,
    mask: Tensor | None = None,
) -> Tensor:
    """Compute the coefficients of partial least squares for every order, [A, ..., J, K].

    This is the kernel algorithm of Dayal and MacGregor (1997), which needs moments only. The path
    ends early if the residual covariance or the next latent variable is zero.

    Args:
        xx: X'X of centred, scaled columns [..., J, J].
        xy: X'Y [..., J, K].
        orders: number of latent variables; or the number for each column of xy, ascending, [K].
        is_joint: whether the columns of xy are the outputs of one model (PLS2); otherwise every
            column has its own model (PLS1).
        mask: 1 for the regressors of each model, 0 for the others, [J, K].
    """
    residual_covariance = xy if mask is None else xy * mask
    min_covariance = _EXPLAINED_TOLERANCE * torch.linalg.vector_norm(
        residual_covariance, dim=(-2, -1) if is_joint else -2
    )
    min_sum_of_squares = _MIN_LATENT_SUM_OF_SQUARES * float(xx.diagonal(dim1=-2, dim2=-1).max())
    loadings: list[Tensor] = []
    rotations: list[Tensor] = []
    path_coefficients = torch.zeros_like(xy)
    path = []
    for order in range(orders if isinstance(orders, int) else int(orders.max())):
        # orders ascend: the columns before `first_active` have all their latent variables
        first_active = 0 if isinstance(orders, int) else int((orders <= order).sum())
        active_covariance = residual_covariance[..., first_active:]
        if is_joint:
            left_vectors, singular_values, _ = torch.linalg.svd(
                active_covariance, full_matrices=False
            )
            # PLS2: the weights are the dominant left singular vector of the residual covariance
            r = w = left_vectors[..., :1]
            is_active = singular_values[..., :1] > min_covariance
        else:
            norm = torch.linalg.vector_norm(active_covariance, dim=-2, keepdim=True)
            # PLS1: the weights are the normalised covariance
            r = w = active_covariance / norm.clamp(min=_MIN_NORM)
            is_active = norm > min_covariance[..., None, first_active:]
        # rotate the weights so that they apply to the undeflated columns
        for previous_loading, previous_rotation in zip(loadings, rotations, strict=True):
            r = (
                r
                - (previous_loading[..., first_active:] * w).sum(-2, keepdim=True)
                * previous_rotation[..., first_active:]
            )
        gram_rotation = xx @ r if mask is None else (xx @ r) * mask[..., first_active:]
        # squared norm of the next latent variable X r
        sum_of_squares = (r * gram_rotation).sum(-2, keepdim=True)
        is_active = is_active & (sum_of_squares > min_sum_of_squares)
        if not bool(is_active.any()):
            break
        # loadings, coefficients and deflation; models that have converged do not change
        divisor = torch.where(is_active, sum_of_squares, 1.0)
        y_loading = torch.where(
            is_active, (r * active_covariance).sum(-2, keepdim=True) / divisor, 0.0
        )
        p = torch.where(is_active, gram_rotation / divisor, 0.0)
        path_coefficients = torch.cat(
            (
                path_coefficients[..., :first_active],
                path_coefficients[..., first_active:] + r * y_loading,
            ),
            dim=-1,
        )
        residual_covariance = torch.cat(
            (
                residual_covariance[..., :first_active],
                active_covariance - p * (y_loading * sum_of_squares),
            ),
            dim=-1,
        )
        padding = torch.zeros_like(xy[..., : 0 if is_joint else first_active])
        loadings.append(torch.cat((padding, p), dim=-1))
        rotations.append(torch.cat((padding, r), dim=-1))
        path.append(path_coefficients)
    return torch.stack(path) if path else xy.new_zeros(0, *xy.shape)
