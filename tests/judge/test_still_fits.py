"""The trigger of an update against residuals that were made to grow."""

from __future__ import annotations

import pytest
import torch

from residnet.core.errors import DataError
from residnet.documents.jervan2020.ferry import StillFitsConfig, still_fits

N = 600
FOLD = torch.arange(N) // 100


def residual(scale: float, seed: int = 0) -> torch.Tensor:
    return scale * torch.randn(
        N, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


FORCE = residual(100.0, 9)


def test_the_same_noise_is_no_reason() -> None:
    verdict = still_fits(StillFitsConfig(), residual(20.0), residual(20.0, 1), FORCE, FOLD)
    assert verdict.fits
    assert verdict.growth == pytest.approx([1.0] * 3, rel=0.3)


def test_growth_on_one_axis_is() -> None:
    now = residual(20.0, 1)
    now[:, 1] *= 3
    verdict = still_fits(StillFitsConfig(), residual(20.0), now, FORCE, FOLD)
    assert not verdict.fits
    assert verdict.segments == [0.0, 1.0, 0.0]
    assert "no longer fits" in verdict.text()


def test_a_trifle_or_one_gust_is_not() -> None:
    assert still_fits(StillFitsConfig(), residual(0.1), residual(1.0, 1), FORCE, FOLD).fits, (
        "one percent of the force"
    )
    gust = residual(20.0, 1)
    gust[:100] *= 6
    assert still_fits(StillFitsConfig(), residual(20.0), gust, FORCE, FOLD).fits


def test_nothing_can_be_said_without_force() -> None:
    with pytest.raises(DataError, match="does not vary"):
        still_fits(
            StillFitsConfig(),
            residual(1.0),
            residual(1.0),
            torch.zeros(N, 3, dtype=torch.float64),
            FOLD,
        )
    with pytest.raises(DataError, match="not finite"):
        still_fits(StillFitsConfig(), residual(1.0), residual(1.0) * torch.nan, FORCE, FOLD)
