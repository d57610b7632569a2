"""The 3-DOF model: what physics demands of it, whatever the numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.actuators import DifferentialThrustConfig
from residnet.physics.hull import FossenConfig
from residnet.physics.vessel import load_vessel, vessel_files

# centre of gravity off the origin and off-diagonal added mass, so that nothing vanishes by luck
SKEWED = (
    "rigid_body.x_G.value=0.4",
    "added_mass.Y_rdot.value=-60",
    "added_mass.N_vdot.value=-60",
)


def vessels() -> list[FossenConfig]:
    files = vessel_files()
    known = [load_vessel(name) for name in files]
    # what the tests below say of commands holds for two thrusters side by side
    twin = [
        vessel
        for vessel in known
        if isinstance(vessel, FossenConfig)
        and isinstance(vessel.actuators, DifferentialThrustConfig)
    ]
    return [*twin, load_config(files["wam_v_cal"], list(SKEWED), FossenConfig)]


VESSELS = vessels()
IDS = [*(vessel.name for vessel in VESSELS[:-1]), "skewed"]


@pytest.fixture(params=VESSELS, ids=IDS)
def vessel(request: pytest.FixtureRequest) -> FossenConfig:
    return request.param


def motions(count: int = 200, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).normal(size=(count, 3)) * [1.5, 0.6, 0.4])


def test_right_hand_side_written_out(vessel: FossenConfig) -> None:
    """M nu_dot + C nu + D nu = tau with every matrix as document 003 eqs. (5)-(9) and W1, W2
    have it, vessel by vessel.
    """
    body, added, damping = vessel.rigid_body, vessel.added_mass, vessel.damping
    m, arm = body.m.value, body.m.value * body.x_G.value
    m11, m22 = m - added.X_udot.value, m - added.Y_vdot.value
    m23, m32, m33 = (
        arm - added.Y_rdot.value,
        arm - added.N_vdot.value,
        body.I_z.value - added.N_rdot.value,
    )
    mass = np.array([[m11, 0, 0], [0, m22, m23], [0, m32, m33]])
    nu, tau = motions().numpy(), np.random.default_rng(1).normal(size=(200, 3)) * 300
    value = {
        "u": lambda u, v, r: u, "v": lambda u, v, r: v, "r": lambda u, v, r: r,
        "u|u|": lambda u, v, r: u * abs(u),
        "v|v|": lambda u, v, r: v * abs(v), "r|r|": lambda u, v, r: r * abs(r),
        "|u|v": lambda u, v, r: abs(u) * v,
    }  # fmt: skip
    hull = vessel.hull()
    got = hull(torch.from_numpy(nu), torch.from_numpy(tau)).numpy()
    for (u, v, r), force, out in zip(nu, tau, got, strict=True):
        coriolis = np.array(
            [
                [0, 0, -m22 * v - 0.5 * (m23 + m32) * r],
                [0, 0, m11 * u],
                [m22 * v + 0.5 * (m23 + m32) * r, -m11 * u, 0],
            ]
        )
        drag = np.array(
            [
                sum(p.value * value[t](u, v, r) for t, p in row.items())
                for row in (damping.X, damping.Y, damping.N)
            ]
        )
        residual = mass @ out + coriolis @ [u, v, r] + drag - force
        assert np.abs(residual).max() < 1e-10 * np.abs(force).max()


def test_coriolis_does_no_work(vessel: FossenConfig) -> None:
    nu = motions()
    force = vessel.model_copy(update={"damping": type(vessel.damping)()}).hull().load(nu)
    power = (nu * force).sum(-1)
    assert float(power.abs().max()) < 1e-12 * float((nu * force).abs().max())


def test_damping_takes_energy(vessel: FossenConfig) -> None:
    """At the motions of a vessel; the weather-vane moment of CAL may feed yaw, never the whole."""
    nu = motions()
    free = vessel.model_copy(update={"damping": type(vessel.damping)()})
    drag = free.hull().load(nu) - vessel.hull().load(nu)
    surge_and_sway = (nu[:, :2] * drag[:, :2]).sum(-1)
    assert bool((surge_and_sway > 0).all())


@pytest.mark.parametrize("name", ["wam_v_vrx"])
def test_kinetic_energy_never_grows_without_input(name: str) -> None:
    """VRX damping is diagonal, so every motion must lose energy at every step."""
    plant = load_vessel(name).build()
    x0 = torch.zeros(64, 8, dtype=torch.float64)
    x0[:, 3:6] = motions(64, 3)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.02))(
            x0, torch.zeros(64, 500, len(plant.inputs), dtype=torch.float64), x0[:, :0]
        )
    nu = states[..., 3:6]
    energy = 0.5 * torch.einsum("bti,ij,btj->bt", nu, plant.hull.mass, nu)
    assert bool((energy.diff(dim=1) < 0).all())
    assert bool((energy[:, -1] < 1e-3 * energy[:, 0]).all())


def test_every_vessel_comes_to_rest_without_input(vessel: FossenConfig) -> None:
    plant = vessel.build()
    x0 = torch.zeros(32, 8, dtype=torch.float64)
    x0[:, 3:6] = motions(32, 4)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.05))(
            x0, torch.zeros(32, 800, len(plant.inputs), dtype=torch.float64), x0[:, :0]
        )
    assert float(states[:, -1, 3:6].abs().max()) < 1e-3


def test_inertia_alone_keeps_energy(vessel: FossenConfig) -> None:
    """Without damping and force the kinetic energy of a symmetric mass matrix is a constant of
    motion: RK4 drifts by O(dt^5) only.
    """
    bare = vessel.model_copy(update={"damping": type(vessel.damping)()})
    plant = bare.build()
    x0 = torch.zeros(16, 8, dtype=torch.float64)
    x0[:, 3:6] = motions(16, 5)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.01))(
            x0, torch.zeros(16, 300, len(plant.inputs), dtype=torch.float64), x0[:, :0]
        )
    nu = states[..., 3:6]
    energy = 0.5 * torch.einsum("bti,ij,btj->bt", nu, plant.hull.mass, nu)
    assert float((energy / energy[:, :1] - 1).abs().max()) < 1e-7


def test_port_and_starboard_are_mirror_images(vessel: FossenConfig) -> None:
    hull, nu = vessel.hull(), motions()
    tau = torch.from_numpy(np.random.default_rng(6).normal(size=(200, 3)) * 200)
    mirror = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(
        hull(nu * mirror, tau * mirror), hull(nu, tau) * mirror, rtol=1e-12, atol=1e-12
    )


def test_mirrored_commands_give_the_mirrored_track(vessel: FossenConfig) -> None:
    plant = vessel.build()
    w = torch.zeros(2, 600, len(plant.inputs), dtype=torch.float64)
    w[0, :, :2] = plant.demand(
        torch.tensor(0.5, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    )
    w[1, :, :2] = plant.demand(
        torch.tensor(0.5, dtype=torch.float64), torch.tensor(-0.3, dtype=torch.float64)
    )
    x0 = torch.zeros(2, 8, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.05))(x0, w, x0[:, :0])
    mirror = torch.tensor([1.0, -1.0, -1.0, 1.0, -1.0, -1.0], dtype=torch.float64)
    torch.testing.assert_close(states[1, :, :6], states[0, :, :6] * mirror, rtol=1e-10, atol=1e-12)
    assert float(states[0, -1, 2]) > 0.5


def test_gradients_of_the_right_hand_side(vessel: FossenConfig) -> None:
    """Away from the kinks of |.| and of the dead band."""
    plant = vessel.build()
    x = torch.tensor(
        [
            [1.0, -2.0, 0.7, 1.2, -0.3, 0.25, 20.0, -15.0],
            [0.0, 0.0, -1.0, -0.8, 0.4, -0.3, 10.0, 30.0],
        ],
        dtype=torch.float64,
    )
    w = torch.tensor(
        [[0, 0, 30.0, -20.0, 10.0, 0.2, -0.1, 40.0, 15.0], [0, 0, 0, 0, 0, -0.3, 0.2, 0.0, -30.0]],
        dtype=torch.float64,
    )
    assert torch.autograd.gradcheck(plant.rate, (x.requires_grad_(), w.requires_grad_()))


def test_a_current_that_carries_the_vessel_exerts_no_force(vessel: FossenConfig) -> None:
    """At rest relative to the water at any heading: no acceleration over ground; it drifts with the
    water and keeps its heading.
    """
    plant = vessel.build()
    psi = torch.linspace(-3, 3, 7, dtype=torch.float64)
    north, east = 0.4, -0.25
    x = torch.zeros(7, 8, dtype=torch.float64)
    x[:, 2] = psi
    x[:, 3] = north * torch.cos(psi) + east * torch.sin(psi)
    x[:, 4] = -north * torch.sin(psi) + east * torch.cos(psi)
    w = torch.zeros(7, 200, len(plant.inputs), dtype=torch.float64)
    w[:, :, 5], w[:, :, 6] = north, east
    assert float(plant.rate(x, w[:, 0])[:, 3:].abs().max()) < 1e-13
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.05))(x, w, x[:, :0])
    there = torch.stack((torch.full_like(psi, 4.0), torch.full_like(psi, -2.5), psi), dim=1)
    torch.testing.assert_close(states[:, -1, :3], there, rtol=0, atol=1e-11)


def test_a_current_is_a_moving_frame(vessel: FossenConfig) -> None:
    """Galilei: a manoeuvre in a current is the manoeuvre in still water plus the drift."""
    plant = vessel.build()
    w = torch.zeros(2, 1500, len(plant.inputs), dtype=torch.float64)
    w[:, :, :2] = plant.demand(
        torch.tensor(0.6, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
    )
    w[1, :, 5], w[1, :, 6] = 0.3, 0.2
    x0 = torch.zeros(2, 8, dtype=torch.float64)
    x0[1, 3], x0[1, 4] = 0.3, 0.2
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.02))(x0, w, x0[:, :0])
    time = 0.02 * 1500
    drift = states[1, -1, :3] - states[0, -1, :3]
    torch.testing.assert_close(
        drift, torch.tensor([0.3 * time, 0.2 * time, 0.0], dtype=torch.float64), rtol=0, atol=2e-5
    )


def test_top_speed_and_pivot_of_the_calibrated_set() -> None:
    """Corrections of document 003: 2.19 m/s at most; a pivot at 25.9 deg/s with v = -0.19 m/s."""
    plant = load_vessel("wam_v_cal").build()
    w = torch.zeros(2, 1200, len(plant.inputs), dtype=torch.float64)
    w[0, :, :2] = plant.demand(
        torch.tensor(1.0, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)
    )
    w[1, :, :2] = plant.demand(
        torch.tensor(0.0, dtype=torch.float64), torch.tensor(1.0, dtype=torch.float64)
    )
    x0 = torch.zeros(2, 8, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.05))(x0, w, x0[:, :0])
    assert float(states[0, -1, 3]) == pytest.approx(2.19, abs=0.005)
    assert np.degrees(float(states[1, -1, 5])) == pytest.approx(25.9, abs=0.05)
    assert float(states[1, -1, 4]) == pytest.approx(-0.19, abs=0.005)


def test_a_mass_matrix_that_is_not_positive_stops() -> None:
    config = load_config(vessel_files()["wam_v_cal"], ["added_mass.X_udot.value=400"], FossenConfig)
    with pytest.raises(
        ConfigError, match=r"wam_v_cal.*mass matrix is not positive definite"
    ) as caught:
        config.hull()
    assert "\n" not in str(caught.value)
    coupled = load_config(
        vessel_files()["wam_v_cal"],
        ["added_mass.Y_rdot.value=-2000", "added_mass.N_vdot.value=-2000"],
        FossenConfig,
    )
    with pytest.raises(ConfigError, match="positive definite"):
        coupled.hull()


def test_a_force_held_in_earth_axes_turns_with_the_hull() -> None:
    """The same force given in earth axes and, turned by hand, in body axes."""
    plant = load_vessel("wam_v_cal").build()
    x = torch.zeros(2, 8, dtype=torch.float64)
    x[:, 2] = 0.7
    w = torch.zeros(2, len(plant.inputs), dtype=torch.float64)
    w[0, 7:] = torch.tensor([40.0, -15.0], dtype=torch.float64)
    w[1, 2] = 40.0 * np.cos(0.7) - 15.0 * np.sin(0.7)
    w[1, 3] = -40.0 * np.sin(0.7) - 15.0 * np.cos(0.7)
    given, turned = plant.rate(x, w)
    torch.testing.assert_close(given, turned, rtol=1e-13, atol=0)
