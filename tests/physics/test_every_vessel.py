"""What every vessel file promises, whatever its kind: shapes, units, symmetry, energy, currents,
and the fast ways to step it against the plain one.
"""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from residnet.core.config import load_config
from residnet.core.names import CHANNEL_UNITS
from residnet.core.registry import find_vessel_files
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout
from residnet.physics.hull import SubmergedHullConfig
from residnet.physics.plant import HullPlant, Plant
from residnet.physics.vessel import VesselConfig, load_vessel

HULLS = [name for name in find_vessel_files() if not name.startswith("nomoto")]
# the forces of a real hull: the published series of the Mariner has Y_0 and N_0, and the screw of
# the REMUS turns one way
SYMMETRIC = [name for name in find_vessel_files() if name not in ("mariner", "remus_100")]
ODD = {"y", "psi", "phi", "v", "r", "p", "delta", "fin", "nozzle", "tau_y", "tau_n", "force_y",
       "force_k", "force_n", "current_east", "force_east", "wind_dir", "_yaw_lag"}  # fmt: skip


def scene(plant: Plant, rows: int = 4) -> tuple[Tensor, Tensor]:
    """States and inputs of a vessel under way, all of them different from zero."""
    random = torch.Generator().manual_seed(0)
    x = plant.make_initial_state(rows)
    x = x + 0.05 + 0.1 * torch.rand(x.shape, generator=random, dtype=torch.float64)
    x[:, plant.state_names.index("u")] += 1.0
    w = 0.1 + 0.1 * torch.rand(rows, len(plant.input_names), generator=random, dtype=torch.float64)
    steer = torch.linspace(-0.5, 0.4, rows, dtype=torch.float64)
    w[:, : plant.n_commands] = plant.commands_for_demand(torch.full_like(steer, 0.6), steer)
    return x, w


def mirrored(values: Tensor, names: tuple[str, ...]) -> Tensor:
    """The same scene in the mirror of the vessel's centre plane."""
    other = [
        names.index(name.replace("port", "*").replace("stbd", "port").replace("*", "stbd"))
        for name in names
    ]
    plain = [name.removeprefix("cmd_").removeprefix("_").removeprefix("acting_") for name in names]
    sign = [
        -1.0 if p.removesuffix("_rate") in ODD or n in ODD or "alpha" in n else 1.0
        for p, n in zip(plain, names, strict=True)
    ]
    return values[..., other] * torch.tensor(sign, dtype=values.dtype)


@pytest.mark.parametrize("name", find_vessel_files())
def test_a_vessel_in_a_batch_with_gradients(name: str) -> None:
    vessel = load_vessel(name)
    assert vessel.name == name, "a vessel is called as its file"
    plant = vessel.build()
    x, w = scene(plant)
    # at rest, too, slopes stay finite
    x[3] = 0.0
    rate = plant.derivative(x.requires_grad_(), w.requires_grad_())
    assert rate.shape == x.shape
    for slope in torch.autograd.grad(rate.sum(), (x, w), allow_unused=True):
        assert slope is None or bool(torch.isfinite(slope).all())
    for row in (0, 2):
        one = slice(row, row + 1)
        torch.testing.assert_close(
            plant.derivative(x[one], w[one])[0], rate[row], rtol=1e-9, atol=1e-12
        )
        moved = plant.finish_step(x[one], w[one], 0.01)[0]
        torch.testing.assert_close(moved, plant.finish_step(x, w, 0.01)[row])
    # what a log may hold has a unit; thrusters are named by the vessel file
    free = ("_", "n_", "alpha_", "cmd_n_", "cmd_alpha_", "cmd_thrust_")
    logged = [
        n
        for n in (*plant.state_names, *plant.input_names[: plant.n_commands])
        if not n.startswith(free)
    ]
    assert [n for n in logged if n not in CHANNEL_UNITS] == []
    assert {"x", "y", "psi", "u", "v", "r"} <= set(plant.state_names)


