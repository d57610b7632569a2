"""Kernel ridge regression.

Source: Moreno-Salinas et al. 2019, section 3.2. The article misprints the inverse matrix of the
solution and the exponent of the radial kernel (`docs/documents/corrections.md`, M4 and M5).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from math import factorial, prod
from typing import TYPE_CHECKING, Any, NamedTuple, final

import torch
from torch import Tensor, nn

from residnet.core.errors import FitError
from residnet.regression.estimator import (
    Estimator,
    EstimatorData,
    Solution,
    assign_group_folds,
    to_dense,
)
from residnet.regression.expressions import ResizableModule

if TYPE_CHECKING:
    from residnet.regression.kernel_config import PolynomialConfig, RbfConfig

_RANK_TOLERANCE = 1e-12
"""Ratio to the largest eigenvalue, below which an eigenvalue of the kernel counts as zero."""
_CHUNK_ROWS = 8192
"""Maximum number of rows of features that are evaluated at a time."""
_DIVERGENCE_LIMIT_STD = 10.0
"""Number of standard deviations at which the state of a diverged free run is clipped."""


@dataclass(frozen=True)
class RegularizationPath:
    """Kernel ridge regressions with C penalties.

    Attributes:
        coefficients: coefficients of the features [C, P, n].
        errors: mean squared cross-validated errors [C, n].
        effective_parameters: effective number of parameters, the trace of the smoother, [C].
        sigma: parameter of the radial basis functions; 0 for other kernels.
        support_points: centres of the radial basis functions [P, F]; empty for other kernels.
    """

    coefficients: Tensor
    errors: Tensor
    effective_parameters: Tensor
    sigma: float = 0.0
    support_points: Tensor = field(default_factory=lambda: torch.zeros(0))


def fit_dual_path(
    kernel: Tensor, y: Tensor, fold_index: Tensor, n_folds: int, penalties: Sequence[float]
) -> RegularizationPath:
    """Solve kernel ridge regressions alpha = (K + lambda I)^-1 Y for every penalty lambda.

    The errors on a fold f need no refit: with the smoother H = K (K + lambda I)^-1 they are
    (I - H_ff)^-1 (Y - H Y)_f (Moreno-Salinas et al. 2019, section 3.2).

    Args:
        kernel: kernel matrix K of all samples [N, N].
        y: targets [N, n].
        fold_index: fold of each sample [N].
        n_folds: number of folds.
        penalties: positive penalties lambda.
    """
    eigenvalues, eigenvectors = torch.linalg.eigh(kernel)
    eigenvalues = eigenvalues.clamp(min=0.0)
    projected = eigenvectors.T @ y
    fold_members = [torch.nonzero(fold_index == f).squeeze(1) for f in range(n_folds)]
    coefficients = []
    errors_by_penalty = []
    effective_parameters = []
    for penalty in penalties:
        # one eigendecomposition serves all penalties
        alpha = eigenvectors @ (projected / (eigenvalues + penalty)[:, None])
        squared_error = torch.zeros(y.shape[1], dtype=y.dtype)
        for rows in fold_members:
            rows_of_fold = eigenvectors[rows]
            # I - H = lambda (K + lambda I)^-1, so the penalty cancels out
            left_out_errors = torch.linalg.solve(
                (rows_of_fold / (eigenvalues + penalty)) @ rows_of_fold.T, alpha[rows]
            )
            squared_error += left_out_errors.square().sum(0)
        coefficients.append(alpha)
        errors_by_penalty.append(squared_error / len(y))
        effective_parameters.append((eigenvalues / (eigenvalues + penalty)).sum())
    return RegularizationPath(
        torch.stack(coefficients), torch.stack(errors_by_penalty), torch.stack(effective_parameters)
    )


def fit_primal_path(
    features: Callable[[Tensor], Tensor],
    whitening: Tensor,
    x: Tensor,
    y: Tensor,
    fold_index: Tensor,
    n_folds: int,
    penalties: Sequence[float],
) -> RegularizationPath:
    """Solve ridge regressions min |Y - Phi W w|^2 + lambda |w|^2 for every penalty lambda.

    The R factors of the folds are computed once and combined for every training set.

    Args:
        features: function from inputs [N, F] to the features Phi [N, P].
        whitening: matrix W [P, Q], with which the kernel is the inner product of the rows of Phi W.
        x: inputs [N, F].
        y: targets [N, n].
        fold_index: fold of each sample [N].
        n_folds: number of folds.
        penalties: positive penalties lambda.

    Returns:
        The path with the coefficients W w.
    """
    fold_factors = [
        _accumulate_r_factor(features, whitening, x[fold_index == f], y[fold_index == f])
        for f in range(n_folds)
    ]
    errors = torch.zeros(len(penalties), y.shape[1], dtype=y.dtype)
    # fit on the R factors of the other folds, and evaluate on that of the fold
    for f, fold_factor in enumerate(fold_factors):
        weights, _ = _ridge_weights(
            _qr_factor(
                torch.cat([other_factor for g, other_factor in enumerate(fold_factors) if g != f])
            ),
            y.shape[1],
            penalties,
        )
        # residuals of the fold: Phi W w - Y = R [w; -I], up to a rotation that preserves the norm
        weights_and_targets = torch.cat(
            (weights, -torch.eye(y.shape[1], dtype=y.dtype).expand(len(penalties), -1, -1)), dim=1
        )
        errors += (fold_factor @ weights_and_targets).square().sum(1)
    weights, effective_parameters = _ridge_weights(
        _qr_factor(torch.cat(fold_factors)), y.shape[1], penalties
    )
    return RegularizationPath(whitening @ weights, errors / len(y), effective_parameters)


def _accumulate_r_factor(
    features: Callable[[Tensor], Tensor], whitening: Tensor, x: Tensor, y: Tensor
) -> Tensor:
    """Compute the R factor of [Phi W, Y] chunk by chunk."""
    r_factor = torch.zeros(0, whitening.shape[1] + y.shape[1], dtype=y.dtype)
    for chunk_start in range(0, len(x), _CHUNK_ROWS):
        rows = slice(chunk_start, chunk_start + _CHUNK_ROWS)
        r_factor = _qr_factor(
            torch.cat((r_factor, torch.cat((features(x[rows]) @ whitening, y[rows]), dim=1)))
        )
    return r_factor


def _qr_factor(matrix: Tensor) -> Tensor:
    """Return the upper triangular R of a matrix = Q R; Q is not computed."""
    factor: Tensor = torch.linalg.qr(matrix, mode="r")[1]
    return factor


def _ridge_weights(
    r_factor: Tensor, n_outputs: int, penalties: Sequence[float]
) -> tuple[Tensor, Tensor]:
    """Return ridge coefficients [C, Q, n] and effective numbers of parameters [C].

    Args:
        r_factor: R factor of [Phi W, Y].
        n_outputs: number of outputs n.
        penalties: the C penalties.
    """
    n_features = r_factor.shape[1] - n_outputs
    left_vectors, singular_values, right_vectors = torch.linalg.svd(
        r_factor[:, :n_features], full_matrices=False
    )
    projected = left_vectors.T @ r_factor[:, n_features:]
    shrunk = [singular_values / (singular_values.square() + penalty) for penalty in penalties]
    weights = torch.stack(
        [right_vectors.T @ (shrinkage[:, None] * projected) for shrinkage in shrunk]
    )
    return weights, torch.stack([(singular_values * shrinkage).sum() for shrinkage in shrunk])


class Kernel(ResizableModule, ABC):
    """Kernel function f(x) [..., n] of inputs [..., F]: features times coefficients."""

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """Return f [..., n] at inputs x [..., F]."""

    @abstractmethod
    def fit_paths(
        self, x: Tensor, y: Tensor, fold_index: Tensor, n_folds: int, penalties: Sequence[float]
    ) -> list[RegularizationPath]:
        """Fit all penalties; return one path per setting of the kernel.

        Args:
            x: inputs [N, F].
            y: outputs [N, n].
            fold_index: fold of each sample [N].
            n_folds: number of folds.
            penalties: positive penalties lambda.
        """

    @abstractmethod
    def evaluate_features(self, path: RegularizationPath, x: Tensor) -> Tensor:
        """Return the features [..., P] whose coefficients the path has."""

    @abstractmethod
    def build_state(
        self, output_paths: Sequence[RegularizationPath], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return the kernel settings per output and the state of the module.

        Args:
            output_paths: selected path of each output.
            coefficients: coefficients of the features [P, n].
        """

    @abstractmethod
    def zero_state(self) -> dict[str, Tensor]:
        """Return the state with which the kernel expansion is zero everywhere."""


