"""NIPALS as document 002 prints it (section 3.3.1) with corrections J14 to J17."""

from __future__ import annotations

import torch
from torch import Tensor

from residnet.core.errors import FitError
from residnet.regression.pls_path import LEAST_ENERGY

_EXPLAINED = 1e-24
"""Share of the energy up to which nothing is left to explain, or to explain it with."""


def nipals(
    e: Tensor, f: Tensor, orders: int, tolerance: float = 1e-12, iterations: int = 50_000
) -> Tensor:
    """Return Theta_pre [A, J, K] for every order up to `orders`.

    Args:
        e: centred, scaled inputs [N, J].
        f: centred, scaled outputs [N, K].
        orders: number of latent variables; the path ends early where nothing is left.
        tolerance: largest change of a unit loading weight between iterations.
        iterations: most iterations for one latent variable.

    Raises:
        FitError: where an iteration does not converge.
    """
    e, f = e.clone(), f.clone()
    energy, largest = float(f.square().sum()), float(e.square().sum(0).max())
    weights: list[Tensor] = []
    loadings: list[Tensor] = []
    outputs: list[Tensor] = []
    path: list[Tensor] = []
    for _ in range(orders):
        if (
            float(f.square().sum()) <= _EXPLAINED * energy
            or float(e.square().sum()) <= _EXPLAINED * e.numel()
        ):
            break
        u = f[:, int(f.square().sum(0).argmax())]
        w = torch.zeros_like(e[0])
        for _ in range(iterations):
            before, w = w, e.T @ u / (u @ u)  # (3.5a), J14
            w = w / w.norm()
            t = e @ w
            q = f.T @ t / (t @ t)
            u = f @ q / (q @ q)
            if float((w - before).abs().max()) < tolerance:
                break
        else:
            raise FitError(
                f"NIPALS: latent variable {len(path) + 1} did not converge in {iterations}"
                " iterations; use the kernel algorithm (plsr)"
            )
        if float(t @ t) <= LEAST_ENERGY * largest:
            break
        p = e.T @ t / (t @ t)
        e, f = e - torch.outer(t, p), f - torch.outer(t, q)
        weights.append(w)
        loadings.append(p)
        outputs.append(q)
        big_w, big_p, big_q = (torch.stack(part, dim=1) for part in (weights, loadings, outputs))
        path.append(big_w @ torch.linalg.solve(big_p.T @ big_w, big_q.T))  # (3.11)
    return torch.stack(path) if path else torch.zeros(0, e.shape[1], f.shape[1], dtype=e.dtype)
