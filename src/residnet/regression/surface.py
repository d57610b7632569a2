"""Surface analysis: PLSR by model order and number of basis functions.

Backward elimination removes the basis function with the smallest coefficient until two remain
(Jervan 2020, section 4.5).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, final

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.estimator import (
    Estimator,
    EstimatorData,
    Solution,
    assign_group_folds,
    to_dense,
)
from residnet.regression.shrinkage import CONSTANT_TOLERANCE, FoldMoments, pls_path


@dataclass(frozen=True)
class ErrorSurface:
    """Errors of each output by model order and number of basis functions.

    Attributes:
        error: mean squared error [K, A, J + 1] of output k with a + 1 latent variables and j basis
            functions; NaN if the model does not exist (fewer basis functions than latent
            variables, or fewer than two).
        standard_error: standard error of that mean over the folds, [K, A, J + 1]; NaN with one
            fold.
        removal: indices of basis functions in the order of their removal, [K, A, J]; padded by -1.
    """

    error: Tensor
    standard_error: Tensor
    removal: Tensor

    def retained_columns(self, output: int, order: int, n_terms: int) -> list[int]:
        """Return the indices of the last `n_terms` basis functions of a model order (from 1)."""
        removed = self.removal[output, order - 1, : self.removal.shape[2] - n_terms].tolist()
        return [j for j in range(self.removal.shape[2]) if j not in removed]

    def minimum_error_model(self, output: int) -> tuple[int, int]:
        """Return (order, number of terms) of the minimum error of an output, as Jervan 2020 does.

        The estimate of the error is optimistic if the same folds also evaluate the result.
        """
        errors = torch.nan_to_num(self.error[output], nan=torch.inf).flatten()
        order_index, n_terms = divmod(int(errors.argmin()), self.error.shape[2])
        return order_index + 1, n_terms

    def one_standard_error_model(self, output: int) -> tuple[int, int]:
        """Return (order, number of terms) of the simplest model within one standard error.

        This is Breiman's one-standard-error rule. The simplest model is that of the lowest order
        and, within this order, of the most basis functions: a low order shrinks the coefficients,
        while removing basis functions does not. The minimum error of some 450 models is biased by
        selection, and high orders on few nearly collinear columns extrapolate badly.
        """
        order, n_terms = self.minimum_error_model(output)
        error_limit = self.error[output, order - 1, n_terms] + torch.nan_to_num(
            self.standard_error[output, order - 1, n_terms]
        )
        is_within_limit = torch.nan_to_num(self.error[output], nan=torch.inf) <= error_limit
        order_index = int(is_within_limit.any(1).nonzero()[0, 0])
        return order_index + 1, int(is_within_limit[order_index].nonzero()[-1, 0])


def compute_error_surface(
    moments: FoldMoments, test_folds: Sequence[int] = (), max_order: int | None = None
) -> ErrorSurface:
    """Compute the errors of all models of the surface from moments, in one batch.

    At every model order the basis function with the smallest absolute standardised coefficient is
    removed, until the number of basis functions equals the order or two.

    Args:
        moments: moments per fold of basis functions [N, J] and outputs [N, K].
        test_folds: folds on which the models are evaluated. Fit and elimination use the other
            folds. If empty, the errors are cross-validated over all folds.
        max_order: highest model order; None for the number of basis functions.

    Raises:
        FitError: if a basis function is constant, or fewer than two are given.
    """
    equations = _NormalEquations.gather(moments, test_folds)
    n_outputs = equations.covariance.shape[2]
    n_columns = equations.gram.shape[1]
    n_orders = min(max_order or n_columns, n_columns)
    output_index = torch.arange(n_outputs).repeat(n_orders)
    order_of_model = torch.arange(1, n_orders + 1).repeat_interleave(n_outputs)
    mask = torch.ones(n_columns, n_orders * n_outputs, dtype=torch.float64)
    mean_squared_error, standard_error = (
        torch.full((n_columns + 1, n_orders * n_outputs), torch.nan, dtype=torch.float64)
        for _ in range(2)
    )
    removal = torch.full((n_columns, n_orders * n_outputs), -1, dtype=torch.long)
    for n_terms in range(n_columns, 1, -1):
        # columns are sorted by order: the orders up to `n_terms` come first
        n_active = int((order_of_model <= n_terms).sum())
        path = pls_path(
            equations.gram,
            equations.covariance[:, :, output_index[:n_active]],
            order_of_model[:n_active],
            is_joint=False,
            mask=mask[:, :n_active],
        )
        coefficients = (
            path[-1] if len(path) else torch.zeros_like(equations.covariance[:, :, output_index])
        )
        mean_squared_error[n_terms, :n_active], standard_error[n_terms, :n_active] = (
            equations.test_errors(coefficients, output_index[:n_active])
        )
        coefficient_size = coefficients[0].abs().masked_fill(mask[:, :n_active] == 0, torch.inf)
        weakest_column = coefficient_size.argmin(0)
        # a model of order a needs a basis functions at least, and two for an elimination
        continues = torch.arange(n_active)[order_of_model[:n_active].clamp(min=2) < n_terms]
        removal[n_columns - n_terms, continues] = weakest_column[continues]
        mask[weakest_column[continues], continues] = 0.0
    return ErrorSurface(
        *(
            values.reshape(-1, n_orders, n_outputs).permute(2, 1, 0).contiguous()
            for values in (mean_squared_error, standard_error, removal)
        )
    )


@dataclass(frozen=True)
class _NormalEquations:
    """Standardised normal equations of P problems.

    The first problem uses all training folds. In a cross-validation P - 1 problems follow, each
    without one fold.

    Attributes:
        gram: Gram matrices [P, J, J].
        covariance: covariances with the outputs [P, J, K].
        scale: standard deviations of the columns [P, J].
        mean_x: means of the columns [P, J].
        mean_y: means of the outputs [P, K].
        test_moments: moments [P', 1 + J + K, 1 + J + K] of the test samples of the last P'
            problems.
    """

    gram: Tensor
    covariance: Tensor
    scale: Tensor
    mean_x: Tensor
    mean_y: Tensor
    test_moments: Tensor

    @classmethod
    def gather(cls, moments: FoldMoments, test_folds: Sequence[int]) -> _NormalEquations:
        """Build the problems evaluated on `test_folds`, or on each fold in turn if empty."""
        summed_moments = moments.sums.sum(0)
        test_sums = moments.sums[list(test_folds)].sum(0) if test_folds else summed_moments * 0.0
        training_sums = [summed_moments - test_sums] + (
            [] if test_folds else [summed_moments - moments.sums[f] for f in range(moments.n_folds)]
        )
        test_moments = test_sums.unsqueeze(0) if test_folds else moments.sums
        centred = [moments.centre(sums) for sums in training_sums]
        if centred[0].xx.shape[0] < 2:
            raise FitError("a surface needs at least two basis functions")
        n_samples = torch.tensor([part.n_samples for part in centred], dtype=torch.float64)
        covariance_xx = torch.stack([part.xx for part in centred])
        covariance_xy = torch.stack([part.xy for part in centred])
        scale = (
            (covariance_xx.diagonal(dim1=1, dim2=2) / (n_samples[:, None] - 1)).clamp(min=0).sqrt()
        )
        column_size = (
            summed_moments[1 : 1 + moments.n_regressors, 1 : 1 + moments.n_regressors].diagonal()
            / summed_moments[0, 0]
        ).sqrt() + moments.shift_x.abs()
        if bool((is_constant := scale <= CONSTANT_TOLERANCE * column_size).any()):
            raise FitError(
                f"basis function number {int(is_constant.any(0).nonzero()[0, 0])} is constant;"
                " remove it, since the model has an intercept"
            )
        gram = covariance_xx / (scale[:, :, None] * scale[:, None, :])
        return cls(
            gram,
            covariance_xy / scale[:, :, None],
            scale,
            torch.stack([part.mean_x for part in centred]),
            torch.stack([part.mean_y for part in centred]),
            test_moments,
        )

    def test_errors(self, coefficients: Tensor, output_index: Tensor) -> tuple[Tensor, Tensor]:
        """Return the mean squared test error [C] and its standard error over the folds [C].

        Args:
            coefficients: standardised coefficients [P, J, C] of C models.
            output_index: output of each model [C].
        """
        n_folds = len(self.test_moments)
        n_columns = self.gram.shape[1]
        slopes = coefficients[-n_folds:] / self.scale[-n_folds:, :, None]
        intercept = self.mean_y[-n_folds:][:, output_index] - (
            self.mean_x[-n_folds:, :, None] * slopes
        ).sum(1)
        weights = torch.cat((intercept[:, None], slopes), dim=1)
        xx = self.test_moments[:, : n_columns + 1, : n_columns + 1]
        xy = self.test_moments[:, : n_columns + 1, n_columns + 1 :]
        yy = self.test_moments[:, n_columns + 1 :, n_columns + 1 :]
        squares = (
            (weights * (xx @ weights)).sum(1)
            - 2 * (weights * xy[:, :, output_index]).sum(1)
            + yy.diagonal(dim1=1, dim2=2)[:, output_index]
        )
        n_samples = self.test_moments[:, 0, 0]
        by_fold = squares / n_samples[:, None]
        standard_error = (
            by_fold.std(0) / n_folds**0.5 if n_folds > 1 else torch.full_like(by_fold[0], torch.nan)
        )
        return squares.sum(0) / n_samples.sum(), standard_error


@final
class SurfacePLSR(Estimator):
    """PLSR fitted per output, with surface analysis for the order and the basis functions.

    Source: Jervan 2020, section 4.5.1.

    Args:
        selection_rule: `simplest` for the one-standard-error rule, `least` for the minimum error.
        test_groups: groups that are used to evaluate the models and not to fit them, as in the
            document; empty for cross-validation over all groups.
    """

    def __init__(
        self,
        selection_rule: Literal["simplest", "least"] = "simplest",
        *,
        test_groups: Sequence[int] = (),
    ) -> None:
        self.selection_rule = selection_rule
        self.test_groups = tuple(test_groups)

    def _solve(self, data: EstimatorData) -> list[Solution]:
        """Return the selected solution with its order and number of terms."""
        x = to_dense(data.x)
        error_surface = self.error_surface(x, data.y, data.groups)
        return [self.solution_at_selection(error_surface, x, data.y, data.groups)]

    def error_surface(self, x: Tensor, y: Tensor, groups: Tensor | None) -> ErrorSurface:
        """Compute the errors of all models.

        Raises:
            FitError: if there are fewer than two groups or basis functions, or if a basis function
                is constant.
        """
        assign_group_folds(groups, None)
        moments = FoldMoments.from_grouped_samples(x, y, groups, None)
        return compute_error_surface(moments, test_folds=self.test_groups)

    def solution_at_selection(
        self, error_surface: ErrorSurface, x: Tensor, y: Tensor, groups: Tensor | None
    ) -> Solution:
        """Fit the model that the selection rule chooses on the error surface."""
        if groups is not None and self.test_groups:
            is_training = ~torch.isin(groups, torch.tensor(self.test_groups))
            x, y = x[is_training], y[is_training]
        outputs = range(y.shape[1])
        select_model = (
            error_surface.one_standard_error_model
            if self.selection_rule == "simplest"
            else error_surface.minimum_error_model
        )
        std_x = x.std(0)
        std_y = y.std(0)
        is_varying = (std_y > CONSTANT_TOLERANCE * y.abs().amax(0)).tolist()
        # an output that varies by rounding errors only gets no basis function
        selected_models = [
            select_model(output) if is_varying[output] else (0, 0) for output in outputs
        ]
        coefficients = y.new_zeros(x.shape[1], y.shape[1])
        for output, (order, n_terms) in zip(outputs, selected_models, strict=True):
            if order == 0:
                continue
            retained = error_surface.retained_columns(output, order, n_terms)
            x_scaled = (x[:, retained] - x[:, retained].mean(0)) / std_x[retained]
            y_scaled = (y[:, [output]] - y[:, output].mean()) / std_y[output]
            pls_coefficients = pls_path(x_scaled.T @ x_scaled, x_scaled.T @ y_scaled, order)[
                -1, :, 0
            ]
            coefficients[retained, output] = pls_coefficients / std_x[retained] * std_y[output]
        hyperparameters = {
            "order": [order for order, _ in selected_models],
            "terms": [n_terms for _, n_terms in selected_models],
        }
        state = {"coefficients": coefficients, "intercept": y.mean(0) - x.mean(0) @ coefficients}
        return Solution(hyperparameters, state)
