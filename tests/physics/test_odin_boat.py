"""Odin: the document's equations written out, what physics demands of them, and the figures of
the corrections of document 000.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.actuators.rudders import WaterJets
from residnet.physics.hull import PHASES, OdinConfig, froude_number, phase_of
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import VesselConfig, load_vessel, vessel_files


def plant_of(name: str, *overrides: str) -> HullPlant:
    plant = load_config(vessel_files()[name], list(overrides), VesselConfig).build()
    assert isinstance(plant, HullPlant)
    return plant


def jets() -> WaterJets:
    actuators = plant_of("odin_jets").actuators
    assert isinstance(actuators, WaterJets)
    return actuators


def motions(count: int = 300, seed: int = 0) -> Tensor:
    """u, v, r away from the kinks at zero."""
    random = np.random.default_rng(seed)
    size = random.uniform(0.1, 1.0, (count, 3)) * [9.0, 1.5, 0.6]
    return torch.from_numpy(size * random.choice([-1.0, 1.0], (count, 3)))


def test_force_model_written_out() -> None:
    """(6.6)-(6.8)."""
    nu, tau = motions(), torch.from_numpy(np.random.default_rng(1).normal(size=(300, 3)) * 4000)
    got = plant_of("odin_forces").hull(nu, tau).numpy()
    for (u, v, r), (tx, ty, tz), out in zip(nu.numpy(), tau.numpy(), got, strict=True):
        wanted = [
            2.026e-4 * tx + v * r - 0.0101 * u - 0.0492 * abs(u) * u,
            2.026e-4 * ty - u * r - 0.045 * v - 0.4052 * abs(v) * v,
            4.78e-5 * tz - 0.0612 * (v + r) - 0.1422 * abs(r) * r,
        ]
        np.testing.assert_allclose(out, wanted, rtol=1e-12, atol=1e-13)


def test_jet_model_against_the_printed_polynomials() -> None:
    """Surge by (6.21) with g of (6.20) as H9 corrects it, and the yaw terms of (6.54) as H6 and H7
    do; both rounded to three digits.
    """
    random = np.random.default_rng(0)
    u, rpm, nozzle = (
        random.uniform(0, 10, 400),
        random.uniform(300, 2000, 400),
        random.uniform(-0.3, 0.3, 400),
    )
    plant = plant_of("odin_jets")
    x = torch.zeros(400, 6, dtype=torch.float64)
    x[:, 3] = torch.from_numpy(u)
    w = torch.zeros(400, len(plant.inputs), dtype=torch.float64)
    w[:, :2] = torch.from_numpy(np.stack([rpm / 60, nozzle], axis=1))
    rate = plant.rate(x, w).numpy()
    g = (
        0.048
        - 1.0e-3 * rpm
        + 2.98e-6 * rpm**2
        - 2.65e-3 * u
        + 5.554e-5 * u * rpm
        - 1.65e-7 * u * rpm**2
    )
    g += 2.55e-5 * u**2 - 5.31e-7 * u**2 * rpm + 1.58e-9 * u**2 * rpm**2
    # 0.054 m/s^2 is what correction H11 measured between (6.20) and (6.16)
    assert np.abs(rate[:, 3] - (g * np.cos(nozzle) - 0.0101 * u - 0.0492 * u**2)).max() < 0.06
    yaw = (
        -0.04321
        + 9.03e-4 * rpm
        - 2.683e-6 * rpm**2
        + 2.396e-3 * u
        - 5.01e-5 * u * rpm
        + 1.488e-7 * u * rpm**2
    )
    yaw += -2.294e-5 * u**2 + 4.79e-7 * u**2 * rpm - 1.425e-9 * u**2 * rpm**2
    assert np.abs(rate[:, 5] - yaw * np.sin(nozzle)).max() < 5e-3 * np.abs(rate[:, 5]).max()


def test_thrust_curve_figures() -> None:
    """Correction H15: value at rest, roots, where it turns, and the speed at which it is zero."""
    actuators, zero = jets(), torch.zeros(1, dtype=torch.float64)

    def thrust(rpm: float, u: float = 0.0) -> float:
        return float(actuators.thrust(zero + rpm / 60, zero + u))

    assert thrust(0) == pytest.approx(118, abs=0.5)
    assert thrust(168) == pytest.approx(-90, abs=0.5)
    assert thrust(57.7) > 0 > thrust(57.9)
    assert thrust(278.6) < 0 < thrust(278.8)
    speed = 23.1
    assert thrust(1000, speed - 0.2) > 0 > thrust(1000, speed + 0.2)
    rpm = torch.arange(0, 2001, dtype=torch.float64)
    assert int(actuators.thrust(rpm / 60, torch.zeros_like(rpm)).argmin()) == 168


def test_jets_saturate_and_turn_to_the_side_that_is_asked_for() -> None:
    actuators = jets()
    nu = torch.zeros(2, 3, dtype=torch.float64)
    beyond = torch.tensor([[50.0, 1.0], [-5.0, -1.0]], dtype=torch.float64)
    limits = torch.tensor(
        [[2000 / 60, np.radians(27)], [0.0, -np.radians(27)]], dtype=torch.float64
    )
    torch.testing.assert_close(
        actuators.force(nu[:, :0], beyond, nu), actuators.force(nu[:, :0], limits, nu)
    )
    command = actuators.demand(
        torch.tensor([0.5, 0.5]).double(), torch.tensor([0.3, -0.3]).double()
    )
    tau = actuators.force(nu[:, :0], command, nu)
    assert float(tau[0, 2]) > 0 > float(tau[1, 2])
    torch.testing.assert_close(tau[:, 2], -3.82 * tau[:, 1])


def test_slew_rates_where_they_are_switched_on() -> None:
    plant = plant_of(
        "odin_jets", "actuators.motor.n_rate=2000 rpm/s", "actuators.nozzle.rate=1.3464"
    )
    assert plant.state[6:] == ("n", "nozzle")
    x = torch.zeros(1, 8, dtype=torch.float64)
    w = torch.zeros(1, len(plant.inputs), dtype=torch.float64)
    w[0, :2] = torch.tensor([2000 / 60, 0.3], dtype=torch.float64)
    for _ in range(10):
        x = PlantDynamics(plant, 0.01).step(x, w, x[:, :0])[0]
    torch.testing.assert_close(x[0, 6:], torch.tensor([200 / 60, 0.13464], dtype=torch.float64))


@pytest.mark.parametrize(("rpm", "top"), [(2000, 9.96)])
def test_top_speed(rpm: float, top: float) -> None:
    """Correction H16, where surge balances (6.21)."""
    plant = plant_of("odin_jets").in_calm_water()
    w = torch.tensor([[rpm / 60, 0.0]], dtype=torch.float64)
    x = torch.zeros(1, 6, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.05))(
            x, w[:, None].expand(1, 1200, 2), x[:, :0]
        )
    assert float(states[0, -1, 3]) == pytest.approx(top, abs=0.005)
    assert float(plant.rate(states[:, -1], w)[0, 3].abs()) < 1e-6


@pytest.mark.parametrize(
    ("speed", "pole"), [(0.044, -0.0), (1.0, 0.194), (5.0, 0.50), (10.0, 0.73)]
)
def test_sway_and_yaw_are_unstable_as_printed(speed: float, pole: float) -> None:
    """Correction H5."""
    hull = plant_of("odin_forces").hull
    nu = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(lambda x: hull(x, torch.zeros_like(x)), nu)
    largest = float(torch.linalg.eigvals(slope[1:, 1:]).real.max())
    if pole == 0.0:
        assert largest < 0
    else:
        assert largest == pytest.approx(pole, abs=0.006)


def test_gradients() -> None:
    plant, nu = plant_of("odin_jets"), motions(8)
    x = torch.cat((torch.randn(8, 3, dtype=torch.float64), nu), dim=1).requires_grad_()
    w = torch.zeros(8, len(plant.inputs), dtype=torch.float64)
    w[:, 0], w[:, 1] = torch.linspace(5, 30, 8), torch.linspace(-0.4, 0.4, 8)
    assert torch.autograd.gradcheck(plant.rate, (x, w.requires_grad_()))


def test_mirror_symmetry() -> None:
    """Port and starboard: sway, yaw, side force, moment and nozzle angle change sign."""
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    hull, nu, tau = plant_of("odin_forces").hull, motions(), motions(seed=2) * 1000
    torch.testing.assert_close(
        hull(nu * flip, tau * flip), hull(nu, tau) * flip, rtol=1e-12, atol=1e-13
    )
    actuators, command = (
        jets(),
        torch.rand(300, 2, dtype=torch.float64) * torch.tensor([30.0, 0.4], dtype=torch.float64),
    )
    mirrored = actuators.force(nu[:, :0], command * flip[:2], nu * flip)
    torch.testing.assert_close(mirrored, actuators.force(nu[:, :0], command, nu) * flip)


def test_motion_dies_out_where_the_printed_coupling_does_no_work() -> None:
    """Without force, u^2 + v^2 falls at every step; N_v of (6.8) may feed yaw (correction H5), so r
    is left out of the sum.
    """
    plant = plant_of("odin_forces").in_calm_water()
    x = torch.cat((torch.zeros(300, 3, dtype=torch.float64), motions()), dim=1)
    w = torch.zeros(300, 100, 3, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.02))(x, w, x[:, :0])
    energy = states[:, :, 3:5].square().sum(-1)
    assert bool((energy[:, 1:] <= energy[:, :-1]).all())


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("terms.u.u.unit=1/m", "its unit must be 1/s"),
        ("terms.r.r|r|.unit=1/s", "its unit must be -"),
        ("gains.n.unit=1/kg", r"its unit must be 1/kg/m\^2"),
        ("gains.x.value=-1", "must be positive"),
        ("terms.v.w={value: 1, unit: 1/s, source: made}", "no channel 'w'"),
        ("terms.v.v^-1={value: 1, unit: m^2/s^3, source: made}", "divides by what may be zero"),
    ],
)
def test_a_wrong_coefficient_is_found_when_the_file_is_read(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(vessel_files()["odin_forces"], [override], OdinConfig)
    assert "\n" not in str(caught.value)


def test_froude_phases() -> None:
    """Appendix D with the length of correction H17: 0.4 at 4.06 m/s, 1.0 at 10.1 m/s."""
    vessel = load_vessel("odin_forces")
    u = torch.tensor([0.0, 4.0, 4.1, 10.1, 10.2, 3.0], dtype=torch.float64)
    v = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -4.0], dtype=torch.float64)
    froude = froude_number(u, v, vessel.length.value)
    assert float(froude[3]) == pytest.approx(1.0, abs=0.005)
    assert [PHASES[i] for i in phase_of(froude).tolist()] == [
        "displacement", "displacement", "semi_displacement", "semi_displacement", "planing",
        "semi_displacement",
    ]  # fmt: skip
    assert phase_of(torch.tensor([0.4, 1.0, 1.1])).tolist() == [1, 2, 2]
    assert phase_of(torch.tensor([1.1]), (0.4, 1.2)).tolist() == [1]
    with pytest.raises(ValueError, match="length"):
        froude_number(u, v, 0.0)
