"""How far outside the training range a gate keeps its residual, by what free runs say.

What holding the residual tells of measured accelerations says little of free runs: there an error
of sway becomes one of yaw, and a residual that lacks at some samples errs for the rest of the run.
Free runs over the validation logs, with inner boxes of the range in the part of the range, decide.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch

from residnet.core.samples import Samples
from residnet.dynamics.gate import GatedHead
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads import ZeroHead
from residnet.heads.base import ResidualHead
from residnet.training.module import Score

_BOXES = (0.05, 0.15, 0.25)
"""Quantiles at whose inner boxes fades are judged: what lies outside stands for the unseen."""
_KEPT = 0.5
"""Share of the best fade's gain on the baseline at which one that reaches farther is taken.

Inner boxes are left at small distances. Outside all data the distances are larger, and a fade that
loses little here loses more there.
"""
_LEAST = 1e-9


def reach_in_free_runs(
    model: HybridDynamics,
    samples: Samples,
    fades: Sequence[float],
    validate: Callable[[HybridDynamics], Score],
) -> dict[str, float]:
    """Let each axis reach at least as far as free runs beyond inner boxes of the range allow.

    Tried are the fades that the gate has, and for each of `fades` the same with no axis below it.
    The last of these that keeps half of the best one's gain on the baseline is taken. Where none
    gains, or where more free runs diverge than of the baseline, all axes fade at once.

    Args:
        model: with a gate whose fades are set; they are changed.
        samples: of the logs that `validate` runs over.
        fades: distances, in half widths of the range, at which half of the residual is left.
        validate: returns how a model does in free runs.

    Returns:
        The mean error over the boxes of each fade, in that of the baseline; `inf` where more free
        runs diverged.
    """
    assert isinstance(model.head, GatedHead)
    own = model.head.fade.clone()
    lengths = sorted(fades)
    tried = [torch.full_like(own, lengths[0]), *(own.clamp(min=fade) for fade in lengths)]
    boxes = [model.head.inner_box(samples.z, quantile) for quantile in _BOXES]
    none = validate(_with(model, ZeroHead()))
    error: list[float] = []
    for i, fade in enumerate(tried):
        if i > 1 and torch.equal(fade, tried[i - 1]):
            error.append(error[-1])
            continue
        scores = [validate(_with(model, model.head.within(*box, fade))) for box in boxes]
        sound = max(score.diverged for score in scores) <= none.diverged
        mean = sum(score.error for score in scores) / len(scores)
        error.append(mean / none.error if sound else math.inf)
    best = 1.0 - min(error)
    worth = [i for i, left in enumerate(error) if 1.0 - left >= _KEPT * best > 0]
    model.head.fade.copy_(tried[worth[-1] if worth else 0])
    names = ["at once", *(f"at least {fade:g}" for fade in lengths)]
    return dict(zip(names, error, strict=True))


def _with(model: HybridDynamics, head: ResidualHead) -> HybridDynamics:
    """Return the model with another head."""
    return HybridDynamics(model.signals, model.baseline, head, model.dt, model.integrator)
