"""Actuators found again from made tests of known ones, and tests that say too little."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

from residnet.core.errors import FitError
from residnet.physics.actuators import DifferentialThrustConfig, Thrusters
from residnet.physics.actuators.identify import (
    Estimate,
    fit_step,
    fit_throttle,
    fit_thrust,
    follow_command,
)
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel

SEEDS = range(20)


@pytest.fixture(scope="module")
def config() -> DifferentialThrustConfig:
    vessel = load_vessel("wam_v_cal")
    assert isinstance(vessel, FossenConfig)
    assert isinstance(vessel.actuators, DifferentialThrustConfig)
    return vessel.actuators


@pytest.fixture(scope="module")
def unit(config: DifferentialThrustConfig) -> Thrusters:
    return config.build()


def inside(estimate: Estimate, truth: float) -> bool:
    return estimate.low <= truth <= estimate.high


def throttle_test(seed: int, top: float = 2380.0) -> tuple[np.ndarray, np.ndarray]:
    throttle = np.linspace(-1, 1, 41)
    n = np.clip(2800 * throttle + 30, -top, top) / 60
    return throttle, n + np.random.default_rng(seed).normal(size=41) * 20 / 60


def test_throttle_map_with_its_bound() -> None:
    """20 rpm of noise: slope and bound to 1 %, and intervals that hold the truth about as often as
    they say.
    """
    fits = [fit_throttle(*throttle_test(seed)) for seed in SEEDS]
    for fit in fits:
        assert fit.saturated
        assert fit.slope.value * 60 == pytest.approx(2800, rel=0.01)
        assert fit.n_max.value * 60 == pytest.approx(2380, rel=0.01)
    held = [
        inside(f.slope, 2800 / 60) + inside(f.n_max, 2380 / 60) + inside(f.offset, 30 / 60)
        for f in fits
    ]
    assert sum(held) >= 0.8 * 60


def test_throttle_map_that_never_saturates() -> None:
    fit = fit_throttle(*throttle_test(0, top=1e6))
    assert not fit.saturated
    assert fit.slope.value * 60 == pytest.approx(2800, rel=0.01)
    assert fit.n_max.value * 60 == pytest.approx(2830, rel=0.03)


def shaft(unit: Thrusters, command: np.ndarray, dt: float, late: int) -> np.ndarray:
    """Revolutions [T] of one thruster under held commands, by the plant's own actuator after `late`
    samples of dead time.
    """
    delayed = np.concatenate((np.full(late, command[0]), command[: command.size - late]))
    n = torch.zeros(1, 2, dtype=torch.float64)
    out = []
    for value in delayed:
        out.append(float(n[0, 0]))
        n = unit.advance(n, torch.full((1, 2), value, dtype=torch.float64), dt)
    return np.array(out)


def step_test(
    unit: Thrusters, seed: int, noise: float = 25.0
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    dt, random = 0.02, np.random.default_rng(seed)
    t = dt * np.arange(300)
    runs = []
    for levels in ((0.0, 2380.0), (0.0, -1800.0)):
        command = np.where(t < 1.35, levels[0], levels[1]) / 60
        runs.append(
            (t, command, shaft(unit, command, dt, 7) + random.normal(size=t.size) * noise / 60)
        )
    return runs


def test_the_follower_is_the_plants_own(unit: Thrusters) -> None:
    (t, command, n), _ = step_test(unit, 0, noise=0.0)
    np.testing.assert_allclose(
        follow_command(t, command, 1500 / 60, 0.14, 0.0), n, atol=1500 / 60 * 0.02
    )


def test_rate_limit_and_dead_time(unit: Thrusters) -> None:
    """25 rpm of noise at 50 Hz: 1500 rpm/s to 1 %, 0.14 s to one sample."""
    fits = [fit_step(step_test(unit, seed)) for seed in range(6)]
    for fit in fits:
        assert fit.rate.value * 60 == pytest.approx(1500, rel=0.01)
        assert fit.dead_time.value == pytest.approx(0.14, abs=0.02)
    assert sum(inside(fit.rate, 25.0) for fit in fits) >= 4


def bollard_test(unit: Thrusters, seed: int, noise: float = 5.0) -> tuple[np.ndarray, np.ndarray]:
    n = np.concatenate((np.linspace(-2380, -200, 12), np.linspace(200, 2380, 12))) / 60
    pull = 2 * unit.forces.thrust(torch.from_numpy(n)[:, None])[:, 0].numpy()
    return n, pull + np.random.default_rng(seed).normal(size=n.size) * noise


def first_samples(unit: Thrusters, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The first times, commands and revolutions of a step response."""
    t, command, n = step_test(unit, 0)[0]
    return t[:count], command[:count], n[:count]


def test_thrust_curves_of_both_directions(
    config: DifferentialThrustConfig, unit: Thrusters
) -> None:
    """Exact without noise; with 5 N on the tether the curve to 1.5 % of full thrust, and honest
    intervals.
    """
    for fit, truth in zip(
        fit_thrust(*bollard_test(unit, 0, 0.0), 2), (config.forward, config.reverse), strict=True
    ):
        np.testing.assert_allclose([c.value for c in fit.coefficients], truth, rtol=1e-9)
    held = []
    for seed in SEEDS:
        for fit, truth in zip(
            fit_thrust(*bollard_test(unit, seed), 2), (config.forward, config.reverse), strict=True
        ):
            n = np.linspace(fit.low, fit.high, 50)
            full = np.abs(unit.forces.thrust(torch.from_numpy(n)[:, None])[:, 0].numpy()).max()
            known = truth[0] + n * (truth[1] + n * truth[2])
            assert np.abs(fit(n) - known).max() < 0.03 * full
            assert fit.rms == pytest.approx(2.5, rel=0.9)
            held += [inside(c, value) for c, value in zip(fit.coefficients, truth, strict=True)]
    assert 0.88 <= np.mean(held) <= 1.0


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda u: pulls(u, lambda n, pull: (n[n > 0], pull[pull > 0])), "astern: 0 points"),
        (lambda u: pulls(u, lambda n, pull: (n[::8], pull[::8])), "needs 5 at 4 revolutions"),
        (lambda u: pulls(u, lambda n, pull: (n, -pull)), "wrong sign"),
        (lambda u: fit_throttle(*(part[20:] for part in throttle_test(0))), "only one direction"),
        (lambda u: fit_throttle(*(part[:3] for part in throttle_test(0))), "3 points"),
        (lambda u: fit_throttle(throttle_test(0)[0], -throttle_test(0)[1]), "do not rise"),
        (lambda u: fit_step([first_samples(u, 10)]), "10 samples"),
        (lambda u: fit_step([first_samples(u, 60)]), "never changes"),
        (lambda u: fit_step([first_samples(u, 75)]), "hardly follow"),
    ],
)
def test_tests_that_say_too_little(
    unit: Thrusters, call: Callable[[Thrusters], object], message: str
) -> None:
    with pytest.raises(FitError, match=message) as caught:
        call(unit)
    assert "\n" not in str(caught.value)


def pulls(
    unit: Thrusters,
    change: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]],
) -> object:
    return fit_thrust(*change(*bollard_test(unit, 0)), 2)
