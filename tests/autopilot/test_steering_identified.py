"""K, T and delay from logs of Nomoto's equation that the test integrates itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from steered_logs import steered_log

from residnet.autopilot.heading.set_points import fit_with_set_points
from residnet.autopilot.heading.turning import ManoeuvreRecord, fit_response
from residnet.autopilot.tasks.design import identify_steering
from residnet.core.errors import DataError, FitError
from residnet.core.log import Log
from residnet.core.progress import on_progress


def sailed(
    gain: float, time: float, delay: float, bias: float, noise: float, seed: int, gear: Any = 9e9
) -> Log:
    """A zigzag of T r_dot + r = K (delta(t - delay) + bias), by Euler's rule in small steps."""
    dt = 0.5
    fine = 50
    rng = np.random.default_rng(seed)
    rate = 0.01
    heading = 0.0
    rudder = 0.0
    side = 1.0
    commands = []
    rates = []
    held = [0.0] * max(round(delay / dt * fine), 1)
    for _ in range(800):
        if side * heading > math.radians(20):
            side = -side
        commands.append(side * math.radians(10))
        rates.append(rate)
        for _ in range(fine):
            held.append(commands[-1])
            wanted = held[-1 - round(delay / dt * fine)]
            most = gear * dt / fine
            rudder += min(max(wanted - rudder, -most), most)
            rate += dt / fine * (gain * (rudder + bias) - rate) / time
            heading += dt / fine * rate
    values = np.array(rates) + noise * rng.normal(size=len(rates))
    channels = {"r": values, "cmd_delta": np.array(commands), "u": np.full(len(rates), 7.0)}
    return Log(f"log{seed}", dt * np.arange(len(rates)), channels)


def test_gain_time_constant_delay_and_bias_are_found() -> None:
    logs = [sailed(0.12, 18.0, 1.5, 0.01, 2e-4, seed) for seed in (0, 1)]
    found, speed, noise, *_ = identify_steering(logs, longest_delay=5.0)
    assert noise[1] == pytest.approx(2e-4, rel=0.1)
    assert found.rate is None
    assert found.standard_errors[0] < 0.01 * found.gain
    assert found.gain == pytest.approx(0.12, rel=0.02)
    assert found.time == pytest.approx(18.0, rel=0.03)
    assert found.delay == pytest.approx(1.5, abs=0.3)
    assert found.bias == pytest.approx(0.01, abs=1e-3)
    assert found.rms == pytest.approx(2e-4, rel=0.2)
    assert speed == pytest.approx(7.0)


def test_the_rate_of_the_rudder_does_not_count_as_time_constant() -> None:
    logs = [sailed(0.31, 7.4, 0.3, 0.0, 2e-3, seed, gear=math.radians(6)) for seed in (0, 1)]
    found = identify_steering(logs).response
    assert found.time == pytest.approx(7.4, rel=0.05)
    assert found.rate == pytest.approx(math.radians(6), rel=0.1)
    assert found.gain == pytest.approx(0.31, rel=0.02)


def test_what_is_no_response_to_the_rudder_is_refused() -> None:
    log = sailed(0.12, 18.0, 0.0, 0.0, 0.0, 0)
    turned = {**log.channels, "cmd_delta": -log["cmd_delta"]}
    still = {**log.channels, "cmd_delta": np.zeros(len(log))}
    for channels, error, told in (
        (turned, FitError, "sign"),
        (still, DataError, "zigzag"),
        ({"u": log["u"]}, DataError, "yaw rate"),
    ):
        with pytest.raises(error, match=told):
            identify_steering([log.replace(channels=channels)])


def test_a_rudder_that_a_controller_set_is_refused() -> None:
    logs = [steered_log("controller", seed) for seed in (0, 1)]
    with pytest.raises(DataError, match="a controller set the rudder"):
        identify_steering(logs)
    found = identify_steering([steered_log("set_points", seed) for seed in (0, 1)])
    assert found.response.gain == pytest.approx(0.7, rel=0.1)


def test_set_points_identify_a_rudder_that_a_controller_set() -> None:
    # disturbances as large as the steps of the course, so that the direct fit is biased
    logs = [steered_log("set_points", seed, disturbance=0.1) for seed in range(5)]
    messages: list[str] = []
    with on_progress(lambda event: messages.append(event.message)):
        response = identify_steering(logs).response
    assert any("Durbin-Wu-Hausman test" in message for message in messages)
    assert response.gain == pytest.approx(0.7, rel=0.1)
    assert response.time == pytest.approx(0.8, rel=0.2)
    assert abs(response.gain - 0.7) < 3.0 * response.standard_errors[0]
    # without the set point the same logs give a gain that is a third too small
    without = [
        log.replace(channels={k: v for k, v in log.channels.items() if k != "psi_d"})
        for log in logs
    ]
    assert identify_steering(without).response.gain < 0.55


def test_set_points_without_disturbances_confirm_the_direct_estimate() -> None:
    logs = [steered_log("set_points", seed, disturbance=0.0) for seed in range(4)]
    records = [
        ManoeuvreRecord(0.1, log["delta"], log["r"], np.ones(len(log), dtype=bool)) for log in logs
    ]
    direct = fit_response(records, 2.0)
    instrumented = fit_with_set_points(records, [log["psi_d"] for log in logs], 2.0)
    assert instrumented.instrument_share > 0.9
    assert instrumented.response.gain == pytest.approx(direct.gain, rel=0.02)


def test_a_set_point_without_steps_identifies_nothing() -> None:
    logs = [steered_log("controller", seed) for seed in range(3)]
    constant = [log.replace(channels={**log.channels, "psi_d": np.zeros(len(log))}) for log in logs]
    with pytest.raises(DataError, match="psi_d explains 0 % of the rudder"):
        identify_steering(constant)
