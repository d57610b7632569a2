"""A check that a force model still fits new logs, which triggers an update (document 002 3.7)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from pydantic import Field
from torch import Tensor

from residnet.core.config import Config
from residnet.core.errors import DataError


class StillFitsConfig(Config):
    """Settings of the check: on some axis the residual has grown by `factor` and is no trifle.

    Attributes:
        factor: of the mean square residual of the stretch it is compared with.
        share: of the variance of the force, below which a residual does not matter.
        segments: share of the segments of an axis that must show both, so that one gust or one wake
            is no reason.
    """

    factor: float = Field(default=4.0, gt=1)
    share: float = Field(default=0.02, gt=0, lt=1)
    segments: float = Field(default=0.5, gt=0, le=1)


@dataclass(frozen=True)
class Verdict:
    """What was found, by axis.

    Attributes:
        fits: whether the model may stay.
        growth: mean square residual now over then [3].
        share: mean square residual now over the force's variance [3].
        segments: share of segments that show a worse fit [3].
    """

    fits: bool
    growth: list[float]
    share: list[float]
    segments: list[float]

    def text(self) -> str:
        """Return one line about it."""
        growth, share = (
            "/".join(f"{value:.3g}" for value in part)
            for part in (self.growth, [100 * value for value in self.share])
        )
        sentence = "still fits" if self.fits else "no longer fits: identify it again from this log"
        return (
            f"{sentence} (residual {growth} times what it was, {share} % of the force's variance;"
            " surge/sway/yaw)"
        )


def still_fits(
    config: StillFitsConfig, then: Tensor, now: Tensor, force: Tensor, fold: Tensor
) -> Verdict:
    """Return whether a model still fits, by comparing residuals.

    Args:
        config: limits.
        then: residual on data that the model was accepted on [N, 3].
        now: residual on new data [M, 3].
        force: of the new data [M, 3].
        fold: segment of each new sample [M].

    Raises:
        DataError: where the new data are empty or not finite, or their force does not vary.
    """
    if len(now) == 0 or not bool(torch.isfinite(now).all()):
        raise DataError(
            "the new log has no samples or a residual that is not finite; mask it before it is"
            " judged"
        )
    variance, before = force.var(0), then.square().mean(0)
    if bool((variance <= 0).any()):
        raise DataError(
            "the force of the new log does not vary on some axis: nothing can be sentence about the"
            " model; give a log with manoeuvres"
        )
    by_segment = torch.stack([now[fold == f].square().mean(0) for f in torch.unique(fold)])
    worse = (
        ((by_segment > config.factor * before) & (by_segment > config.share * variance))
        .to(torch.float64)
        .mean(0)
    )
    mean = now.square().mean(0)
    grown = (
        (mean > config.factor * before)
        & (mean > config.share * variance)
        & (worse >= config.segments)
    )
    growth = mean / before.clamp(min=1e-300)
    return Verdict(
        not bool(grown.any()), growth.tolist(), (mean / variance).tolist(), worse.tolist()
    )
