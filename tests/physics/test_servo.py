"""How actuators follow their commands: closed forms of lags, limits and dead time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.physics.actuators.base import Servo, SteeringGearConfig

LIMIT = 0.6


def servo(**content: Any) -> Servo:
    config: SteeringGearConfig = validate({"limit": LIMIT} | content, SteeringGearConfig, "here")
    return config.servo("delta")


def follow(unit: Servo, command: np.ndarray, dt: float) -> np.ndarray:
    """Positions [T + 1] under commands [T] held over steps of dt, as a plant moves it: RK4, then
    what moves once per step.
    """
    a = torch.zeros(1, len(unit.state), dtype=torch.float64)
    out = []
    for value in command:
        c = torch.tensor([[value]], dtype=torch.float64)
        out.append(float(unit.value(a, c)))

        def rate(state: Tensor, c: Tensor = c) -> Tensor:
            return unit.rate(state, c)

        k1 = rate(a)
        k2 = rate(a + 0.5 * dt * k1)
        k3 = rate(a + 0.5 * dt * k2)
        k4 = rate(a + dt * k3)
        a = unit.advance(a + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), c, dt)
    return np.array(
        [*out, float(unit.value(a, torch.tensor([[command[-1]]], dtype=torch.float64)))]
    )


def step(value: float, steps: int = 300) -> np.ndarray:
    return np.full(steps, value)


T = 0.01 * np.arange(301)


def test_immediate_and_saturated() -> None:
    unit = servo()
    assert unit.state == ()
    np.testing.assert_array_equal(
        follow(unit, np.array([0.2, 5.0, -5.0]), 0.01), [0.2, LIMIT, -LIMIT, -LIMIT]
    )


def test_rate_limit() -> None:
    np.testing.assert_allclose(
        follow(servo(rate=0.5), step(0.4), 0.01), np.minimum(0.5 * T, 0.4), atol=1e-12
    )


def test_first_order() -> None:
    response = {"kind": "first_order", "time": "300 ms"}
    np.testing.assert_allclose(
        follow(servo(response=response), step(0.4), 0.01), 0.4 * (1 - np.exp(-T / 0.3)), atol=1e-8
    )
    # within a rate limit: along the limit until the lag asks for less
    limited = follow(servo(response=response, rate=0.5), step(0.4), 0.01)
    free = (0.4 - 0.5 * 0.3) / 0.5
    expected = np.where(free > T, 0.5 * T, 0.4 - 0.5 * 0.3 * np.exp(-(T - free) / 0.3))
    np.testing.assert_allclose(limited, expected, atol=2e-5)


def test_second_order() -> None:
    w, zeta = 4.0, 0.6
    found = follow(
        servo(response={"kind": "second_order", "frequency": w, "damping": zeta}), step(0.3), 0.01
    )
    wd = w * np.sqrt(1 - zeta**2)
    expected = 0.3 * (1 - np.exp(-zeta * w * T) * (np.cos(wd * T) + zeta * w / wd * np.sin(wd * T)))
    np.testing.assert_allclose(found, expected, atol=1e-7)
    assert servo(response={"kind": "second_order", "frequency": w, "damping": zeta}).state == (
        "delta",
        "_delta_rate",
    )


def test_second_order_within_its_rate_limit_and_without_wind_up() -> None:
    found = follow(
        servo(response={"kind": "second_order", "frequency": 6.0, "damping": 0.8}, rate=0.3),
        step(0.5),
        0.01,
    )
    assert np.diff(found).max() <= 0.3 * 0.01 * (1 + 1e-9)
    assert np.diff(found)[60:120] == pytest.approx(0.003, rel=1e-6)
    assert found.max() < 0.5 * 1.05
    assert found[-1] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    "rest", [{}, {"rate": 0.5}, {"response": {"kind": "first_order", "time": 0.3}}]
)
def test_dead_time_shifts_the_whole_answer(rest: dict[str, Any]) -> None:
    prompt = follow(servo(**rest), step(0.4), 0.01)
    late = follow(servo(dead_time="200 ms", delay_step="10 ms", **rest), step(0.4), 0.01)
    np.testing.assert_allclose(late[20:], prompt[:-20], atol=1e-12)
    np.testing.assert_array_equal(late[:20], np.zeros(20))


def test_a_delay_line_stepped_otherwise_stops() -> None:
    with pytest.raises(
        ConfigError, match=r"delay_step is 0.01 s, but the plant steps by 0.02 s; set delay_step"
    ) as caught:
        follow(servo(dead_time=0.2, delay_step=0.01), step(0.4), 0.02)
    assert "\n" not in str(caught.value)


def test_gradients_flow_through_lag_and_delay() -> None:
    unit = servo(
        dead_time=0.03,
        delay_step=0.01,
        response={"kind": "second_order", "frequency": 4.0, "damping": 0.6},
    )
    a = torch.tensor([[0.1, 0.2, 0.05, -0.1, 0.3]], dtype=torch.float64, requires_grad=True)
    c = torch.tensor([[0.2]], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(unit.rate, (a, c))
    assert torch.autograd.gradcheck(lambda s, x: unit.advance(s, x, 0.01), (a, c))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"dead_time": 0.2}, "belong together"),
        ({"dead_time": 0.2, "delay_step": 0.03}, "1 to 1000 times"),
        ({"dead_time": "-1 s"}, "dead_time"),
    ],
)
def test_wrong_servos_are_one_line(content: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        servo(**content)
    assert "\n" not in str(caught.value)
