"""Moments by fold, and how groups are dealt out to folds."""

from __future__ import annotations

import pytest
import torch

from residnet.core.errors import FitError
from residnet.regression.estimator import fold_numbers
from residnet.regression.shrinkage import FoldMoments


def test_a_group_is_never_split_between_folds() -> None:
    groups = torch.tensor([3, 3, 5, 5, 5, 7, 8, 8, 11])
    assert fold_numbers(groups, 2).tolist() == [0, 0, 1, 1, 1, 0, 1, 1, 0]
    assert fold_numbers(groups, None).tolist() == [0, 0, 1, 1, 1, 2, 3, 3, 4]


def test_too_few_groups_are_refused() -> None:
    groups = torch.tensor([0, 0, 1])
    with pytest.raises(FitError, match="3 folds need as many manoeuvres, the training data have 2"):
        fold_numbers(groups, 3)
    for one in (torch.zeros(4), None):
        with pytest.raises(FitError, match="one run or segment only"):
            fold_numbers(one, None)


def test_a_fold_is_left_out_by_subtraction() -> None:
    random = torch.Generator().manual_seed(0)
    x = torch.randn(60, 4, generator=random, dtype=torch.float64) + 100.0
    y = torch.randn(60, 2, generator=random, dtype=torch.float64) - 7.0
    fold = torch.arange(60) % 3
    moments = FoldMoments.gather(x, y, fold, 3)
    left = moments.without(1)
    kept_x, kept_y = x[fold != 1], y[fold != 1]
    e, f = kept_x - kept_x.mean(0), kept_y - kept_y.mean(0)
    assert left.samples == 40
    torch.testing.assert_close(left.mean_x + moments.shift_x, kept_x.mean(0))
    torch.testing.assert_close(left.xx, e.T @ e)
    torch.testing.assert_close(left.xy, e.T @ f)
    torch.testing.assert_close(moments.variance(), y.var(0, correction=0))
