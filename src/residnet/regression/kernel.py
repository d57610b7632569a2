"""Kernel ridge regression (document 001 section 3.2, corrections M4, M5)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations_with_replacement
from math import factorial, prod
from typing import Annotated, Any, Literal, NamedTuple, final

import torch
from pydantic import Field
from torch import Tensor, nn

from residnet.core.config import Config
from residnet.core.errors import FitError
from residnet.regression.estimator import Data, Estimator, Solution, fold_numbers, whole
from residnet.regression.expressions import Table

_RANK = 1e-12
"""Eigenvalues of the landmarks' kernel below this share of the largest are rounding."""
_ROWS = 8192
"""Most rows of features that are held at a time."""
_FAR = 10.0
"""Standard deviations of a state beyond which it has run away, and its error stays what it is."""


@dataclass(frozen=True)
class Path:
    """The fits with each of C penalties.

    Attributes:
        coefficients: of the raw features, [C, P, 3].
        errors: mean squared cross-validated errors [C, 3].
        effective: effective number of parameters, the trace of the smoother, [C].
        sigma: of the kernel, where it has one.
        points: samples that carry the function [P, F], where it has such.
    """

    coefficients: Tensor
    errors: Tensor
    effective: Tensor
    sigma: float = 0.0
    points: Tensor = field(default_factory=lambda: torch.zeros(0))


def dual_path(
    kernel: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
) -> Path:
    """Return kernel ridge regressions alpha = (K + lambda I)^-1 Y for every penalty lambda.

    See document 001 section 3.2, correction M4.

    A left-out fold needs no refit: with the smoother H = K (K + lambda I)^-1 its errors are (I -
    H_ff)^-1 (Y - H Y)_f.

    Args:
        kernel: K of all samples with each other, [N, N].
        y: targets [N, 3].
        fold: number of each sample's fold [N].
        penalties: lambda, absolute, positive.
    """
    values, vectors = torch.linalg.eigh(kernel)
    values = values.clamp(min=0.0)
    projected = vectors.T @ y
    members = [torch.nonzero(fold == f).squeeze(1) for f in range(folds)]
    coefficients, errors, effective = [], [], []
    for penalty in penalties:
        alpha = vectors @ (projected / (values + penalty)[:, None])
        total = torch.zeros(y.shape[1], dtype=y.dtype)
        for rows in members:
            rows_of_fold = vectors[rows]
            # I - H = lambda (K + lambda I)^-1, so the penalty cancels
            left = torch.linalg.solve(
                (rows_of_fold / (values + penalty)) @ rows_of_fold.T, alpha[rows]
            )
            total += left.square().sum(0)
        coefficients.append(alpha)
        errors.append(total / len(y))
        effective.append((values / (values + penalty)).sum())
    return Path(torch.stack(coefficients), torch.stack(errors), torch.stack(effective))


def primal_path(
    features: Callable[[Tensor], Tensor],
    whiten: Tensor,
    x: Tensor,
    y: Tensor,
    fold: Tensor,
    folds: int,
    penalties: Sequence[float],
) -> Path:
    """Return ridge regressions min |Y - Phi W w|^2 + lambda |w|^2 for every penalty lambda.

    They come from R factors of the folds.

    Args:
        features: raw features [n, P] of inputs [n, F].
        whiten: W [P, Q], which makes the kernel the inner product of Phi W.
        x: inputs [N, F].
        y: targets [N, 3].
        fold: number of each sample's fold [N].
        penalties: lambda, absolute, positive.

    Returns:
        The path; its coefficients are W w.
    """
    factors = [_factor(features, whiten, x[fold == f], y[fold == f]) for f in range(folds)]
    errors = torch.zeros(len(penalties), y.shape[1], dtype=y.dtype)
    for f, factor in enumerate(factors):
        weights, _ = _weights(
            _triangle(torch.cat([other for g, other in enumerate(factors) if g != f])),
            y.shape[1],
            penalties,
        )
        joined = torch.cat(
            (weights, -torch.eye(y.shape[1], dtype=y.dtype).expand(len(penalties), -1, -1)), dim=1
        )
        errors += (factor @ joined).square().sum(1)
    weights, effective = _weights(_triangle(torch.cat(factors)), y.shape[1], penalties)
    return Path(whiten @ weights, errors / len(y), effective)


