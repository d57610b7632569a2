"""Ridge regression on the features of a kernel, with every penalty from one decomposition.

Its cross-validation comes from the same one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

_ROWS = 8192
"""Most rows of features that are held at a time."""


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
        folds: how many there are.
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
        folds: how many there are.
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
