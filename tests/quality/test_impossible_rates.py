"""Speeds and turns that no vessel can do."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.log import Log
from residnet.quality import inspect_log

TIMES = np.arange(0.0, 100.0, 0.1)


def make_log(**channels: np.ndarray) -> Log:
    """Return a log of a straight run with some channels replaced."""
    zeros = np.zeros(TIMES.size)
    straight = {"x": 2.0 * TIMES, "y": zeros, "psi": zeros + 0.01 * np.sin(TIMES), "n": zeros + 5.0}
    return Log("run", TIMES, {**straight, **channels})


@pytest.mark.parametrize(
    ("channels", "text"),
    [
        ({"x": 2.0 * TIMES + 900.0 * (np.arange(TIMES.size) // 10 % 2)}, "the speed from x, y"),
        ({"psi": 11.0 * TIMES}, "the rate of psi"),
        ({"r": 10.7 * np.sign(np.sin(TIMES))}, "r reaches 613 deg/s"),
    ],
)
def test_impossible_rates_are_reported(channels: dict[str, np.ndarray], text: str) -> None:
    (finding,) = inspect_log(make_log(**channels), ["n"]).find_by_code("impossible_rate")
    assert finding.level == "will mislead"
    assert text in finding.text


def test_possible_rates_and_single_outliers_are_not_reported() -> None:
    x = 30.0 * TIMES
    x[100] += 5000.0
    log = make_log(x=x, r=0.5 * np.sin(TIMES))
    assert inspect_log(log, ["n"]).find_by_code("impossible_rate") == ()