@final
class RbfKernel(Kernel):
    """Sum of Gaussian radial basis functions, f_k(x) = sum_i c_ik exp(-gamma_k |x - x_i|^2).

    gamma = 1 / (2 sigma), where sigma is a squared length (Moreno-Salinas et al. 2019,
    section 3.2).
    """

    def __init__(self, config: RbfConfig, n_features: int, n_outputs: int = 3) -> None:
        super().__init__()
        self.config = config
        self.n_outputs = n_outputs
        self.points = nn.Buffer(torch.zeros(0, n_features, dtype=torch.float64))
        self.gamma = nn.Buffer(torch.ones(n_outputs, dtype=torch.float64))
        self.coefficients = nn.Buffer(torch.zeros(0, n_outputs, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        distances = squared_distances(x, self.points.to(x.dtype))
        outputs: list[Tensor] = []
        for output in range(self.n_outputs):
            outputs.append(
                torch.exp(-self.gamma[output].to(x.dtype) * distances)
                @ self.coefficients[:, output].to(x.dtype)
            )
        return torch.stack(outputs, dim=-1)

    def fit_paths(
        self, x: Tensor, y: Tensor, fold_index: Tensor, n_folds: int, penalties: Sequence[float]
    ) -> list[RegularizationPath]:
        """Fit all penalties; return one path per sigma.

        Up to `exact` samples the kernel matrix is exact; with more samples the Nystroem method
        approximates it from landmarks.
        """
        if len(x) <= self.config.exact:
            distances = squared_distances(x, x)
            exact_paths = [
                (
                    sigma,
                    fit_dual_path(
                        torch.exp(-distances / (2 * sigma)), y, fold_index, n_folds, penalties
                    ),
                )
                for sigma in self.config.sigma
            ]
            return [replace(path, sigma=sigma, support_points=x) for sigma, path in exact_paths]
        points = x[kmeans_plus_plus_indices(x, self.config.landmarks, self.config.seed)]
        paths = []
        for sigma in self.config.sigma:
            eigenvalues, eigenvectors = torch.linalg.eigh(
                torch.exp(-squared_distances(points, points) / (2 * sigma))
            )
            # whitening with the significant eigenvectors of the kernel of the landmarks
            is_significant = eigenvalues > _RANK_TOLERANCE * eigenvalues[-1]
            whitening = eigenvectors[:, is_significant] / eigenvalues[is_significant].sqrt()

            def features(inputs: Tensor, sigma: float = sigma) -> Tensor:
                return torch.exp(-squared_distances(inputs, points) / (2 * sigma))

            path = fit_primal_path(features, whitening, x, y, fold_index, n_folds, penalties)
            paths.append(replace(path, sigma=sigma, support_points=points))
        return paths

    def evaluate_features(self, path: RegularizationPath, x: Tensor) -> Tensor:
        """Return the kernel between the inputs and the centres of the path."""
        return torch.exp(-squared_distances(x, path.support_points) / (2 * path.sigma))

    def build_state(
        self, output_paths: Sequence[RegularizationPath], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return sigma per output, and the centres, gamma and coefficients."""
        sigma = [path.sigma for path in output_paths]
        gamma = torch.tensor([0.5 / value for value in sigma], dtype=torch.float64)
        state = {
            "points": output_paths[0].support_points,
            "gamma": gamma,
            "coefficients": coefficients,
        }
        return {"sigma": sigma}, state

    def zero_state(self) -> dict[str, Tensor]:
        n_features = self.points.shape[1]
        return {
            "points": torch.zeros(0, n_features, dtype=torch.float64),
            "gamma": torch.ones(self.n_outputs, dtype=torch.float64),
            "coefficients": torch.zeros(0, self.n_outputs, dtype=torch.float64),
        }


@final
class PolynomialKernel(Kernel):
    """Polynomial kernel (slope x'x' + constant)^degree (Moreno-Salinas et al. 2019, section 3.2).

    The kernel is an inner product of finitely many weighted monomials, so the primal ridge
    regression on these is exact for any number of samples.
    """

    def __init__(self, config: PolynomialConfig, n_features: int, n_outputs: int = 3) -> None:
        super().__init__()
        self.degree = config.degree
        index_tuples = list(combinations_with_replacement(range(n_features + 1), config.degree))
        # the squared weights of the monomials are multinomial coefficients
        repeat_counts = [
            prod(map(factorial, Counter(index_tuple).values())) for index_tuple in index_tuples
        ]
        weights = [factorial(config.degree) // repeat_count for repeat_count in repeat_counts]
        self.index = nn.Buffer(
            torch.tensor(index_tuples, dtype=torch.long).T.contiguous(), persistent=False
        )
        self.weight = nn.Buffer(torch.tensor(weights, dtype=torch.float64).sqrt(), persistent=False)
        self.coefficients = nn.Buffer(
            torch.zeros(len(index_tuples), n_outputs, dtype=torch.float64)
        )
        self.slope = config.slope**0.5
        self.constant = config.constant**0.5

    def weighted_products(self, x: Tensor) -> Tensor:
        """Return the weighted monomials [..., P] of inputs [..., F]."""
        augmented = torch.cat((torch.full_like(x[..., :1], self.constant), x * self.slope), dim=-1)
        values = self.weight.to(x.dtype) * augmented.index_select(-1, self.index[0])
        for i in range(1, self.degree):
            values = values * augmented.index_select(-1, self.index[i])
        return values

    def forward(self, x: Tensor) -> Tensor:
        return self.weighted_products(x) @ self.coefficients.to(x.dtype)

    def fit_paths(
        self, x: Tensor, y: Tensor, fold_index: Tensor, n_folds: int, penalties: Sequence[float]
    ) -> list[RegularizationPath]:
        identity = torch.eye(len(self.coefficients), dtype=torch.float64)
        return [
            fit_primal_path(self.weighted_products, identity, x, y, fold_index, n_folds, penalties)
        ]

    def evaluate_features(self, path: RegularizationPath, x: Tensor) -> Tensor:
        """Return the weighted monomials [N, P] of inputs [N, F]; they do not depend on the path."""
        return self.weighted_products(x)

    def build_state(
        self, output_paths: Sequence[RegularizationPath], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        return {}, {"coefficients": coefficients}

    def zero_state(self) -> dict[str, Tensor]:
        return {"coefficients": torch.zeros_like(self.coefficients)}


def squared_distances(x: Tensor, points: Tensor) -> Tensor:
    """Return |x - x_i|^2 [..., M] between inputs [..., F] and points [M, F]."""
    # |x - p|^2 = |x|^2 + |p|^2 - 2 x.p needs no tensor of all differences; rounding may make it
    # slightly negative
    squared_norms = (x * x).sum(-1, keepdim=True) + (points * points).sum(-1)
    return (squared_norms - 2.0 * (x @ points.T)).clamp(min=0.0)


def kmeans_plus_plus_indices(x: Tensor, n_points: int, seed: int) -> Tensor:
    """Draw the indices of `n_points` samples by k-means++ seeding (Arthur and Vassilvitskii 2007).

    The probability of a sample is proportional to its squared distance to the nearest of the points
    drawn before. Fewer indices are returned if the samples have fewer distinct values.
    """
    generator = torch.Generator().manual_seed(seed)
    first_index = int(torch.randint(len(x), (1,), generator=generator))
    squared_distance = (x - x[first_index]).square().sum(-1)
    indices = [first_index]
    while len(indices) < n_points and float(squared_distance.max()) > 0:
        # inverse of the cumulative sum, because torch.multinomial is limited to 2^24 samples
        cumulative_distance = squared_distance.cumsum(0)
        random_draw = torch.rand(1, generator=generator, dtype=x.dtype) * cumulative_distance[-1]
        indices.append(
            min(int(torch.searchsorted(cumulative_distance, random_draw, right=True)), len(x) - 1)
        )
        squared_distance = torch.minimum(squared_distance, (x - x[indices[-1]]).square().sum(-1))
    return torch.tensor(indices)


class SingleStateFreeRun:
    """Errors of free runs in which one state is integrated and all other inputs are measured.

    This is the first approach of Moreno-Salinas et al. 2019, section 4. It tunes every output
    alone; the coupled free run may still diverge, which is why the authors abandon the approach.
    Uninterrupted segments are padded to equal length and integrated as a batch.

    Args:
        z: inputs of the fit [N, nz].
        target: outputs of the fit [N, n].
        segment: index of the uninterrupted segment of each sample [N], ascending.
        time_step: sampling interval, s.
        states: column of z of the state whose derivative each output is, [n].

    Raises:
        FitError: if no segment has two samples.
    """

    def __init__(
        self, z: Tensor, target: Tensor, segment: Tensor, time_step: float, states: Sequence[int]
    ) -> None:
        lengths = torch.unique_consecutive(segment, return_counts=True)[1].tolist()
        if max(lengths, default=0) < 2:
            raise FitError(
                "selection by recursion needs consecutive samples, but the masks leave none; relax"
                " the masks or select by cross-validation"
            )
        pad_sequence = torch.nn.utils.rnn.pad_sequence
        valid_masks = [torch.ones(length, dtype=torch.bool) for length in lengths]
        self.is_valid = pad_sequence(valid_masks, batch_first=True)
        self.z = pad_sequence(list(z.split(lengths)), batch_first=True)
        self.target = pad_sequence(list(target.split(lengths)), batch_first=True)
        self.time_step = time_step
        self.states = tuple(states)

    def state_errors(self, output: int, predict: Callable[[Tensor], Tensor], n_fits: int) -> Tensor:
        """Return the mean squared errors [C] of one state over all segments, for C fits at once.

        The part of the measured derivative that is not the output, such as the prediction of a
        baseline, is added as measured.

        Args:
            output: index of the output.
            predict: function from inputs [C, G, nz] to the output of each fit [C, G].
            n_fits: number of fits C.
        """
        column = self.states[output]
        measured = self.z[..., column]
        # the part of the derivative that is not the output; the free run adds it as measured, so
        # that only errors of this output accumulate
        remaining_derivative = (measured[:, 1:] - measured[:, :-1]) / self.time_step - self.target[
            :, :-1, output
        ]
        state_mean = float(measured[self.is_valid].mean())
        state_limit = _DIVERGENCE_LIMIT_STD * float(measured[self.is_valid].std(correction=0))
        x = measured[:, 0].expand(n_fits, -1).clone()
        squared_error = torch.zeros(n_fits, dtype=measured.dtype)
        for k in range(measured.shape[1] - 1):
            z = self.z[:, k].expand(n_fits, -1, -1).clone()
            z[..., column] = x
            x = x + self.time_step * (remaining_derivative[:, k] + predict(z))
            x = state_mean + (x - state_mean).nan_to_num(
                state_limit, state_limit, -state_limit
            ).clamp(-state_limit, state_limit)
            error = (x - measured[:, k + 1]).square()
            squared_error += torch.where(self.is_valid[:, k + 1], error, torch.zeros_like(x)).sum(
                -1
            )
        return squared_error / int(self.is_valid[:, 1:].sum())


ScoringFunction = Callable[[Sequence[RegularizationPath]], Tensor]
"""Computes errors [settings, penalties, n] from one path per setting of the kernel."""


class _SettingIndices(NamedTuple):
    """Indices of the kernel setting and of the penalty of each output."""

    settings: tuple[int, ...]
    penalties: tuple[int, ...]


@final
class KernelRidge(Estimator):
    """Kernel ridge regression of every output, without intercept.

    The state of a solution is that of the kernel module and `effective_parameters` [n], the
    effective number of parameters of each output (the trace of the smoother).

    Args:
        kernel: kernel module with its candidate settings.
        penalties: candidate penalties per sample; lambda of Moreno-Salinas et al. 2019 and `alpha`
            of scikit-learn are the penalty times the number of samples.
        folds: number of folds of the cross-validation; None for a fold per group.
        scoring: computes the errors by which setting and penalty are chosen per output; None for
            the cross-validated errors.
        has_alternatives: whether `fit` also returns every setting and penalty, shared by all
            outputs, with its neighbours, and the zero function.
    """

    def __init__(
        self,
        kernel: Kernel,
        penalties: Sequence[float],
        *,
        folds: int | None = 5,
        scoring: ScoringFunction | None = None,
        has_alternatives: bool = False,
    ) -> None:
        self.kernel = kernel
        self.penalties = tuple(sorted(penalties))
        self.folds = folds
        self.scoring = scoring
        self.has_alternatives = has_alternatives

    def _solve(self, data: EstimatorData) -> list[Solution]:
        x, y = to_dense(data.x), data.y
        fold_index = assign_group_folds(data.groups, self.folds)
        n_folds = int(fold_index.max()) + 1
        n_penalties = len(self.penalties)
        absolute_penalties = [penalty * len(x) for penalty in self.penalties]
        with torch.no_grad():
            paths = self.kernel.fit_paths(x, y, fold_index, n_folds, absolute_penalties)
        errors = torch.stack([path.errors for path in paths])
        notes: dict[str, Any] = {"cross_validated_error": errors.tolist(), "samples": len(x)}
        selection_errors = errors
        if self.scoring is not None:
            selection_errors = self.scoring(paths)
            notes["recursion_error"] = selection_errors.tolist()
        min_errors, best_indices = (
            torch.nan_to_num(selection_errors, nan=torch.inf).flatten(0, 1).min(0)
        )
        if not bool(torch.isfinite(min_errors).all()):
            raise FitError(
                "kernel ridge regression: no setting has finite errors; give larger `penalties`"
            )
        preferred = _SettingIndices(
            tuple((best_indices // n_penalties).tolist()),
            tuple((best_indices % n_penalties).tolist()),
        )
        if not self.has_alternatives:
            return [self._build_solution(paths, preferred, notes)]
        n_outputs = y.shape[1]
        candidates = [preferred]
        candidates += [
            _SettingIndices((i,) * n_outputs, (j,) * n_outputs)
            for i in range(len(paths))
            for j in range(n_penalties)
        ]
        zero_state = self.kernel.zero_state() | {"effective_parameters": y.new_zeros(n_outputs)}
        empty_solution = Solution({"penalty": []}, zero_state, notes=notes)
        return [
            *(
                self._build_solution(paths, setting_indices, notes)
                for setting_indices in candidates
            ),
            empty_solution,
        ]

    def _build_solution(
        self,
        paths: Sequence[RegularizationPath],
        setting_indices: _SettingIndices,
        notes: dict[str, Any],
    ) -> Solution:
        """Build the solution with a kernel setting and a penalty for each output."""
        output_settings = list(
            enumerate(zip(setting_indices.settings, setting_indices.penalties, strict=True))
        )
        columns = [paths[i].coefficients[j, :, output] for output, (i, j) in output_settings]
        effective_parameters = torch.stack(
            [paths[i].effective_parameters[j] for _, (i, j) in output_settings]
        )
        kernel_settings, state = self.kernel.build_state(
            [paths[i] for i in setting_indices.settings], torch.stack(columns, dim=1)
        )

        def neighbours() -> list[Solution]:
            # the next lower and higher penalty of each output in turn
            neighbour_indices = []
            for output, (_, j) in output_settings:
                for penalty_index in (j - 1, j + 1):
                    if 0 <= penalty_index < len(self.penalties):
                        preceding = setting_indices.penalties[:output]
                        following = setting_indices.penalties[output + 1 :]
                        neighbour_indices.append(
                            setting_indices._replace(
                                penalties=(*preceding, penalty_index, *following)
                            )
                        )
            return [
                self._build_solution(paths, output_indices, notes)
                for output_indices in neighbour_indices
            ]

        return Solution(
            kernel_settings | {"penalty": [self.penalties[j] for j in setting_indices.penalties]},
            state | {"effective_parameters": effective_parameters},
            notes=notes | {"effective_parameters": effective_parameters.tolist()},
            neighbours=neighbours if self.has_alternatives else None,
        )
