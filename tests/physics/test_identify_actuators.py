"""Actuators found again from made tests of known ones, and tests that say too little."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from residnet.core.errors import FitError
from residnet.physics.actuators.identify import (
    IntervalEstimate,
    fit_step_response,
    fit_throttle_map,
    fit_thrust_curves,
)
from residnet.physics.vessel import load_vessel

CONFIG: Any = load_vessel("wam_v_cal").actuators
UNIT: Any = CONFIG.build()
SEEDS = range(20)
Trial = Any


def thrusts(test: Trial) -> Any:
    """Fit two propellers to revolutions and forces."""
    return fit_thrust_curves(test[0], test[1], 2)


def inside(estimate: IntervalEstimate, truth: float) -> bool:
    return estimate.low <= truth <= estimate.high


def throttle_test(seed: int = 0, top: float = 2380.0) -> Trial:
    throttle = np.linspace(-1, 1, 41)
    n = np.clip(2800 * throttle + 30, -top, top) / 60
    return throttle, n + np.random.default_rng(seed).normal(size=41) * 20 / 60


def test_throttle_map_with_its_bound_and_without() -> None:
    """20 rpm of noise: slope and bound to 1 %, and intervals that hold the truth about as often as
    they say.
    """
    held = 0
    for seed in SEEDS:
        fit = fit_throttle_map(*throttle_test(seed))
        assert fit.saturated
        assert fit.slope.value * 60 == pytest.approx(2800, rel=0.01)
        assert fit.n_max.value * 60 == pytest.approx(2380, rel=0.01)
        held += inside(fit.slope, 2800 / 60) + inside(fit.n_max, 2380 / 60)
        held += inside(fit.offset, 30 / 60)
    assert held >= 0.8 * 60
    fit = fit_throttle_map(*throttle_test(top=1e6))
    assert not fit.saturated
    assert fit.slope.value * 60 == pytest.approx(2800, rel=0.01)
    assert fit.n_max.value * 60 == pytest.approx(2830, rel=0.03)


def step_test(level: float, seed: int = 0, count: int = 300) -> Trial:
    """Times, commands and revolutions by the plant's own actuator, which hears commands 0.14 s
    late; 25 rpm of noise.
    """
    dt = 0.02
    late = 7
    t = dt * np.arange(300)
    command = np.where(t < 1.35, 0.0, level) / 60
    n, out = torch.zeros(1, 2, dtype=torch.float64), []
    for value in np.append(np.zeros(late), command[:-late]):
        out.append(float(n[0, 0]))
        n = UNIT.advance_step(n, torch.full((1, 2), value, dtype=torch.float64), dt)
    noise = np.random.default_rng([seed, level < 0]).normal(size=t.size) * 25.0 / 60
    return t[:count], command[:count], (np.array(out) + noise)[:count]


def test_rate_limit_and_dead_time() -> None:
    """At 50 Hz: 1500 rpm/s to 1 %, 0.14 s to one sample."""
    fits = [
        fit_step_response([step_test(level, seed) for level in (2380.0, -1800.0)])
        for seed in range(6)
    ]
    for fit in fits:
        assert fit.rate.value * 60 == pytest.approx(1500, rel=0.01)
        assert fit.dead_time.value == pytest.approx(0.14, abs=0.02)
    assert sum(inside(fit.rate, 25.0) for fit in fits) >= 4


def thrust(n: np.ndarray) -> np.ndarray:
    forces = UNIT.thruster_forces.thrust_at(torch.from_numpy(n)[:, None])
    return np.asarray(forces[:, 0])


def bollard_test(seed: int = 0, noise: float = 5.0) -> Trial:
    n = np.concatenate((np.linspace(-2380, -200, 12), np.linspace(200, 2380, 12))) / 60
    return n, 2 * thrust(n) + np.random.default_rng(seed).normal(size=n.size) * noise


def test_thrust_curves_of_both_directions() -> None:
    """Exact without noise; with 5 N on the tether the curve to 1.5 % of full thrust, and honest
    intervals.
    """
    truths = (CONFIG.forward, CONFIG.reverse)
    held = []
    for fit, truth in zip(thrusts(bollard_test(noise=0.0)), truths, strict=True):
        np.testing.assert_allclose([c.value for c in fit.coefficients], truth, rtol=1e-9)
    for seed in SEEDS:
        for fit, truth in zip(thrusts(bollard_test(seed)), truths, strict=True):
            n = np.linspace(fit.low, fit.high, 50)
            known = truth[0] + n * (truth[1] + n * truth[2])
            assert np.abs(fit(n) - known).max() < 0.03 * np.abs(thrust(n)).max()
            assert fit.rms == pytest.approx(2.5, rel=0.9)
            held += [inside(c, value) for c, value in zip(fit.coefficients, truth, strict=True)]
    assert 0.88 <= np.mean(held) <= 1.0


def ahead(test: Trial) -> Any:
    return [part[test[0] > 0] for part in test]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: thrusts(ahead(bollard_test())), "bollard pull astern: 0 points"),
        (lambda: thrusts([part[::8] for part in bollard_test()]), "needs 5 at 4 revolut"),
        (lambda: fit_thrust_curves(bollard_test()[0], -bollard_test()[1], 2), "wrong sign"),
        (lambda: fit_throttle_map(*(part[20:] for part in throttle_test())), "only one direction"),
        (lambda: fit_throttle_map(*(part[:3] for part in throttle_test())), "3 points"),
        (lambda: fit_throttle_map(throttle_test()[0], -throttle_test()[1]), "do not rise"),
        (lambda: fit_step_response([step_test(2380.0, count=10)]), "10 samples"),
        (lambda: fit_step_response([step_test(2380.0, count=60)]), "never changes"),
        (lambda: fit_step_response([step_test(2380.0, count=75)]), "hardly follow"),
    ],
)
def test_tests_that_say_too_little(call: Callable[[], object], message: str) -> None:
    with pytest.raises(FitError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
