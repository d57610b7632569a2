"""What a baseline leaves, and how surely accelerations alone know its coefficients."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from residnet.baselines import ParametricBaseline
from residnet.core.arrays import paged
from residnet.core.samples import Samples
from residnet.dynamics.hybrid import HybridDynamics

_ALIKE = 20
"""Samples in a row whose errors hang together, where nothing else is known."""


def least_squares_covariance(baseline: nn.Module, known: Samples) -> Tensor | None:
    """Return the covariance [P, P] of a baseline's coefficients from accelerations alone.

    None where it has no coefficients that may move.
    """
    if not isinstance(baseline, ParametricBaseline):
        return None
    information = len(known) / _ALIKE * baseline.information(known)
    covariance: Tensor = torch.linalg.pinv(information, hermitian=True)
    return covariance


def residual_samples(model: HybridDynamics, known: Samples) -> Samples:
    """Return samples whose target is what the model's baseline leaves.

    That is an acceleration (document 003 (19)) or a force (document 002 (3.20)), as the model's
    head wants it.

    Args:
        model: with its baseline filled in.
        known: samples whose target is the measured acceleration.
    """
    with torch.no_grad():
        explained = paged.rows(len(known), 3)
        for rows in paged.row_pieces(len(known)):
            explained[rows] = model.baseline(known.z[rows])
            paged.forget()
        return model.head.residual_target(known, explained)
