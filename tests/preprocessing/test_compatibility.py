"""Instrument errors and meanings of channels from the kinematics of simulated boats."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from simulated_motion import BOATS, TrueMotion, simulate_motion

from residnet.core.errors import DataError
from residnet.preprocessing.compatibility.estimates import Prior, Reconstruction
from residnet.preprocessing.compatibility.hypotheses import (
    MIN_MARGIN,
    Hypothesis,
    choose_stretch,
    compare,
)
from residnet.preprocessing.compatibility.reconstruction import reconstruct
from residnet.preprocessing.compatibility.sensors import Sensor, SensorKind

TIMES = np.arange(1.0, 99.0, 0.4)
PRIORS = {
    "forward": Prior(0.0, 2.0),
    "starboard": Prior(0.0, 2.0),
    "heading_offset": Prior(0.0, 0.5),
    "rate_bias": Prior(0.0, 0.05),
    "rate_scale": Prior(0.0, 0.3),
    "rate_clock": Prior(0.0, 1.0),
    "surge_scale": Prior(0.0, 0.3),
    "sway_scale": Prior(0.0, 0.3),
}
ERROR_STDS = dict(
    zip(PRIORS, (1.0, 1.0, 0.03, 0.01, 0.03, 0.2, 0.03, 0.1), strict=True),
)
N_DRAWS = 24
"""Draws of each boat; the standard error of a coverage of 95 % is then below 2 %."""
STEPS = {"dinghy": 0.2, "catamaran": 0.4, "tanker": 0.5}
"""Time between nodes in s, which resolves the yaw response of each boat."""


def measure(motion: TrueMotion, rng: np.random.Generator, errors: dict[str, float]) -> list[Sensor]:
    """Return noisy sensors with instrument errors."""
    psi = motion.sample("psi", TIMES)
    lever_arm = (errors["forward"] + 1j * errors["starboard"]) * np.exp(1j * psi)
    position = np.stack(
        (
            motion.sample("x", TIMES) + lever_arm.real,
            motion.sample("y", TIMES) + lever_arm.imag,
        ),
        axis=1,
    )

    def add_noise(values: np.ndarray, std: float) -> np.ndarray:
        return values + rng.normal(0.0, std, values.shape)

    rate = motion.sample("r", TIMES + errors["rate_clock"])
    rate = (1.0 + errors["rate_scale"]) * rate + errors["rate_bias"]
    surge = (1.0 + errors["surge_scale"]) * motion.sample("u", TIMES)
    sway = (1.0 + errors["sway_scale"]) * motion.sample("v", TIMES)
    return [
        Sensor("position", TIMES, add_noise(position, 0.05), lever_arm=("forward", "starboard")),
        Sensor(
            "heading",
            TIMES,
            add_noise(psi + errors["heading_offset"], 0.01),
            bias="heading_offset",
        ),
        Sensor(
            "yaw_rate",
            TIMES,
            add_noise(rate, 0.005),
            bias="rate_bias",
            scale="rate_scale",
            clock="rate_clock",
        ),
        Sensor("surge", TIMES, add_noise(surge, 0.03), scale="surge_scale"),
        Sensor("sway", TIMES, add_noise(sway, 0.03), scale="sway_scale"),
    ]


@cache
def draw(boat: str, seed: int) -> tuple[Reconstruction, dict[str, float]]:
    """Return the reconstruction of a random run, and its true errors."""
    rng = np.random.default_rng(seed)
    motion = simulate_motion(BOATS[boat], rng, duration=100.0)
    errors = {name: float(rng.normal(0.0, std)) for name, std in ERROR_STDS.items()}
    return reconstruct(measure(motion, rng, errors), PRIORS, STEPS[boat]), errors


@pytest.mark.long
@pytest.mark.parametrize("boat", BOATS)
def test_intervals_of_determined_errors_cover_the_truth(boat: str) -> None:
    covered = []
    n_determined = 0
    for seed in range(N_DRAWS):
        estimate, errors = draw(boat, seed)
        for name, error in estimate.errors.items():
            if error.is_determined:
                n_determined += 1
                deviation = abs(error.value - errors[name])
                covered.append(deviation < 1.96 * error.standard_error)
    assert n_determined > 3 * N_DRAWS
    assert 0.88 <= float(np.mean(covered)) <= 0.99


def test_rotation_of_the_frame_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    motion = simulate_motion(BOATS["dinghy"], rng, duration=100.0)
    errors = dict.fromkeys(PRIORS, 0.0) | {"forward": 1.2, "heading_offset": 0.05}
    sensors = measure(motion, rng, errors)
    angle = 2.1
    position, heading, *others = sensors
    rotated = (position.values[:, 0] + 1j * position.values[:, 1]) * np.exp(1j * angle)
    turned = [
        Sensor(
            "position",
            position.t,
            np.stack((rotated.real, rotated.imag), axis=1),
            lever_arm=position.lever_arm,
        ),
        Sensor("heading", heading.t, heading.values + angle, bias=heading.bias),
        *others,
    ]
    first = reconstruct(sensors, PRIORS, 0.5)
    second = reconstruct(turned, PRIORS, 0.5)
    for name, error in first.errors.items():
        assert second.errors[name].value == pytest.approx(
            error.value, abs=0.1 * error.standard_error
        )
    assert second.deviance == pytest.approx(first.deviance, abs=2.0)


def test_unmeasured_sway_is_determined_by_smoothness_only() -> None:
    rng = np.random.default_rng(4)
    motion = simulate_motion(BOATS["dinghy"], rng, duration=100.0)
    position, heading, rate, *_ = measure(motion, rng, dict.fromkeys(PRIORS, 0.0))
    estimate = reconstruct([position, heading, rate], PRIORS, 0.5)
    assert not estimate.errors["heading_offset"].is_determined
    assert estimate.errors["rate_bias"].standard_error < 0.01


def test_current_between_water_and_ground() -> None:
    rng = np.random.default_rng(5)
    motion = simulate_motion(BOATS["catamaran"], rng, duration=100.0, current=(0.3, -0.2))
    sensors = measure(motion, rng, dict.fromkeys(PRIORS, 0.0))
    sensors = [
        Sensor(s.kind, s.t, s.values, is_through_water=s.kind in ("surge", "sway")) for s in sensors
    ]
    priors = dict.fromkeys(("current_north", "current_east"), Prior(0.0, 0.5))
    estimate = reconstruct(sensors, priors, 0.5).errors
    for name, truth in (("current_north", 0.3), ("current_east", -0.2)):
        assert estimate[name].is_significant
        assert abs(estimate[name].value - truth) < 3.0 * estimate[name].standard_error


def describe_velocities(
    motion: TrueMotion, rng: np.random.Generator, *, is_earth_fixed: bool
) -> dict[str, Hypothesis]:
    """Return both meanings of two columns of velocities."""
    t = TIMES
    psi = motion.sample("psi", t)
    velocity = motion.sample("u", t) + 1j * motion.sample("v", t)
    velocity = velocity * np.exp(1j * psi) if is_earth_fixed else velocity
    pose = np.stack((motion.sample("x", t), motion.sample("y", t)), axis=1)
    pose = pose + rng.normal(0.0, 0.1, pose.shape)
    heading = psi + rng.normal(0.0, 0.01, t.size)
    columns = [part + rng.normal(0.0, 0.03, t.size) for part in (velocity.real, velocity.imag)]
    meanings: dict[str, tuple[SensorKind, SensorKind]] = {
        "body": ("surge", "sway"),
        "earth": ("north", "east"),
        "exchanged": ("east", "north"),
    }
    return {
        name: Hypothesis(
            [
                Sensor("position", t, pose),
                Sensor("heading", t, heading),
                *(Sensor(kind, t, column) for kind, column in zip(kinds, columns, strict=True)),
            ]
        )
        for name, kinds in meanings.items()
    }


@pytest.mark.parametrize("boat", BOATS)
@pytest.mark.parametrize("is_earth_fixed", [False, True])
def test_frame_of_velocities_is_chosen_by_a_margin(boat: str, is_earth_fixed: bool) -> None:
    rng = np.random.default_rng(6)
    motion = simulate_motion(BOATS[boat], rng, duration=100.0)
    ranking = compare(describe_velocities(motion, rng, is_earth_fixed=is_earth_fixed), 0.5)
    assert ranking[0].name == ("earth" if is_earth_fixed else "body")
    assert ranking[1].margin > 10.0 * MIN_MARGIN


def test_gaps_wraps_and_outliers_do_not_move_the_errors() -> None:
    rng = np.random.default_rng(8)
    motion = simulate_motion(BOATS["catamaran"], rng, duration=100.0)
    errors = dict.fromkeys(PRIORS, 0.0) | {"rate_bias": 0.02, "starboard": -0.8}
    damaged = []
    for sensor in measure(motion, rng, errors):
        values = sensor.values.copy().reshape(TIMES.size, -1)
        if sensor.kind == "heading":
            values = np.remainder(values, 2.0 * np.pi)
        values[60:75] = np.nan
        if sensor.kind in ("position", "surge"):
            values[rng.choice(TIMES.size, 5, replace=False)] += 4.0
        damaged.append(
            Sensor(
                sensor.kind,
                TIMES,
                values,
                bias=sensor.bias,
                scale=sensor.scale,
                clock=sensor.clock,
                lever_arm=sensor.lever_arm,
            )
        )
    estimate = reconstruct(damaged, PRIORS, 0.5).errors
    for name, truth in (("rate_bias", 0.02), ("starboard", -0.8)):
        assert abs(estimate[name].value - truth) < 4.0 * estimate[name].standard_error


def test_too_few_values_and_too_long_logs_are_refused() -> None:
    t = np.arange(5.0)
    pose = Sensor("position", TIMES, np.zeros((TIMES.size, 2)))
    with pytest.raises(DataError, match="at least 20 values each"):
        reconstruct([pose, Sensor("heading", t, t)], {}, 0.5)
    with pytest.raises(DataError, match="increase the step"):
        reconstruct([pose, Sensor("heading", TIMES, TIMES)], {}, 1e-4)


def test_the_liveliest_stretch_is_chosen() -> None:
    t = np.arange(0.0, 1000.0, 0.5)
    activity = (np.abs(t - 700.0) < 40.0).astype(np.float64)
    start, stop = choose_stretch(t, activity, 0.5)
    assert start < 660.0
    assert stop > 740.0
    assert choose_stretch(t[:100], activity[:100], 0.5) == (0.0, 49.5)
