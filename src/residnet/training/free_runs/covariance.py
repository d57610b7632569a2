"""What a refit has left open, from the model that it ended with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from residnet.baselines.base import ParametricBaseline
from residnet.core.samples import Samples
from residnet.data.windows import WindowStore
from residnet.dynamics.hybrid import HybridDynamics
from residnet.training.offsets import Offsets
from residnet.training.refit import level_of, normal_equations
from residnet.training.refit_config import RefitConfig
from residnet.training.refit_problem import problem_of


class LeftOpen(NamedTuple):
    """What a refit has left open.

    Attributes:
        covariance: of the free parameters [P, P].
        square: mean square error of a channel of the free runs, in scales.
    """

    covariance: Tensor
    square: float


def left_open(
    model: HybridDynamics,
    samples: Samples,
    store: WindowStore,
    config: RefitConfig,
    scales: Tensor,
    still: Sequence[int],
) -> LeftOpen:
    """Return the covariance that a refit ends with, from one pass over its free runs.

    Args:
        model: a baseline without a head, after its refit.
        samples: of the refit.
        store: training windows of the refit, float64.
        config: of the refit.
        scales: of the velocities, [3].
        still: numbers of the free parameters that the refit has left at zero.
    """
    baseline = model.baseline
    assert isinstance(baseline, ParametricBaseline)
    problem = problem_of(model, baseline, samples, store, config, scales).at_rest(still)
    offsets = Offsets.begin(
        config.offsets, int(store.log.max()) + 1, scales / config.correlation, problem.speed
    )
    level, squares = level_of(model, problem, offsets)
    arrow = normal_equations(model, problem, baseline, level, squares, offsets)
    share = problem.share(level)
    inverse = torch.linalg.pinv(arrow.believing(offsets, share).reduced()[0], hermitian=True)
    inverse[problem.still] = 0.0
    inverse[:, problem.still] = 0.0
    return LeftOpen(share * inverse, float(level.square() - config.robust**2))
