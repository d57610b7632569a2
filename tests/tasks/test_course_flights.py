"""The spread of vessels and currents that a course is flown over."""

from __future__ import annotations

import math

import pytest
import torch
from pydantic import ValidationError

from residnet.tasks.course import CourseSpreadConfig


def test_vessels_and_currents_fill_their_ranges_and_come_again_with_their_seed() -> None:
    spread = CourseSpreadConfig(
        flights=2000, seed=3, effect=(0.8, 1.1), time=(0.9, 1.3), bias=0.01, current=0.4
    )
    variation, current = spread.draw()
    assert variation.amin(0).tolist() == pytest.approx([0.8, 0.9, -0.01], abs=2e-3)
    assert variation.amax(0).tolist() == pytest.approx([1.1, 1.3, 0.01], abs=2e-3)
    assert current.norm(dim=1).tolist() == pytest.approx([0.4] * 2000)
    # from all directions alike: the mean of unit vectors has a standard deviation of 1/sqrt(2 N)
    # each way
    assert current.mean(0).abs().max() < 0.4 * 4 / math.sqrt(4000)
    again = CourseSpreadConfig(
        flights=2000, seed=3, effect=(0.8, 1.1), time=(0.9, 1.3), bias=0.01, current=0.4
    ).draw()
    assert torch.equal(again.variation, variation)
    assert not torch.equal(CourseSpreadConfig(flights=2000, seed=4).draw().current, current)


def test_ranges_out_of_order_are_refused() -> None:
    with pytest.raises(ValidationError, match="effect: low and high"):
        CourseSpreadConfig(effect=(1.1, 0.9))