@pytest.mark.parametrize("name", find_vessel_files())
def test_a_vessel_turns_to_starboard_where_it_is_steered(name: str) -> None:
    """From where trials start, at full drive, to one side and the other."""
    plant = load_vessel(name).build()
    x = plant.make_initial_state(2)
    steer = torch.tensor([0.3, -0.3], dtype=torch.float64)
    w = torch.zeros(2, 80, len(plant.input_names), dtype=torch.float64)
    w[:, :, : plant.n_commands] = plant.commands_for_demand(torch.ones_like(steer), steer)[:, None]
    with torch.no_grad():
        states, _, _ = Rollout(RecordedPlantDynamics(plant, 0.1))(x, w, x[:, :0])
    turned = states[:, -1, plant.state_names.index("psi")]
    assert float(turned[0]) > 0 > float(turned[1])
    assert bool((states[:, -1, plant.state_names.index("u")] > 0).all())


@pytest.mark.parametrize("name", SYMMETRIC)
def test_port_and_starboard_are_mirror_images(name: str) -> None:
    plant = load_vessel(name).build()
    x, w = scene(plant)
    rate = plant.derivative(mirrored(x, plant.state_names), mirrored(w, plant.input_names))
    torch.testing.assert_close(
        rate, mirrored(plant.derivative(x, w), plant.state_names), rtol=1e-9, atol=1e-11
    )


@pytest.mark.parametrize("name", HULLS)
def test_calm_water_held_forces_and_the_recorded_step_are_the_same_vessel(name: str) -> None:
    """To rounding, and at another batch size than recorded."""
    full = load_vessel(name).build()
    calm = load_vessel(name).build().without_environment()
    x, w = scene(full, 5)
    torch.testing.assert_close(
        full.derivative_prepared(x, full.prepare(x, w)), full.derivative(x, w)
    )
    w[:, full.n_commands :] = 0.0
    # a vessel with wind coefficients meets the air that it drives through
    full.wind = None
    assert calm.input_names == full.actuators.command_names
    after = PlantDynamics(full, 0.05, substeps=2).step(x, w, x[:, :0])[0]
    command = w[:, : calm.n_commands]
    for model in (PlantDynamics(calm, 0.05, 2), RecordedPlantDynamics(calm, 0.05, 2)):
        torch.testing.assert_close(
            model.step(x, command, x[:, :0])[0], after, rtol=1e-9, atol=1e-11
        )


@pytest.mark.parametrize("name", HULLS)
def test_a_current_carries_and_a_force_in_earth_axes_turns(name: str) -> None:
    """Afloat with the water nothing acts on an upright hull; earth-fixed forces are those turned by
    hand.
    """
    plant = load_vessel(name).build()
    x, psi = (
        torch.zeros(7, len(plant.state_names), dtype=torch.float64),
        torch.linspace(-3, 3, 7).double(),
    )
    column = plant.state_names.index
    place = plant.input_names.index
    x[:, column("psi")] = psi
    x[:, column("u")] = 0.4 * torch.cos(psi) - 0.25 * torch.sin(psi)
    x[:, column("v")] = -0.4 * torch.sin(psi) - 0.25 * torch.cos(psi)
    w = torch.zeros(7, len(plant.input_names), dtype=torch.float64)
    w[:, place("current_north")], w[:, place("current_east")] = 0.4, -0.25
    plant.wind = None
    # what the series and some actuators do at rest in the water is there without a current too
    still = plant.derivative(x * 0.0, w * 0.0)
    rate = plant.derivative(x, w) - still
    torch.testing.assert_close(rate[:, :2], torch.tensor([[0.4, -0.25]]).double().expand(7, 2))
    assert float(rate[:, 2:].abs().max()) < 1e-12
    turned = w.clone()
    w[:, place("force_north")], w[:, place("force_east")] = 40.0, -15.0
    turned[:, place("force_x")] = 40.0 * torch.cos(psi) - 15.0 * torch.sin(psi)
    turned[:, place("force_y")] = -40.0 * torch.sin(psi) - 15.0 * torch.cos(psi)
    torch.testing.assert_close(
        plant.derivative(x, w), plant.derivative(x, turned), rtol=1e-9, atol=1e-12
    )