def _factor(features: Callable[[Tensor], Tensor], whiten: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Return the R factor of [Phi W, Y], gathered in chunks."""
    kept = torch.zeros(0, whiten.shape[1] + y.shape[1], dtype=y.dtype)
    for begin in range(0, len(x), _ROWS):
        rows = slice(begin, begin + _ROWS)
        kept = _triangle(torch.cat((kept, torch.cat((features(x[rows]) @ whiten, y[rows]), dim=1))))
    return kept


def _triangle(rows: Tensor) -> Tensor:
    factor: Tensor = torch.linalg.qr(rows, mode="r")[1]
    return factor


def _weights(factor: Tensor, outputs: int, penalties: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Return coefficients [C, Q, outputs] and effective numbers of parameters [C].

    They come from the R factor of [Phi W, Y].
    """
    count = factor.shape[1] - outputs
    left, values, right = torch.linalg.svd(factor[:, :count], full_matrices=False)
    projected = left.T @ factor[:, count:]
    shrunk = [values / (values.square() + penalty) for penalty in penalties]
    weights = torch.stack([right.T @ (share[:, None] * projected) for share in shrunk])
    return weights, torch.stack([(values * share).sum() for share in shrunk])


class Kernel(Table, ABC):
    """A function f(x) [..., n] of inputs [..., F]: features of a kernel times coefficients."""

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """Return f [..., n] at inputs x [..., F]."""

    @abstractmethod
    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """Return fits with absolute penalties, one path for each setting of the kernel.

        Args:
            x: inputs [N, F].
            y: outputs [N, n].
            fold: number of each sample's fold [N].
            penalties: lambda, absolute, positive.
        """

    @abstractmethod
    def features(self, path: Path, x: Tensor) -> Tensor:
        """Return the features [..., P] that the coefficients of a path belong to."""

    @abstractmethod
    def selected(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return the settings of each output's path, and the state with coefficients [P, n]."""

    @abstractmethod
    def zero_state(self) -> dict[str, Tensor]:
        """Return the state of the function that is zero."""


@final
class RbfKernel(Kernel):
    """A sum of radial basis functions, f_k(x) = sum_i c_ik exp(-gamma_k |x - x_i|^2).

    gamma = 1 / (2 sigma) (document 001 section 3.2, correction M5: sigma is a squared length).
    """

    def __init__(self, config: Rbf, count: int, outputs: int = 3) -> None:
        super().__init__()
        self.config, self.outputs = config, outputs
        self.points = nn.Buffer(torch.zeros(0, count, dtype=torch.float64))
        self.gamma = nn.Buffer(torch.ones(outputs, dtype=torch.float64))
        self.coefficients = nn.Buffer(torch.zeros(0, outputs, dtype=torch.float64))

    def forward(self, x: Tensor) -> Tensor:
        apart = squared_distances(x, self.points.to(x.dtype))
        out: list[Tensor] = []
        for output in range(self.outputs):
            out.append(
                torch.exp(-self.gamma[output].to(x.dtype) * apart)
                @ self.coefficients[:, output].to(x.dtype)
            )
        return torch.stack(out, dim=-1)

    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        """Return one path for each sigma; see `Kernel.paths`.

        It is exact where there are no more than `exact` samples, else by Nystroem's method on
        landmarks.
        """
        if len(x) <= self.config.exact:
            apart = squared_distances(x, x)
            exact = [
                (sigma, dual_path(torch.exp(-apart / (2 * sigma)), y, fold, folds, penalties))
                for sigma in self.config.sigma
            ]
            return [replace(path, sigma=sigma, points=x) for sigma, path in exact]
        points = x[spread_out(x, self.config.landmarks, self.config.seed)]
        out = []
        for sigma in self.config.sigma:
            values, vectors = torch.linalg.eigh(
                torch.exp(-squared_distances(points, points) / (2 * sigma))
            )
            kept = values > _RANK * values[-1]
            whiten = vectors[:, kept] / values[kept].sqrt()

            def features(part: Tensor, sigma: float = sigma) -> Tensor:
                return torch.exp(-squared_distances(part, points) / (2 * sigma))

            path = primal_path(features, whiten, x, y, fold, folds, penalties)
            out.append(replace(path, sigma=sigma, points=points))
        return out

    def features(self, path: Path, x: Tensor) -> Tensor:
        """Return the kernel between x and the points that carry the function."""
        return torch.exp(-squared_distances(x, path.points) / (2 * path.sigma))

    def selected(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        """Return sigma of each output, and the points, gamma and coefficients."""
        sigma = [path.sigma for path in paths]
        gamma = torch.tensor([0.5 / value for value in sigma], dtype=torch.float64)
        state = {"points": paths[0].points, "gamma": gamma, "coefficients": coefficients}
        return {"sigma": sigma}, state

    def zero_state(self) -> dict[str, Tensor]:
        count = self.points.shape[1]
        return {
            "points": torch.zeros(0, count, dtype=torch.float64),
            "gamma": torch.ones(self.outputs, dtype=torch.float64),
            "coefficients": torch.zeros(0, self.outputs, dtype=torch.float64),
        }


@final
class PolynomialKernel(Kernel):
    """The kernel (slope x'x' + constant)^degree (document 001 section 3.2).

    It is fitted as the ridge regression on weighted products that it equals. The products are
    finitely many, so that any number of samples is fitted exactly.
    """

    def __init__(self, config: Polynomial, count: int, outputs: int = 3) -> None:
        super().__init__()
        self.degree = config.degree
        chosen = list(combinations_with_replacement(range(count + 1), config.degree))
        # multinomial coefficients
        repeats = [prod(map(factorial, Counter(numbers).values())) for numbers in chosen]
        weights = [factorial(config.degree) // count for count in repeats]
        self.index = nn.Buffer(
            torch.tensor(chosen, dtype=torch.long).T.contiguous(), persistent=False
        )
        self.weight = nn.Buffer(torch.tensor(weights, dtype=torch.float64).sqrt(), persistent=False)
        self.coefficients = nn.Buffer(torch.zeros(len(chosen), outputs, dtype=torch.float64))
        self.slope, self.constant = config.slope**0.5, config.constant**0.5

    def products(self, x: Tensor) -> Tensor:
        """Return the weighted products [..., P] of inputs [..., F], whose inner product it is."""
        joined = torch.cat((torch.full_like(x[..., :1], self.constant), x * self.slope), dim=-1)
        out = self.weight.to(x.dtype) * joined.index_select(-1, self.index[0])
        for i in range(1, self.degree):
            out = out * joined.index_select(-1, self.index[i])
        return out

    def forward(self, x: Tensor) -> Tensor:
        return self.products(x) @ self.coefficients.to(x.dtype)

    def paths(
        self, x: Tensor, y: Tensor, fold: Tensor, folds: int, penalties: Sequence[float]
    ) -> list[Path]:
        identity = torch.eye(len(self.coefficients), dtype=torch.float64)
        return [primal_path(self.products, identity, x, y, fold, folds, penalties)]

    def features(self, path: Path, x: Tensor) -> Tensor:
        """Return the products [N, J] of inputs x [N, F]; they are the same for every path."""
        return self.products(x)

    def selected(
        self, paths: Sequence[Path], coefficients: Tensor
    ) -> tuple[dict[str, Any], dict[str, Tensor]]:
        return {}, {"coefficients": coefficients}

    def zero_state(self) -> dict[str, Tensor]:
        return {"coefficients": torch.zeros_like(self.coefficients)}


class Rbf(Config):
    """The radial basis functions exp(-|x - x'|^2 / (2 sigma)) of standardised features.

    Attributes:
        kind: name of the kernel.
        sigma: candidates, in squared standard deviations of a feature (correction M5).
        exact: number of samples up to which all of them carry the function, as in kernel ridge
            regression; with more, landmarks do.
        landmarks: number of samples that carry the function where there are more than `exact`
            (Nystroem's method), spread out by k-means++ seeding.
        seed: seed of the choice of landmarks.
    """

    kind: Literal["rbf"] = "rbf"
    sigma: tuple[Annotated[float, Field(gt=0)], ...] = Field(
        default=(3.0, 10.0, 30.0, 100.0, 300.0), min_length=1
    )
    exact: int = Field(default=2000, ge=1, le=10_000)
    landmarks: int = Field(default=300, ge=2, le=5000)
    seed: int = Field(default=0, ge=0)

    def build(self, count: int, outputs: int = 3) -> RbfKernel:
        """Return the module for `count` features and a number of outputs."""
        return RbfKernel(self, count, outputs)


class Polynomial(Config):
    """The polynomial kernel (slope x'x' + constant)^degree of standardised features.

    Degree 1 is ridge regression.

    Attributes:
        kind: name of the kernel.
        degree: degree p of the polynomial.
        slope: factor theta of the inner product.
        constant: constant c; with 0 only products of exactly `degree` features are left.
    """

    kind: Literal["polynomial"] = "polynomial"
    degree: int = Field(default=2, ge=1, le=4)
    slope: float = Field(default=1.0, gt=0)
    constant: float = Field(default=1.0, ge=0)

    def build(self, count: int, outputs: int = 3) -> PolynomialKernel:
        """Return the module for `count` features and a number of outputs."""
        return PolynomialKernel(self, count, outputs)


def squared_distances(x: Tensor, points: Tensor) -> Tensor:
    """Return |x - x_i|^2 [..., M] between inputs [..., F] and points [M, F]."""
    square = (x * x).sum(-1, keepdim=True) + (points * points).sum(-1)
    return (square - 2.0 * (x @ points.T)).clamp(min=0.0)


def spread_out(x: Tensor, count: int, seed: int) -> Tensor:
    """Return the indices [count] of samples that lie apart (k-means++).

    Each is drawn with a chance that grows with its squared distance to those before. There are
    fewer than `count` where the samples have no more different values.
    """
    random = torch.Generator().manual_seed(seed)
    first = int(torch.randint(len(x), (1,), generator=random))
    nearest = (x - x[first]).square().sum(-1)
    found = [first]
    while len(found) < count and float(nearest.max()) > 0:
        # by its cumulated sum: multinomial takes no more than 2^24 samples
        total = nearest.cumsum(0)
        draw = torch.rand(1, generator=random, dtype=x.dtype) * total[-1]
        found.append(min(int(torch.searchsorted(total, draw, right=True)), len(x) - 1))
        nearest = torch.minimum(nearest, (x - x[found[-1]]).square().sum(-1))
    return torch.tensor(found)


class Recursion:
    """Errors of a fit whose output integrates into one of its inputs, the others as measured.

    This is the first approach of document 001, section 4. Tuned so, each model looks good for
    itself; together they may still drift apart, which is why the document gives the approach up.
    Unbroken stretches of samples run side by side, padded by samples that do not count.

    Args:
        z: inputs of the fit [N, nz].
        target: outputs of the fit [N, n].
        stretch: number of the unbroken stretch of each sample, ascending [N].
        step: time between neighbouring samples, s.
        states: column of z that each output is the derivative of, [n].

    Raises:
        FitError: where no two samples follow each other.
    """

    def __init__(
        self, z: Tensor, target: Tensor, stretch: Tensor, step: float, states: Sequence[int]
    ) -> None:
        lengths = torch.unique_consecutive(stretch, return_counts=True)[1].tolist()
        if max(lengths, default=0) < 2:
            raise FitError(
                "choosing by recursion needs samples that follow each other; the masks leave none"
            )
        pad = torch.nn.utils.rnn.pad_sequence
        inside = [torch.ones(length, dtype=torch.bool) for length in lengths]
        self.inside = pad(inside, batch_first=True)
        self.z = pad(list(z.split(lengths)), batch_first=True)
        self.target = pad(list(target.split(lengths)), batch_first=True)
        self.step = step
        self.states = tuple(states)

    def errors(self, output: int, predicted: Callable[[Tensor], Tensor], count: int) -> Tensor:
        """Return mean square errors [C] of one state along all stretches, for C fits at once.

        What the state's measured derivative holds beside the output, such as the part of a
        baseline, is taken as it was.

        Args:
            predicted: from inputs [C, G, nz] to each fit's output [C, G].
            count: number of fits C.
        """
        column = self.states[output]
        measured = self.z[..., column]
        known = (measured[:, 1:] - measured[:, :-1]) / self.step - self.target[:, :-1, output]
        middle = float(measured[self.inside].mean())
        far = _FAR * float(measured[self.inside].std(correction=0))
        x = measured[:, 0].expand(count, -1).clone()
        total = torch.zeros(count, dtype=measured.dtype)
        for k in range(measured.shape[1] - 1):
            z = self.z[:, k].expand(count, -1, -1).clone()
            z[..., column] = x
            x = x + self.step * (known[:, k] + predicted(z))
            x = middle + (x - middle).nan_to_num(far, far, -far).clamp(-far, far)
            error = (x - measured[:, k + 1]).square()
            total += torch.where(self.inside[:, k + 1], error, torch.zeros_like(x)).sum(-1)
        return total / int(self.inside[:, 1:].sum())


Scoring = Callable[[Sequence[Path]], Tensor]
"""Errors [settings, penalties, n] of fits, one path for each setting of the kernel."""


class _Pick(NamedTuple):
    """The kernel's setting and the penalty of each output, by number."""

    settings: tuple[int, ...]
    penalties: tuple[int, ...]


@final
class KernelRidge(Estimator):
    """Kernel ridge regression of every output, without intercept.

    A solution's state is that of the kernel module, and `effective` [n], the effective number of
    parameters of each output, which is the trace of the smoother.

    Args:
        kernel: module of the kernel, with the settings that are tried.
        penalties: candidates for each sample: the document's lambda (scikit-learn's alpha) is
            penalty * samples.
        folds: folds of the cross-validation; None for one fold for each group.
        scoring: errors by which each output chooses its setting and penalty; None for the
            cross-validated ones.
        alternatives: whether `fit` offers every setting and penalty for all outputs together, with
            the neighbours of each, and no function at all, beside its own choice.
    """

    def __init__(
        self,
        kernel: Kernel,
        penalties: Sequence[float],
        *,
        folds: int | None = 5,
        scoring: Scoring | None = None,
        alternatives: bool = False,
    ) -> None:
        self.kernel = kernel
        self.penalties = tuple(sorted(penalties))
        self.folds = folds
        self.scoring = scoring
        self.alternatives = alternatives

    def solve(self, data: Data) -> list[Solution]:
        x, y = whole(data.x), data.y
        fold = fold_numbers(data.groups, self.folds)
        folds, count = int(fold.max()) + 1, len(self.penalties)
        absolute = [penalty * len(x) for penalty in self.penalties]
        with torch.no_grad():
            paths = self.kernel.paths(x, y, fold, folds, absolute)
        errors = torch.stack([path.errors for path in paths])
        notes: dict[str, Any] = {"cross_validated_error": errors.tolist(), "samples": len(x)}
        judged = errors
        if self.scoring is not None:
            judged = self.scoring(paths)
            notes["recursion_error"] = judged.tolist()
        least, best = torch.nan_to_num(judged, nan=torch.inf).flatten(0, 1).min(0)
        if not bool(torch.isfinite(least).all()):
            raise FitError(
                "kernel ridge regression: no setting has finite errors; give larger `penalties`"
            )
        preferred = _Pick(tuple((best // count).tolist()), tuple((best % count).tolist()))
        if not self.alternatives:
            return [self._solution(paths, preferred, notes)]
        n = y.shape[1]
        picks = [preferred]
        picks += [_Pick((i,) * n, (j,) * n) for i in range(len(paths)) for j in range(count)]
        zero = self.kernel.zero_state() | {"effective": y.new_zeros(n)}
        nothing = Solution({"penalty": []}, zero, notes=notes)
        return [*(self._solution(paths, pick, notes) for pick in picks), nothing]

    def _solution(self, paths: Sequence[Path], pick: _Pick, notes: dict[str, Any]) -> Solution:
        parts = list(enumerate(zip(pick.settings, pick.penalties, strict=True)))
        columns = [paths[i].coefficients[j, :, output] for output, (i, j) in parts]
        effective = torch.stack([paths[i].effective[j] for _, (i, j) in parts])
        setting, state = self.kernel.selected(
            [paths[i] for i in pick.settings], torch.stack(columns, dim=1)
        )

        def neighbours() -> list[Solution]:
            near = []
            for output, (_, j) in parts:
                for other in (j - 1, j + 1):
                    if 0 <= other < len(self.penalties):
                        before, after = pick.penalties[:output], pick.penalties[output + 1 :]
                        near.append(pick._replace(penalties=(*before, other, *after)))
            return [self._solution(paths, other, notes) for other in near]

        return Solution(
            setting | {"penalty": [self.penalties[j] for j in pick.penalties]},
            state | {"effective": effective},
            notes=notes | {"effective_parameters": effective.tolist()},
            neighbours=neighbours if self.alternatives else None,
        )
