"""Actuators: printed curves, momentum theory, and closed forms of lags, limits and dead time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from kinds import of_kind
from torch import Tensor

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.physics.actuators import RudderPropellerConfig, ThrustersConfig
from residnet.physics.actuators.base import Servo, SteeredActuators
from residnet.physics.actuators.config import SteeringGearConfig
from residnet.physics.actuators.thrusters import Thrusters
from residnet.physics.vessel import load_vessel


@pytest.fixture(scope="module")
def twin() -> Thrusters:
    return of_kind(load_vessel("wam_v_cal").actuators.build(), Thrusters)


def test_the_catamarans_curve_is_the_printed_one(twin: Thrusters) -> None:
    """Document 003 eqs. (21), (22) in rpm; clipped it is zero from -60.6 to 44.4 rpm and never
    opposes the revolutions (correction W5).
    """
    rpm = np.linspace(-2380, 2380, 20_001)
    thrust = twin.thruster_forces.thrust_at(torch.from_numpy(rpm / 60)[:, None])[:, 0].numpy()
    ahead = rpm >= 45
    astern = rpm <= -61
    dead = (rpm > -60) & (rpm < 44)
    forward = [3.54e-5, 0.084, -3.798]
    reverse = [-1.189e-5, 0.0707, 4.331]
    np.testing.assert_allclose(thrust[ahead], np.polyval(forward, rpm[ahead]), rtol=1e-4)
    np.testing.assert_allclose(thrust[astern], np.polyval(reverse, rpm[astern]), 1e-3, 1e-3)
    assert not thrust[dead].any()
    assert (np.diff(thrust) >= 0).all()
    assert (thrust * rpm >= 0).all()


def test_revolutions_keep_to_their_rate(twin: Thrusters) -> None:
    """From rest to full in 2380 / 1500 = 1.59 s, a reversal in 3.17 s (correction W7)."""
    full = 2380.0 / 60.0
    n = torch.zeros(1, 2, dtype=torch.float64)
    for sign, least in ((1.0, 159), (-1.0, 317)):
        command = sign * torch.tensor([[full, -full]], dtype=torch.float64)
        steps = 0
        while not torch.equal(n, command):
            before = n
            n = twin.advance_step(n, command, 0.01)
            assert bool(((n - before).abs() <= 0.25 + 1e-12).all())
            steps += 1
        assert steps - least in (0, int(sign < 0))


def thrusters(*units: dict[str, Any]) -> Thrusters:
    curve = {"n_max": 10.0, "forward": [0.0, 0.0, 2.0], "reverse": [0.0, 0.0, -1.0]}
    content = {"kind": "thrusters", "source": "made", "thrusters": [curve | unit for unit in units]}
    config: ThrustersConfig = validate_config(content, ThrustersConfig, "here")
    return config.build()


def test_fixed_thrusters_push_where_they_stand() -> None:
    sides = ({"name": "port", "x": -2.0, "y": -1.0}, {"name": "stbd", "x": -2.0, "y": 1.0})
    unit = thrusters(*sides, {"name": "bow", "x": 2.5, "angle": "90 deg"})
    assert unit.command_names == ("cmd_port", "cmd_stbd", "cmd_bow")
    n = torch.cat((4.0 * torch.eye(3), torch.tensor([[0.0, 0.0, -4.0]]))).double()
    expected = [[32, 0, 32], [32, 0, -32], [0, 32, 80], [0, -16, -40]]
    np.testing.assert_allclose(unit.force(n[:, :0], n, torch.zeros(4, 3)), expected, atol=1e-12)
    command = unit.commands_for_demand(torch.tensor(0.5).double(), torch.tensor(0.2).double())
    np.testing.assert_allclose(command, [7.0, 3.0, 2.0], atol=1e-12)


def test_two_of_them_are_the_differential_thrusters(twin: Thrusters) -> None:
    known: Any = load_vessel("wam_v_cal").actuators
    shared = {"forward": known.forward, "reverse": known.reverse}
    shared |= {"n_max": "2380 rpm", "n_rate": "1500 rpm/s", "x": -2}
    unit = thrusters({"name": "port", "y": -1.22} | shared, {"name": "stbd", "y": 1.22} | shared)
    random = torch.Generator().manual_seed(0)
    a, command = 60 * torch.rand(2, 50, 2, generator=random, dtype=torch.float64) - 30
    drive, steer = 2 * torch.rand(2, 50, generator=random, dtype=torch.float64) - 1
    for one, other in (
        (unit.force(a, command, a), twin.force(a, command, a)),
        (unit.advance_step(a, command, 0.1), twin.advance_step(a, command, 0.1)),
        (unit.commands_for_demand(drive, steer), twin.commands_for_demand(drive, steer)),
    ):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-9)


def rudder(**changes: dict[str, Any]) -> SteeredActuators:
    base: dict[str, Any] = {
        "rudder": {"area": 0.2, "aspect_ratio": 2.0, "x": -3.0, "limit": 0.6, "straightening": 0},
        "propeller": {"diameter": 0.5, "n_max": 20, "forward": [0, 0, 5], "reverse": [0, 0, -3]},
    }
    content = {key: part | changes.get(key, {}) for key, part in base.items()}
    content |= {"kind": "rudder_propeller", "source": "made", "density": 1000.0}
    config: RudderPropellerConfig = validate_config(content, RudderPropellerConfig, "here")
    return config.build()


def force(
    unit: SteeredActuators, delta: float, n: float, nu: tuple[float, float, float]
) -> np.ndarray:
    command = torch.tensor([[delta, n]], dtype=torch.float64)
    motion = torch.tensor([nu], dtype=torch.float64)
    return unit.force(command[:, :0], command, motion)[0].numpy()


def lift(delta: float, square: float) -> np.ndarray:
    """The forces of the rudder in a flow of this squared speed, in closed form."""
    normal = 0.5 * 1000 * 0.2 * 6.13 * 2.0 / 4.25 * np.sin(delta) * square
    return normal * np.array([-np.sin(delta), -np.cos(delta), 3.0 * np.cos(delta)])


def test_a_rudder_in_the_flow_and_in_the_race_is_the_closed_form() -> None:
    """Behind an actuator disc at standstill U_R^2 = 2 T / (rho A_p); none of it outside the race or
    when backing.
    """
    unit = rudder()
    behind = rudder(rudder={"race_share": 1.0})
    pushed = [500.0, 0, 0]
    found = force(unit, 0.3, 10.0, (4.0, 0.0, 0.0))
    np.testing.assert_allclose(found, lift(0.3, 16.0) + pushed, rtol=1e-12)
    assert force(unit, 0.3, -10.0, (-4.0, 0.0, 0.0))[2] < 0
    race = 2 * 5.0 * 15.0**2 / (1000 * np.pi * 0.5**2 / 4)
    found = force(behind, 0.2, 15.0, (0, 0, 0))
    np.testing.assert_allclose(found[1:], lift(0.2, race)[1:], rtol=1e-12)
    for other, n in ((unit, 15.0), (behind, -15.0)):
        assert np.abs(force(other, 0.2, n, (0, 0, 0))[1:]).max() < 1e-9
    straight = rudder(rudder={"straightening": 1.0})
    assert force(straight, 0.0, 5.0, (4.0, 0.5, 0.0))[1] < 0
    assert force(straight, 0.0, 5.0, (4.0, 0.0, 0.3))[2] < 0


def test_thrust_falls_with_speed_and_commands_saturate() -> None:
    unit = rudder(propeller={"advance_loss": 6.0, "thrust_deduction": 0.1})
    assert force(unit, 0, 10, (3.0, 0, 0))[0] == pytest.approx(0.9 * (500 - 6 * 10 * 3))
    limit = force(unit, 0.6, 20.0, (1.0, 0, 0))
    np.testing.assert_array_equal(force(unit, 3.0, 1000.0, (1.0, 0, 0)), limit)
    asked = torch.tensor([[0.5, -2.0], [1.5, -0.5]], dtype=torch.float64)
    np.testing.assert_allclose(unit.commands_for_demand(*asked), [[0.6, 10.0], [-0.3, -20.0]])


def servo(**content: Any) -> Servo:
    config: SteeringGearConfig = validate_config(
        {"limit": 0.6} | content, SteeringGearConfig, "here"
    )
    return Servo(config.servo_spec("delta"))


def follow(unit: Servo, command: np.ndarray, dt: float = 0.01) -> np.ndarray:
    """Positions [T + 1] under commands [T] held over steps, as a plant moves it: RK4, then what
    moves once per step.
    """
    a = torch.zeros(1, len(unit.state_names), dtype=torch.float64)
    out = []
    for value in [*command, command[-1]]:
        c = torch.tensor([[value]], dtype=torch.float64)
        out.append(float(unit.position(a, c)))

        def rate(state: Tensor, c: Tensor = c) -> Tensor:
            return unit.derivative(state, c)

        k1 = rate(a)
        k2 = rate(a + 0.5 * dt * k1)
        k3 = rate(a + 0.5 * dt * k2)
        k4 = rate(a + dt * k3)
        a = unit.advance_step(a + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4), c, dt)
    return np.array(out)


T = 0.01 * np.arange(301)
LAG = {"response": {"kind": "first_order", "time": "300 ms"}}
SWING = {"response": {"kind": "second_order", "frequency": 4.0, "damping": 0.6}}
# the limit until the lag asks for less
FREE = (0.4 - 0.5 * 0.3) / 0.5


@pytest.mark.parametrize(
    ("settings", "expected", "close"),
    [
        ({}, np.full(301, 0.4), 0.0),
        ({"rate": 0.5}, np.minimum(0.5 * T, 0.4), 1e-12),
        (LAG, 0.4 * (1 - np.exp(-T / 0.3)), 1e-8),
        (
            LAG | {"rate": 0.5},
            np.where(FREE > T, 0.5 * T, 0.4 - 0.5 * 0.3 * np.exp(-(T - FREE) / 0.3)),
            2e-5,
        ),
        (
            SWING,
            0.4 * (1 - np.exp(-2.4 * T) * (np.cos(3.2 * T) + 0.75 * np.sin(3.2 * T))),
            1e-7,
        ),
    ],
    ids=["at once", "rate", "lag", "lag and rate", "second order"],
)
def test_an_answer_is_the_closed_form_and_dead_time_shifts_it(
    settings: dict[str, Any], expected: np.ndarray, close: float
) -> None:
    step = np.full(300, 0.4)
    prompt = follow(servo(**settings), step)
    np.testing.assert_allclose(prompt, expected, atol=close)
    late = follow(servo(dead_time="200 ms", delay_step="10 ms", **settings), step)
    np.testing.assert_allclose(late[20:], prompt[:-20], atol=1e-12)
    assert not late[:20].any()


def test_limits_of_a_servo() -> None:
    unit = servo()
    assert unit.state_names == ()
    assert follow(unit, np.array([0.2, 5.0, -5.0])).tolist() == [0.2, 0.6, -0.6, -0.6]
    assert servo(**SWING).state_names == ("delta", "_delta_rate")
    response = {"kind": "second_order", "frequency": 6.0, "damping": 0.8}
    found = follow(servo(response=response, rate=0.3), np.full(300, 0.5))
    # without wind-up
    assert np.diff(found).max() <= 0.3 * 0.01 * (1 + 1e-9)
    assert np.diff(found)[60:120] == pytest.approx(0.003, rel=1e-6)
    assert found.max() < 0.5 * 1.05
    assert found[-1] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"dead_time": 0.2}, "given together"),
        ({"dead_time": 0.2, "delay_step": 0.03}, "1 to 1000 times"),
        ({"dead_time": "-1 s"}, "dead_time"),
        (
            {"dead_time": 0.2, "delay_step": 0.01},
            "delay_step is 0.01 s, but the plant steps by 0.02 s; set delay_step",
        ),
    ],
)
def test_wrong_servos_are_one_line(content: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        follow(servo(**content), np.full(300, 0.4), 0.02)
    assert "\n" not in str(caught.value)
