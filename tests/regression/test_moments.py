"""Moments by fold, and how groups are dealt out to folds."""

from __future__ import annotations

import pytest
import torch

from residnet.core.errors import FitError
from residnet.regression.estimator import fold_numbers


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
