"""Nomoto's models against their transfer functions, the vessel they linearise, SciPy and closed
forms.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kinds import of_kind
from scipy.integrate import solve_ivp
from scipy.signal import TransferFunction, lsim

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import NomotoDynamics, PlantDynamics
from residnet.physics.nomoto import SteeringVessel
from residnet.physics.vessel import VesselConfig, load_vessel, vessel_files

NAMES = ("nomoto_oceanos", "nomoto_mariner_yaw", "nomoto_mariner")


@pytest.fixture(params=NAMES)
def plant(request: pytest.FixtureRequest) -> SteeringVessel:
    return of_kind(load_vessel(request.param).build(), SteeringVessel)


def immediate(name: str) -> SteeringVessel:
    """Without a rate of the rudder."""
    return load_config(vessel_files()[name], ["rudder.rate=null"], VesselConfig).build()


def commands(steps: int, dt: float) -> np.ndarray:
    """Steps of the rudder [T] within 0.2 rad, each of 2 s."""
    levels = np.random.default_rng(0).uniform(-0.2, 0.2, steps)
    return levels[(np.arange(steps) * dt // 2).astype(int)]


def flown(model: NomotoDynamics | PlantDynamics, rudder: np.ndarray) -> np.ndarray:
    x0 = model.plant.approach(1)
    with torch.no_grad():
        states, _, _ = Rollout(model)(x0, torch.from_numpy(rudder)[None, :, None], x0[:, :0])
    return states[0].numpy()


def transfer_functions(name: str) -> dict[str, TransferFunction]:
    """v and r over delta as document 004 (5.3), (5.4), (5.7) write them."""
    c = load_vessel(name)
    k = c.K.value
    if name == "nomoto_oceanos":
        return {"r": TransferFunction([k], [c.T.value, 1.0])}
    denominator = [c.T1.value * c.T2.value, c.T1.value + c.T2.value, 1.0]
    out = {"r": TransferFunction([k * c.T3.value, k], denominator)}
    if name == "nomoto_mariner":
        out["v"] = TransferFunction([c.K_v.value * c.T_v.value, c.K_v.value], denominator)
    return out


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("dt", [0.01, 0.5])
def test_steps_of_the_rudder_as_the_transfer_functions_say(name: str, dt: float) -> None:
    plant = immediate(name)
    rudder = commands(400, dt)
    states = flown(NomotoDynamics(plant, dt), rudder)
    known = transfer_functions(name)
    for channel, function in known.items():
        # lsim holds inputs over a step and is exact in it
        _, truth, _ = lsim((function.num, function.den), rudder, np.arange(400) * dt, interp=False)
        np.testing.assert_allclose(
            states[:-1, plant.state.index(channel)], truth, rtol=0, atol=1e-11 * np.ptp(truth)
        )
    if "v" not in known:
        assert not states[:, 4].any()


@pytest.mark.parametrize("name", NAMES)
def test_the_exact_step_against_rk4_and_scipy(name: str) -> None:
    """Whole states under a rudder with a rate; RK4 and positions by Simpson's rule are of fourth
    order.
    """
    plant = load_config(vessel_files()[name], ["rudder.rate=5 deg/s"], VesselConfig).build()
    dt, rudder = 0.05, commands(200, 0.05)
    exact, stepped = (
        flown(NomotoDynamics(plant, dt), rudder),
        flown(PlantDynamics(plant, dt), rudder),
    )
    spread = np.ptp(exact, axis=0)
    np.testing.assert_array_equal(exact[:, -1], stepped[:, -1])
    assert (np.abs(exact - stepped).max(0) <= 1e-7 * spread).all()

    def rate(_: float, y: np.ndarray, w: torch.Tensor, delta: float) -> np.ndarray:
        return plant.rate(torch.tensor([[*y, delta]]), w)[0, :-1].numpy()

    x = exact[0, :-1]
    for k in range(200):
        w, delta = torch.tensor([[rudder[k]]]), exact[k, -1]
        x = solve_ivp(
            rate,
            (0, dt),
            x,
            args=(w, delta),
            method="DOP853",
            rtol=1e-12,
            atol=1e-14,
        ).y[:, -1]
    np.testing.assert_allclose(exact[-1, 2:-1], x[2:], rtol=0, atol=1e-11)
    np.testing.assert_allclose(exact[-1, :2], x[:2], rtol=0, atol=1e-7 * np.ptp(exact[:, 0]))


def test_a_steady_turn_is_a_circle_of_document_numbers() -> None:
    """Corrections G18, G20: 5 deg turn at 17.3 deg/s on a radius of 10.57 m."""
    plant = of_kind(load_vessel("nomoto_oceanos").build(), SteeringVessel)
    states = flown(NomotoDynamics(plant, 0.01), np.full(6000, np.radians(5.0)))
    assert np.degrees(states[-1, 5]) == pytest.approx(17.35, abs=0.01)
    # where the yaw rate has settled: half a circle apart
    half = round(np.pi / states[-1, 5] / 0.01)
    assert np.hypot(*(states[-1, :2] - states[-1 - half, :2])) == pytest.approx(2 * 10.57, abs=0.02)
    assert states[-1, 3] == 3.2


def test_the_linear_mariner_is_the_mariner_about_straight_motion() -> None:
    """Poles, gains and zeros from derivatives of the Abkowitz series at 15 kn."""
    series, linear = load_vessel("mariner").build(), load_vessel("nomoto_mariner").build()
    x = series.approach(1)
    w = torch.zeros(1, len(series.inputs), dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(lambda x: series.rate(x, w)[0, 4:6], x)[:, 0]
    delta = series.state.index("delta")
    torch.testing.assert_close(linear.a, slope[:, 4:6], rtol=1e-6, atol=0)
    torch.testing.assert_close(linear.b, slope[:, delta], rtol=1e-6, atol=0)


def test_sideslip_leaves_the_yaw_of_the_second_order() -> None:
    rudder = commands(500, 0.2)
    yaw, slip = (
        flown(NomotoDynamics(immediate(name), 0.2), rudder)
        for name in ("nomoto_mariner_yaw", "nomoto_mariner")
    )
    np.testing.assert_allclose(yaw[:, [2, 5]], slip[:, [2, 5]], rtol=0, atol=1e-10)
    assert np.ptp(slip[:, 4]) > 0.1


def test_gradients(plant: SteeringVessel) -> None:
    x = (
        torch.rand(
            3, len(plant.state), dtype=torch.float64, generator=torch.Generator().manual_seed(0)
        )
        * 0.3
    )
    w = torch.tensor([[0.1], [-0.2], [0.05]], dtype=torch.float64)
    assert torch.autograd.gradcheck(plant.rate, (x.requires_grad_(), w.requires_grad_()))
    model = NomotoDynamics(plant, 0.1)
    # within the rate the rudder follows its command: no kink there
    near = (
        torch.cat((x[:, :-1], w.detach() + 1e-3), dim=1).detach()
        if plant.state[-1] == "delta"
        else x.detach()
    )
    assert torch.autograd.gradcheck(
        lambda x, w: model.step(x, w, x[:, :0])[0],
        (near.requires_grad_(), w.detach().requires_grad_()),
    )


def test_mirror_turning_sense_and_straight_run(plant: SteeringVessel) -> None:
    w = torch.tensor([[0.1], [-0.1], [0.0]], dtype=torch.float64)
    x = plant.approach(3)
    model = NomotoDynamics(plant, 0.1)
    for _ in range(300):
        x, _ = model.step(x, w, x[:, :0])
    sign = torch.ones(len(plant.state), dtype=torch.float64)
    sign[[1, 2, 4, 5, *range(6, len(plant.state))]] = -1.0
    torch.testing.assert_close(x[1], x[0] * sign, rtol=1e-12, atol=1e-12)
    assert float(x[0, 5]) > 0, "a rudder to starboard turns to starboard"
    straight = torch.zeros(len(plant.state), dtype=torch.float64)
    straight[0], straight[3] = 30 * plant.speed, plant.speed
    torch.testing.assert_close(x[2], straight, rtol=1e-12, atol=0)


def test_commands_saturate_and_drive_changes_nothing(plant: SteeringVessel) -> None:
    one = torch.ones(2, dtype=torch.float64)
    assert torch.equal(plant.demand(one, 0.5 * one), plant.demand(-one, 0.5 * one))
    assert plant.demand(one, 3.0 * one)[:, 0].tolist() == [plant.delta_max] * 2
    x, far, most = (
        plant.approach(1),
        torch.tensor([[9.0]], dtype=torch.float64),
        torch.tensor([[plant.delta_max]], dtype=torch.float64),
    )
    assert torch.equal(plant.rate(x, far), plant.rate(x, most))


@pytest.mark.parametrize(
    ("name", "override", "message"),
    [
        ("nomoto_oceanos", "T.value=0", "T must not be zero"),
        ("nomoto_oceanos", "K.value=-1", "turns to starboard"),
        ("nomoto_oceanos", "K.unit=s", r"does not measure \[1/s\]"),
        ("nomoto_oceanos", "T1={value: 1, unit: s, source: made}", "T1"),
        ("nomoto_mariner", "T_v.value=18.530161", "T_v must differ from T3"),
        ("nomoto_mariner_yaw", "T2.value=-7", "turns to starboard"),
        ("nomoto_mariner_yaw", "rudder.limit=-5 deg", "greater than 0"),
    ],
)
def test_a_wrong_value_is_one_line(name: str, override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(vessel_files()[name], [override], VesselConfig)
    assert "\n" not in str(caught.value)


def test_an_unstable_ship_has_both_signs_negative() -> None:
    plant = load_config(
        vessel_files()["nomoto_oceanos"], ["K.value=-1", "T.value=-20"], VesselConfig
    ).build()
    states = flown(NomotoDynamics(plant, 0.1), np.full(100, 0.1))
    assert states[-1, 5] == pytest.approx(0.1 * (np.exp(10.0 / 20) - 1), rel=1e-12)


def test_an_exact_step_needs_a_rudder_that_is_held() -> None:
    plant = load_config(
        vessel_files()["nomoto_oceanos"],
        ["rudder.response={kind: first_order, time: 1 s}"],
        VesselConfig,
    ).build()
    with pytest.raises(ConfigError, match="an exact step holds the rudder"):
        NomotoDynamics(plant, 0.1)
    assert flown(PlantDynamics(plant, 0.1), np.full(30, 0.1))[-1, -1] == pytest.approx(
        0.1 * (1 - np.exp(-3.0)), rel=1e-5
    )
