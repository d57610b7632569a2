"""The patrol vessel: MSS navalvessel.m and document 004 written out, what physics demands, and the
figures of the corrections of document 004.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from kinds import of_kind

from residnet.core.config import load_config
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics, TracedPlantDynamics
from residnet.physics.actuators.rudders import SternRudders
from residnet.physics.plant import HullPlant
from residnet.physics.vessel import VesselConfig, load_vessel, vessel_files

NAMES = ("patrol_p06", "patrol_hyb", "patrol_mss", "patrol_p06_linear")
THRUST = 1960 * 7.71**2
MIRROR = torch.tensor([1.0, -1.0, -1.0, -1.0, 1.0, -1.0, -1.0, -1.0, -1.0], dtype=torch.float64)
"""Of x, y, phi, psi, u, v, p, r, delta."""


@dataclass(frozen=True)
class Numbers:
    """What differs between the sets, as the corrections of document 004 list it."""

    rho: float
    volume: float
    gm: float
    m: float
    i_x: float
    i_z: float
    z_g: float
    y_vdot: float
    k_pdot: float
    n_rdot: float


P06 = Numbers(
    1025, 355.88, 1.0, 1025 * 355.88, 3.4263e6, 3.3818e7, -1.07, -1.9022e6, -0.674e6, -4.3958e7
)
SETS = {
    "patrol_p06": P06,
    "patrol_p06_linear": P06,
    "patrol_hyb": Numbers(
        1025, 355.88, 1.0, 1025 * 355.88, 3.4263e6, 3.3818e7, -1.07, -393e3, -0.674e6, -4.3958e7
    ),
    "patrol_mss": Numbers(
        1014, 357, 1.1, 1014 * 357, 2.3763e6, 4.7934e7, -1.06, -393e3, -0.774e6, -38.7e6
    ),
}


def navalvessel(c: Numbers, nu: np.ndarray, b: float, tau: np.ndarray) -> np.ndarray:
    """Accelerations as MSS navalvessel.m forms them, abs(u*b) read as abs(u*v); tau
    acts beside the hull's own forces.
    """
    u, v, p, r = nu
    au, av, ap, ar = np.abs(nu)
    m, x_g, z_g, g = c.m, -3.38, c.z_g, 9.81
    hull = np.array([
        -1960 * u * au + 0.33 * m * v * r,
        -11800 * au * v + 131000 * u * r - 3700 * v * av - 794000 * v * ar - 182000 * r * av
        + 10800 * b * abs(u * v) + 251000 * b * abs(u * r)
        - 74 * b * u**2,
        9260 * au * v - 102000 * u * r + 29300 * v * av + 621000 * v * ar + 142000 * r * av
        - 8400 * b * abs(u * v) - 196000 * b * abs(u * r)
        - 1180 * b * u**2 - 15500 * au * p - 416000 * p * ap - 500000 * p
        - 0.325 * c.rho * g * c.volume * b**3 - c.rho * g * c.gm * c.volume * b,
        -92000 * au * v - 4710000 * au * r - 202e6 * r * ar - 15.6e6 * r * av
        - 214000 * b * abs(u * v) - 4980000 * b * u * ar - 8000 * b * u * au,
    ])  # fmt: skip
    centripetal = m * np.array(
        [r * v + x_g * r**2 - z_g * p * r, -u * r, z_g * u * r, -x_g * u * r]
    )
    mass = np.array([
        [m + 17400, 0, 0, 0],
        [0, m - c.y_vdot, -(m * z_g - 296e3), m * x_g + 1.4e6],
        [0, -(m * z_g + 296e3), c.i_x - c.k_pdot, 0],
        [0, m * x_g - 538e3, 0, c.i_z - c.n_rdot],
    ])  # fmt: skip
    return np.linalg.solve(mass, hull + centripetal + tau)


def foil(c: Numbers, u: float, v: float, delta: float, thrust: float) -> np.ndarray:
    """Forces of thrust and rudders by (5.20)-(5.29) as corrected: two rudders, two propellers with
    half of the thrust each.
    """
    angle = np.clip(delta, -np.radians(23), np.radians(23))
    lift_coefficient = np.degrees(0.054) * angle
    drag_coefficient = lift_coefficient**2 / (0.9 * np.pi * 3)
    square = u**2 + v**2
    loading = 2 * (thrust / 2) / (c.rho * square * np.pi * 0.8**2)
    race = 2 * (thrust / 2) * (1 + 1 / np.sqrt(1 + loading))
    lift = 2 * 0.5 * c.rho * square * 1.5 * lift_coefficient + race * np.sin(angle)
    drag = 2 * 0.5 * c.rho * square * 1.5 * drag_coefficient + race * (1 - np.cos(angle))
    return np.array([thrust - drag, -lift, 1.54 * lift, 25.75 * lift])


def motions(count: int = 100, seed: int = 0) -> np.ndarray:
    """x, y, phi, psi, u, v, p, r, delta."""
    spread = [100, 100, 0.3, 2.0, 3.0, 1.0, 0.2, 0.05, 0.3]
    return np.random.default_rng(seed).normal(size=(count, 9)) * spread + np.eye(9)[4] * 6.0


@pytest.fixture(params=NAMES)
def plant(request: pytest.FixtureRequest) -> HullPlant:
    return of_kind(load_vessel(request.param).build(), HullPlant)


def inputs(plant: HullPlant, rows: int, delta: float = 0.0, thrust: float = THRUST) -> torch.Tensor:
    w = torch.zeros(rows, len(plant.inputs), dtype=torch.float64)
    w[:, 0], w[:, 1] = delta, thrust
    return w


def flown(
    plant: HullPlant, x0: torch.Tensor, w: torch.Tensor, steps: int, dt: float = 0.05
) -> torch.Tensor:
    with torch.no_grad():
        return Rollout(TracedPlantDynamics(plant, dt))(
            x0, w[:, None].expand(-1, steps, -1), x0[:, :0]
        )[0]


@pytest.mark.parametrize("name", NAMES)
def test_right_hand_side_written_out(name: str) -> None:
    plant, c = of_kind(load_vessel(name).build(), HullPlant), SETS[name]
    states = motions()
    thrusts = np.random.default_rng(1).uniform(0, THRUST, len(states))
    x, w = torch.from_numpy(states), inputs(plant, len(states))
    w[:, 1] = torch.from_numpy(thrusts)
    w[:, 2:6] = torch.tensor([3e3, -2e3, 8e3, 5e4], dtype=torch.float64)
    for row, thrust, got in zip(states, thrusts, plant.rate(x, w).numpy(), strict=True):
        _, _, phi, psi, u, v, p, r, delta = row
        angle = np.clip(delta, -np.radians(35), np.radians(35))
        lift = 7008.8 * u * u * angle
        linear = np.array([thrust, -lift, 1.54 * lift, 25.75 * lift])
        tau = linear if name.endswith("linear") else foil(c, u, v, angle, thrust)
        acceleration = navalvessel(c, row[4:8], phi, tau + np.array([3e3, -2e3, 8e3, 5e4]))
        pose = [
            u * np.cos(psi) - v * np.sin(psi) * np.cos(phi),
            u * np.sin(psi) + v * np.cos(psi) * np.cos(phi),
            p,
            r * np.cos(phi),
        ]
        np.testing.assert_allclose(got[:4], pose, rtol=1e-12, atol=1e-14)
        assert np.abs(got[4:8] - acceleration).max() <= 1e-12 * np.abs(acceleration).max()
        assert got[8] == 0.0


@pytest.mark.parametrize("name", NAMES)
def test_a_foil_beyond_stall_lifts_no_more(name: str) -> None:
    rudders = load_vessel(name).actuators.build()
    assert isinstance(rudders, SternRudders)
    delta = torch.linspace(-0.6, 0.6, 241, dtype=torch.float64)
    u, v, thrust = (
        torch.full_like(delta, 7.0),
        torch.full_like(delta, 0.5),
        torch.full_like(delta, THRUST),
    )
    lift, drag = rudders.config.foil(delta, u, v, thrust)
    torch.testing.assert_close(lift, -lift.flip(0), rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(drag, drag.flip(0), rtol=1e-12, atol=1e-9)
    stalled = delta > np.radians(23)
    if name.endswith("linear"):
        torch.testing.assert_close(lift, 7008.8 * 49.0 * delta)
    else:
        assert lift[stalled].unique().numel() == 1
        assert bool((lift[~stalled].diff() >= 0).all())


def test_rudders_at_rest() -> None:
    """Without flow the race alone steers, with half the momentum of a moving vessel; without thrust
    nothing does, and gradients stay finite.
    """
    rudders = load_vessel("patrol_p06").actuators.build()
    a = torch.full((2, 1), np.radians(10.0), dtype=torch.float64)
    nu = torch.zeros(2, 4, dtype=torch.float64, requires_grad=True)
    command = torch.tensor([[0.0, THRUST], [0.0, 0.0]], dtype=torch.float64)
    tau = rudders.force(a, command, nu)
    np.testing.assert_allclose(tau[0, 1].item(), -THRUST * np.sin(np.radians(10.0)), rtol=1e-6)
    assert tau[1].abs().max().item() == 0.0
    (slope,) = torch.autograd.grad(tau.sum(), nu)
    assert bool(torch.isfinite(slope).all())


def test_commands_are_kept_within_their_limits(plant: HullPlant) -> None:
    one = torch.ones(1, dtype=torch.float64)
    assert plant.demand(one, -0.2 * one).tolist() == [
        [pytest.approx(-np.radians(7.0)), pytest.approx(THRUST)]
    ]
    assert plant.demand(-one, 3.0 * one).tolist() == [[pytest.approx(np.radians(35.0)), 0.0]]
    x = plant.approach(2)
    far, most = inputs(plant, 2, 0.0, 2 * THRUST), inputs(plant, 2, 0.0, THRUST)
    assert torch.equal(plant.rate(x, far), plant.rate(x, most))
    moved = plant.end_step(x, inputs(plant, 2, -9.0), 0.1)
    np.testing.assert_allclose(moved[:, 8], -np.radians(1.0), rtol=1e-12)


def test_gradients_of_the_right_hand_side(plant: HullPlant) -> None:
    """Away from the kinks of |.| and of the limits."""
    x = torch.from_numpy(
        np.array(
            [
                [1, -2, 0.1, 0.7, 6.5, 0.8, 0.1, -0.03, 0.15],
                [0, 0, -0.2, -1.0, 4.0, -0.6, -0.2, 0.05, -0.3],
            ]
        )
    )
    w = inputs(plant, 2, 0.1, 1e5)
    w[:, 2:] = torch.from_numpy(np.random.default_rng(2).normal(size=(2, w.shape[1] - 2)))
    # in the units of a vessel of 365 t, so that finite differences resolve the forces
    scale = torch.tensor([1.0, 1e5, *([1e5] * 4), 1.0, 1.0, 1e5, 1e5], dtype=torch.float64)
    assert torch.autograd.gradcheck(
        lambda x, w: plant.rate(x, w * scale),
        (x.requires_grad_(), (w / scale).requires_grad_()),
        atol=1e-6,
    )


DISSIPATIVE = (
    "added_mass.K_vdot.value=-296000",
    "added_mass.N_vdot.value=-1.4e6",
    "forces.X={u|u|: {value: -1960, unit: kg/m, source: made}}",
    "forces.Y={v|v|: {value: -3700, unit: kg/m, source: made},"
    ' "|u|v": {value: -11800, unit: kg/m, source: made}}',
    "forces.K={p: {value: -5e5, unit: kg m^2/s, source: made},"
    " p|p|: {value: -4e5, unit: kg m^2, source: made}}",
    "forces.N={r|r|: {value: -2e8, unit: kg m^2, source: made},"
    ' "|u|r": {value: -4.7e6, unit: kg m, source: made}}',
)  # fmt: skip


def energy(plant: HullPlant, states: torch.Tensor, stiffness: float) -> torch.Tensor:
    nu = states[..., 4:8]
    return (
        0.5 * torch.einsum("bti,ij,btj->bt", nu, plant.hull.mass, nu)
        + 0.5 * stiffness * states[..., 2] ** 2
    )


@pytest.mark.parametrize("braked", [True, False])
def test_energy_falls_with_damping_and_is_kept_without(braked: bool) -> None:
    """With a symmetric mass matrix: neither rotation nor restoring does work over time, and each
    damping term takes energy.
    """
    overrides = DISSIPATIVE if braked else (*DISSIPATIVE[:2], "forces={}")
    vessel = load_config(vessel_files()["patrol_p06"], list(overrides), VesselConfig)
    plant = vessel.build()
    torch.testing.assert_close(plant.hull.mass, plant.hull.mass.T)
    x0 = torch.from_numpy(motions(32, 3))
    x0[:, 8] = 0.0
    states = flown(plant, x0, inputs(plant, 32, 0.0, 0.0), 400, 0.02)
    now = energy(plant, states, 1025 * 9.81 * 355.88)
    if braked:
        assert bool((now.diff(dim=1) < 0).all())
        assert bool((now[:, -1] < 0.9 * now[:, 0]).all())
    else:
        assert float((now / now[:, :1] - 1).abs().max()) < 1e-7


def test_port_and_starboard_are_mirror_images(plant: HullPlant) -> None:
    x = torch.from_numpy(motions())
    w = inputs(plant, len(x))
    mirrored = plant.rate(x * MIRROR, w)
    torch.testing.assert_close(mirrored, plant.rate(x, w) * MIRROR, rtol=1e-11, atol=1e-13)


def test_mirrored_commands_give_the_mirrored_track_and_none_keeps_straight(
    plant: HullPlant,
) -> None:
    w = torch.cat([inputs(plant, 1, delta) for delta in (0.15, -0.15, 0.0)])
    states = flown(plant, plant.approach(3), w, 600)
    torch.testing.assert_close(states[1], states[0] * MIRROR, rtol=1e-9, atol=1e-11)
    assert float(states[0, -1, 3]) > 0.5, "a rudder to starboard turns to starboard"
    straight = states[2, -1]
    np.testing.assert_allclose(
        straight, [7.71 * 30, 0, 0, 0, 7.71, 0, 0, 0, 0], rtol=1e-12, atol=1e-12
    )


def test_heel_and_steady_turns_are_those_of_errata() -> None:
    """G9: 10 deg of rudder heel 1.25 deg inward at first and 3.34 deg outward in the end; G17, G18:
    7.00 m/s and 190 m at 5 deg, 124 m at 10 deg.
    """
    # the rudder steps
    plant = load_config(vessel_files()["patrol_p06"], ["actuators.rate=null"], VesselConfig).build()
    w = torch.cat([inputs(plant, 1, np.radians(angle)) for angle in (5.0, 10.0)])
    states = flown(plant, plant.approach(2), w, 4000)
    phi = np.degrees(states[1, :, 2].numpy())
    assert phi.max() == pytest.approx(1.25, abs=0.01)
    assert phi[-1] == pytest.approx(-3.34, abs=0.01)
    assert np.degrees(float(states[0, -1, 7])) == pytest.approx(2.13, abs=0.01)
    assert float(states[0, -1, 4]) == pytest.approx(7.00, abs=0.01)
    speed = torch.linalg.vector_norm(states[:, -1, 4:6], dim=-1)
    radius = speed / (states[:, -1, 7] * torch.cos(states[:, -1, 2]))
    assert radius.tolist() == pytest.approx([190, 124], abs=0.7)


def test_roll_decays_with_the_period_of_errata() -> None:
    """From 10 deg: 6.63 s at 7.71 m/s, 6.69 s at rest; document 004, Table 5.2 prints 6.76 s."""
    plant = of_kind(load_vessel("patrol_p06").build(), HullPlant)
    x0 = plant.approach(2)
    x0[1, 4] = 0.0
    x0[:, 2] = np.radians(10.0)
    w = torch.cat((inputs(plant, 1), inputs(plant, 1, 0.0, 0.0)))
    states = flown(plant, x0, w, 3000, 0.01)
    for row, period in enumerate((6.63, 6.69)):
        phi = states[row, :, 2].numpy()
        at = np.flatnonzero((phi[:-1] > 0) & (phi[1:] <= 0))
        crossings = 0.01 * (at + phi[at] / (phi[at] - phi[at + 1]))
        assert np.diff(crossings)[:2].mean() == pytest.approx(period, abs=0.04)
        assert np.abs(phi[-600:]).max() < 0.5 * phi[0]


def test_a_current_that_carries_the_upright_vessel_exerts_no_force(plant: HullPlant) -> None:
    psi = torch.linspace(-3, 3, 7, dtype=torch.float64)
    x = torch.zeros(7, 9, dtype=torch.float64)
    x[:, 3] = psi
    x[:, 4], x[:, 5] = (
        0.4 * torch.cos(psi) - 0.25 * torch.sin(psi),
        -0.4 * torch.sin(psi) - 0.25 * torch.cos(psi),
    )
    w = inputs(plant, 7, 0.0, 0.0)
    w[:, 6], w[:, 7] = 0.4, -0.25
    rate = plant.rate(x, w)
    np.testing.assert_allclose(rate[:, :2], np.tile([0.4, -0.25], (7, 1)), rtol=0, atol=1e-12)
    assert float(rate[:, 2:].abs().max()) < 1e-12


def test_calm_water_held_forces_and_single_rows_are_the_same(plant: HullPlant) -> None:
    x = torch.from_numpy(motions(5))
    w = inputs(plant, 5, 0.1)
    full = plant.rate(x, w)
    for row in range(5):
        torch.testing.assert_close(
            plant.rate(x[row : row + 1], w[row : row + 1])[0], full[row], rtol=1e-12, atol=1e-13
        )
    after, _ = PlantDynamics(plant, 0.05).step(x, w, x[:, :0])
    calm = plant.in_calm_water()
    torch.testing.assert_close(calm.rate(x, w[:, :2]), full, rtol=1e-12, atol=1e-13)
    torch.testing.assert_close(
        PlantDynamics(calm, 0.05).step(x, w[:, :2], x[:, :0])[0], after, rtol=1e-12, atol=1e-13
    )
