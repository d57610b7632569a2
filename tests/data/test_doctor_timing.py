"""Whether inputs stand on the clock of the motion: repeated manoeuvres, early and late answers."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.log import Log
from residnet.data.doctor import inspect
from residnet.data.doctor.actuators import delay_of
from residnet.data.doctor.statistics import Record

_STEP = 0.1


def steered_log(delta: np.ndarray, late: float) -> Log:
    """A first-order answer in yaw (K .3 1/s, T 1.2 s) to a rudder [T] that was given earlier."""
    t = _STEP * np.arange(delta.size)
    acting = np.interp(t - late, t, delta)
    r = np.zeros(delta.size)
    for k in range(delta.size - 1):
        r[k + 1] = r[k] + _STEP / 1.2 * (0.3 * acting[k] - r[k])
    noise = np.random.default_rng(5).normal(0.0, 2e-4, (2, delta.size))
    return Log("one", t, {"u": 1.0 + noise[0], "r": r + noise[1], "delta": delta})


def zigzag(period: float) -> np.ndarray:
    """A rudder that goes from side to side for 80 s, the same each time."""
    t = _STEP * np.arange(800)
    return 0.35 * np.clip(8.0 * np.sin(2.0 * np.pi * t / period), -1.0, 1.0)


@pytest.mark.parametrize("period", [5.8, 8.4, 11.0])
@pytest.mark.parametrize("late", [0.1, 0.4])
def test_a_manoeuvre_that_repeats_itself_is_not_answered_half_a_period_early(
    period: float, late: float
) -> None:
    log = steered_log(zigzag(period), late)
    delay = delay_of(Record(log), ("delta",), "r")
    assert delay is not None
    assert delay.seconds == pytest.approx(late, abs=0.25)
    assert not inspect(log).find("acausal")


@pytest.mark.parametrize("early", [0.8, 1.6])
def test_an_answer_before_the_input_is_found(early: float) -> None:
    rng = np.random.default_rng(3)
    delta = np.repeat(rng.uniform(-0.4, 0.4, 40), 20)
    (finding,) = inspect(steered_log(delta, -early)).find("acausal")
    assert finding.level == "will mislead"
    assert finding.figures["lag"] == pytest.approx(-early, abs=0.25)