_SKEW = ("rigid_body.x_G.value=0.4", "added_mass.Y_rdot.value=-60", "added_mass.N_vdot.value=-60")
_EVEN = ("added_mass.K_vdot.value=-296000", "added_mass.N_vdot.value=-1.4e6")
LOSSLESS = {
    "wam_v_cal": ("damping={}", *_SKEW),
    "patrol_p06": ("forces={}", *_EVEN),
    "remus_100": ("forces={}", "rigid_body.x_G.value=0.03", "buoyancy.volume.value=0.0305"),
}


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        *LOSSLESS.items(),
        ("wam_v_vrx", ()),
        ("milliampere", ()),
        ("bluerov2_heavy", ()),
    ],
)
def test_energy_is_kept_without_damping_and_falls_with_it(
    name: str, overrides: tuple[str, ...]
) -> None:
    """Kinetic energy and that of weight and buoyancy, as if the mass matrix were symmetric."""
    vessel = load_config(find_vessel_files()[name], list(overrides), VesselConfig)
    plant = vessel.build().without_environment()
    assert isinstance(plant, HullPlant)
    n = plant.n_dof
    random = torch.Generator().manual_seed(3)
    x0 = torch.zeros(16, len(plant.state_names), dtype=torch.float64)
    sizes = {3: [1.5, 0.6, 0.4], 4: [6.0, 1.0, 0.2, 0.05], 6: [0.4, 0.05, 0.05, 0.6, 0.15, 0.15]}
    spread = torch.tensor(sizes[n], dtype=torch.float64)
    x0[:, n : 2 * n] = torch.randn(16, n, generator=random, dtype=torch.float64) * spread
    w = torch.zeros(16, 300, len(plant.input_names), dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(RecordedPlantDynamics(plant, 0.01, 2 if n == 6 else 1))(
            x0, w, x0[:, :0]
        )
    nu = states[..., n : 2 * n]
    mass = 0.5 * (plant.hull.mass + plant.hull.mass.T)
    energy = 0.5 * torch.einsum("bti,ij,btj->bt", nu, mass, nu)
    if n == 4:
        energy = energy + 0.5 * 1025 * 9.81 * 355.88 * states[..., 2] ** 2
    if isinstance(vessel, SubmergedHullConfig):
        # tumbles too: the mean energy is lifted, so that shares of it mean something
        phi = states[..., 3]
        theta = states[..., 4]
        body = vessel.rigid_body
        water = vessel.buoyancy
        weight = body.m.value * 9.81
        lift = water.density.value * 9.81 * water.volume.value
        x, z = (
            weight * g.value - lift * b.value
            for g, b in ((body.x_G, water.x_B), (body.z_G, water.z_B))
        )
        depth = (weight - lift) * states[..., 2]
        upright = torch.cos(theta) * torch.cos(phi)
        energy = energy - depth + x * torch.sin(theta) - z * upright + abs(x) + abs(z) + 10.0
        assert float(phi.abs().max()) > 0.2
    if overrides == LOSSLESS.get(name):
        assert float((energy / energy[:, :1] - 1).abs().max()) < 1e-7
    else:
        assert bool((energy.diff(dim=1) < 0).all())


def test_the_torpedo_makes_its_published_speed() -> None:
    """2.5 m/s at 1525 rpm (Fossen, PythonVehicleSimulator, remus100.py), within 5 %."""
    plant = load_vessel("remus_100").build()
    w = torch.zeros(1, 150, len(plant.input_names), dtype=torch.float64)
    w[:, :, plant.input_names.index("cmd_n")] = 1525.0 / 60.0
    x0 = plant.make_initial_state(1)
    with torch.no_grad():
        states, _, _ = Rollout(RecordedPlantDynamics(plant, 0.2))(x0, w, x0[:, :0])
    assert float(states[0, -1, plant.state_names.index("u")]) == pytest.approx(2.5, rel=0.05)


def test_a_submerged_vessel_rights_itself_and_settles() -> None:
    """Heeled and pitched at rest it comes back upright, and what is heavier than water sinks."""
    plant = load_vessel("bluerov2_heavy").build()
    x0 = torch.zeros(1, len(plant.state_names), dtype=torch.float64)
    x0[0, 3], x0[0, 4] = 0.5, 0.4
    w = torch.zeros(1, 900, len(plant.input_names), dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(RecordedPlantDynamics(plant, 0.1, 2))(x0, w, x0[:, :0])
    last = states[0, -1]
    assert float(last[3:5].abs().max()) < 0.05
    # of 13.5 kg in 13.4 l of fresh water 1 N weighs down, against 33 N s/m and 190 N s^2/m^2
    assert float(last[plant.state_names.index("w")]) == pytest.approx(0.025, abs=0.003)
