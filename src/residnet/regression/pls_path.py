"""The kernel algorithm of partial least squares, from moments alone."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_ENERGY = 1e-13
"""Least energy of a latent variable in units of a column's: below it are rounding and columns that
are sums of others, without a meaning.
"""

_EXPLAINED = 1e-13
"""Share of the covariance up to which nothing is left to explain."""


def pls_path(xx: Tensor, xy: Tensor, orders: int) -> Tensor:
    """Return coefficients of PLS2 for every order up to `orders`, [A, J, K].

    The kernel algorithm is that of Dayal and MacGregor (1997).

    Args:
        xx: X'X of centred, scaled columns [J, J].
        xy: X'Y [J, K].
        orders: number of latent variables; the path ends early where nothing is left to explain, or
            to explain it with.
    """
    j, k = xy.shape
    weights: list[Tensor] = []
    loadings: list[Tensor] = []
    rotations: list[Tensor] = []
    coefficients = torch.zeros(j, k, dtype=xy.dtype)
    path: list[Tensor] = []
    rest = xy.clone()
    start = float(torch.linalg.matrix_norm(xy))
    for _ in range(orders):
        left, singular, _right = torch.linalg.svd(rest, full_matrices=False)
        if float(singular[0]) <= _EXPLAINED * start:
            break
        w = left[:, 0]
        r = w.clone()
        for p_old, r_old in zip(loadings, rotations, strict=True):
            r = r - (p_old @ w) * r_old
        energy = r @ xx @ r
        if float(energy) <= LEAST_ENERGY * float(xx.diagonal().max()):
            break
        p = xx @ r / energy
        q = rest.T @ r / energy
        rest = rest - torch.outer(p, q) * energy
        weights.append(w)
        loadings.append(p)
        rotations.append(r)
        coefficients = coefficients + torch.outer(r, q)
        path.append(coefficients)
    return torch.stack(path) if path else torch.zeros(0, j, k, dtype=xy.dtype)
