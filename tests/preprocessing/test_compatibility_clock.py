"""The offset between two clocks from a heading on one and a yaw rate on the other."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.core.log import Log
from residnet.io.readers.joined_files import estimate_clock_from_turns
from residnet.preprocessing.compatibility.clock import estimate_clock_from_rate


def simulate_turns(
    rng: np.random.Generator, duration: float, period: float = 4.0, rate: float = 0.15
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times at 20 Hz, heading in rad and yaw rate in rad/s of irregular turns."""
    t = np.arange(0.0, duration, 0.05)
    knots = np.arange(-3.0 * period, duration + 3.0 * period, period)
    yaw_rate = np.interp(t, knots, rng.normal(0.0, rate, knots.size))
    heading = np.append(0.0, np.cumsum(0.025 * (yaw_rate[1:] + yaw_rate[:-1])))
    return t, heading, yaw_rate


@pytest.mark.parametrize("seed", range(20))
def test_offset_up_to_an_hour_with_bias_drift_and_dropouts(seed: int) -> None:
    rng = np.random.default_rng(seed)
    duration = float(rng.uniform(60.0, 1500.0))
    t, heading, yaw_rate = simulate_turns(rng, duration)
    offset = float(rng.uniform(-3600.0, 3600.0))
    drift = float(rng.uniform(-1e-4, 1e-4))
    heading_times = t[:: int(rng.integers(4, 20))]
    measured_heading = np.interp(heading_times, t, heading)
    measured_heading += rng.normal(0.0, 0.015, heading_times.size)
    # the board starts later or earlier, and misses some seconds
    start, stop = np.sort(rng.uniform(0.0, duration, 2)) if seed % 2 else (0.0, duration)
    if stop - start < 0.5 * duration:
        start = 0.0
        stop = duration
    is_recorded = (t >= start) & (t <= stop) & (np.abs(t - 0.4 * duration) > 2.0)
    rate_times = t[is_recorded][::2]
    measured_rate = 0.95 * yaw_rate[is_recorded][::2] + 0.01
    measured_rate += rng.normal(0.0, 0.01, rate_times.size)
    board_times = rate_times * (1.0 + drift) - offset
    estimate = estimate_clock_from_rate(heading_times, measured_heading, board_times, measured_rate)
    assert estimate is not None
    assert estimate.margin > 8.0
    errors = estimate.convert_times(board_times) - rate_times
    assert float(np.sqrt(np.mean(errors**2))) < 0.08


@pytest.mark.parametrize("seed", range(6))
def test_offset_of_slow_turns_within_the_noise_of_the_derivative(seed: int) -> None:
    rng = np.random.default_rng(300 + seed)
    t, heading, yaw_rate = simulate_turns(rng, 240.0, period=20.0, rate=0.025)
    noisy_heading = heading[::4] + rng.normal(0.0, 0.01, t[::4].size)
    noisy_rate = yaw_rate[::2] + rng.normal(0.0, 0.01, t[::2].size)
    estimate = estimate_clock_from_rate(t[::4], noisy_heading, t[::2] - 1234.5, noisy_rate)
    assert estimate is not None
    assert estimate.margin > 8.0
    assert abs(estimate.correlation) > 0.7
    assert abs(estimate.seconds - 1234.5) < min(4.0 * estimate.standard_error, 1.0)


def test_offset_has_a_calibrated_standard_error() -> None:
    scores = []
    for seed in range(40):
        rng = np.random.default_rng(100 + seed)
        t, heading, yaw_rate = simulate_turns(rng, 120.0)
        noisy_heading = heading[::4] + rng.normal(0.0, 0.02, t[::4].size)
        noisy_rate = yaw_rate + rng.normal(0.0, 0.01, t.size)
        estimate = estimate_clock_from_rate(t[::4], noisy_heading, t - 7.3, noisy_rate)
        assert estimate is not None
        scores.append((estimate.seconds - 7.3) / estimate.standard_error)
    covered = float(np.mean(np.abs(scores) < 1.96))
    assert 0.85 <= covered <= 1.0


def test_straight_runs_and_short_recordings_give_no_offset() -> None:
    t = np.arange(0.0, 100.0, 0.1)
    assert estimate_clock_from_rate(t, np.zeros(t.size), t, np.zeros(t.size)) is None
    assert estimate_clock_from_rate(t[:20], t[:20], t, np.sin(t)) is None


def test_turns_of_another_run_have_no_margin() -> None:
    t, heading, _ = simulate_turns(np.random.default_rng(6), 100.0)
    _, _, other_rate = simulate_turns(np.random.default_rng(7), 100.0)
    estimate = estimate_clock_from_rate(t, heading, t, other_rate)
    assert estimate is not None
    assert estimate.margin < 8.0 or abs(estimate.correlation) < 0.7


@pytest.mark.parametrize(("first", "second"), [("psi", "r"), ("r", "psi"), ("psi", "psi")])
def test_any_pair_of_heading_and_yaw_rate_aligns_two_logs(first: str, second: str) -> None:
    t, heading, yaw_rate = simulate_turns(np.random.default_rng(5), 200.0)
    rng = np.random.default_rng(1)
    channels = {"psi": heading, "r": yaw_rate}
    stds = {"psi": 0.005, "r": 0.01}

    def record(name: str, times: np.ndarray) -> Log:
        noisy = channels[name] + rng.normal(0.0, stds[name], t.size)
        return Log(name, times, {name: noisy})

    estimate = estimate_clock_from_turns(record(first, t), record(second, t - 31.7))
    assert estimate is not None
    assert estimate.seconds == pytest.approx(31.7, abs=0.05)
    straight = Log("straight", t, {second: np.zeros(t.size)})
    assert estimate_clock_from_turns(record(first, t), straight) is None
    assert estimate_clock_from_turns(record(first, t), Log("n", t, {"n": t})) is None
