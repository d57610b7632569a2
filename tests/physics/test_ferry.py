"""The ferry milliAmpere and the mass-spring-damper: their matrices written out, the figures of
the corrections of document 002, the thrusters.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.actuators import AzimuthThrusters, AzimuthThrustersConfig
from residnet.physics.hull import MassMatrixConfig
from residnet.physics.plant import HullPlant, MassSpringDamperConfig
from residnet.physics.vessel import load_vessel, vessel_files


def ferry(name: str = "milliampere", *overrides: str) -> HullPlant:
    return load_config(vessel_files()[name], list(overrides), MassMatrixConfig).build()


def motions(count: int = 300, seed: int = 0) -> Tensor:
    random = np.random.default_rng(seed)
    size = random.uniform(0.05, 1.0, (count, 3)) * [2.0, 1.5, 0.5]
    return torch.from_numpy(size * random.choice([-1.0, 1.0], (count, 3)))


@pytest.mark.parametrize(("name", "delta"), [("milliampere", 1.0), ("milliampere_half", 0.5)])
def test_matrices_written_out(name: str, delta: float) -> None:
    """(2.3)-(2.6), (4.1), (4.2) with Table A.1."""
    mass = np.array([[2389.657, 0, 0], [0, 2533.911, 62.386], [0, 28.141, 5068.910]])
    nu, tau = motions().numpy(), np.random.default_rng(1).normal(size=(300, 3)) * 300
    hull = ferry(name).hull
    got = hull(torch.from_numpy(nu), torch.from_numpy(tau)).numpy()
    assert np.linalg.det(mass) == pytest.approx(3.07e10, rel=1e-3)
    for (u, v, r), force, out in zip(nu, tau, got, strict=True):
        c13, c23 = -2533.911 * v - 62.386 * r, 2389.657 * u
        coriolis = np.array([[0, 0, c13], [0, 0, c23], [-c13, -c23, 0]])
        damping = np.array([
            [27.632 + 110.064 * abs(u) + 13.965 * u**2, 0, 0],
            [
                0,
                52.947 + 116.486 * abs(v) + 1540.383 * abs(r) + 24.313 * v**2,
                -24.732 - 572.141 * abs(v) + 115.457 * abs(r),
            ],
            [
                0,
                -3.524 + 0.832 * abs(v) - 336.827 * abs(r),
                122.860 + 121.957 * abs(v) + 874.428 * abs(r),
            ],
        ])  # fmt: skip
        wanted = delta * (mass @ out + coriolis @ [u, v, r] + damping @ [u, v, r])
        np.testing.assert_allclose(wanted, force, atol=1e-10 * np.abs(force).max())
    required = hull.required(torch.from_numpy(got), torch.from_numpy(nu)).numpy()
    np.testing.assert_allclose(required, tau, atol=1e-10 * np.abs(tau).max())


@pytest.mark.parametrize(
    ("speed", "pole"), [(0.2, 0.0064), (0.5, 0.0545), (1.0, 0.135), (2.0, 0.296)]
)
def test_yaw_is_unstable_above_walking_pace(speed: float, pole: float) -> None:
    """Correction J6; at rest the poles are -0.019 and -0.026."""
    hull = ferry().hull

    def poles(u: float) -> Tensor:
        nu = torch.tensor([u, 0.0, 0.0], dtype=torch.float64)
        slope = torch.autograd.functional.jacobian(lambda x: hull(x, torch.zeros_like(x)), nu)
        return torch.linalg.eigvals(slope[1:, 1:]).real

    assert float(poles(speed).max()) == pytest.approx(pole, rel=0.02)
    np.testing.assert_allclose(np.sort(poles(0.0).numpy()), [-0.026, -0.019], atol=1e-3)


def test_damping_takes_energy() -> None:
    """Correction J6: nu^T D nu >= 0 for |v| < 1.5, |r| < 0.5."""
    # the whole load: C does no work
    nu = motions(5000)
    assert float((nu * ferry().hull.load(nu)).sum(-1).max()) <= 0


def test_coriolis_is_skew_as_printed() -> None:
    """C does no work although M is not symmetric (correction J4)."""
    nu = motions()
    force = ferry("milliampere", "damping={}").hull.load(nu)
    assert float((nu * force).sum(-1).abs().max()) < 1e-12 * float((nu * force).abs().max())


def test_mirror_symmetry() -> None:
    flip = torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    hull, nu, tau = ferry().hull, motions(), motions(seed=1) * 200
    torch.testing.assert_close(
        hull(nu * flip, tau * flip), hull(nu, tau) * flip, rtol=1e-12, atol=1e-13
    )


def test_gradients() -> None:
    plant = ferry("milliampere_half")
    random = torch.Generator().manual_seed(0)
    x = torch.cat(
        (
            torch.randn(6, 3, generator=random, dtype=torch.float64),
            motions(6),
            motions(6, 1) * 100,
            motions(6, 2) * 50,
        ),
        dim=1,
    )
    w = torch.cat((motions(6, 3) * 100, torch.zeros(6, 7, dtype=torch.float64)), dim=1)
    assert torch.autograd.gradcheck(plant.rate, (x.requires_grad_(), w.requires_grad_()))


def test_forces_follow_by_the_thruster_dynamics() -> None:
    """(4.3): step response of 4 / (s^2 + 3.2 s + 4) by its closed form, and the limits."""
    plant = ferry()
    x0 = plant.approach(1)
    w = torch.zeros(1, 300, len(plant.inputs), dtype=torch.float64)
    w[..., 0], w[..., 1], w[..., 2] = 100.0, -5000.0, 30.0
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.01))(x0, w, x0[:, :0])
    t = 0.01 * np.arange(301)
    step = 1 - np.exp(-1.6 * t) * (np.cos(1.2 * t) + 1.6 / 1.2 * np.sin(1.2 * t))
    np.testing.assert_allclose(states[0, :, 6:9], step[:, None] * [100.0, -995.0, 30.0], atol=1e-5)


def test_steady_surge_balances_the_drag() -> None:
    plant = ferry("milliampere", "actuators.response={kind: immediate}").in_calm_water()
    w = torch.tensor([[200.0, 0.0, 0.0]], dtype=torch.float64)
    x0 = plant.approach(1)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.1))(
            x0, w[:, None].expand(1, 3000, 3), x0[:, :0]
        )
    u = float(states[0, -1, 3])
    assert 27.632 * u + 110.064 * u**2 + 13.965 * u**3 == pytest.approx(200.0, rel=1e-6)


def azimuth(*overrides: str) -> AzimuthThrusters:
    actuators = ferry("milliampere_azimuth", *overrides).actuators
    assert isinstance(actuators, AzimuthThrusters)
    return actuators


def test_azimuth_thrusters_written_out() -> None:
    """(5.1), (5.2) in rpm."""
    rng = np.random.default_rng(0)
    rpm, angle = rng.uniform(-5200, 5200, (100, 2)), rng.uniform(-3, 3, (100, 2))
    thrust = (
        -1.31e-16 * rpm**5
        - 1.78e-13 * rpm**4
        + 6.16e-9 * rpm**3
        + 8.7e-6 * rpm**2
        + 0.00478 * rpm
        - 1.07
    )
    along, across = np.cos(angle) * thrust, np.sin(angle) * thrust
    wanted = np.stack([along.sum(1), across.sum(1), 1.8 * (across[:, 0] - across[:, 1])], axis=1)
    command = torch.from_numpy(np.concatenate([rpm / 60, angle], axis=1))
    got = azimuth().force(command[:, :0], command, command[:, :3])
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9)


def test_allocation_makes_the_wanted_forces_with_least_thrust() -> None:
    thrusters = azimuth()
    tau = torch.from_numpy(np.random.default_rng(0).normal(size=(200, 3)) * [150, 150, 150])
    command = thrusters.allocate(tau)
    torch.testing.assert_close(thrusters.force(tau[:, :0], command, tau), tau, rtol=1e-9, atol=1e-9)
    thrust, angle = thrusters.thrust(command[:, :2]), command[:, 2:]
    parts = torch.cat((thrust * torch.cos(angle), thrust * torch.sin(angle)), dim=1).numpy()
    for want, part in zip(tau.numpy(), parts, strict=True):
        rows = np.array([[1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1.8, -1.8]])
        np.testing.assert_allclose(part, np.linalg.lstsq(rows, want, rcond=None)[0], atol=1e-9)
    # beyond what a thruster can do, each keeps its angle at full thrust
    far = thrusters.allocate(torch.tensor([[5000.0, 0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(far, torch.tensor([[87.5, 87.5, 0.0, 0.0]], dtype=torch.float64))
    nothing = thrusters.force(tau[:1, :0], thrusters.allocate(tau[:1] * 0), tau[:1])
    torch.testing.assert_close(nothing, tau[:1] * 0, atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("actuators.shaft.n_max=5400 rpm", "curve_range"),
        ("actuators.shaft.n_max=5300 rpm", "thrust falls"),
        (
            "actuators.places=[{name: bow, x: 1.8}, {name: bow, x: -1.8}]",
            "two thrusters are named 'bow'",
        ),
        ("actuators.places=[{name: bow, x: 1.8}]", "give two places"),
        ("mass.m11.value=-1", "not positive definite"),
        ("scale=0", "scale"),
    ],
)
def test_wrong_files(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        ferry("milliampere_azimuth", override)
    assert "\n" not in str(caught.value)


def test_a_base_of_another_kind_of_actuators() -> None:
    vessel = load_vessel("milliampere_azimuth")
    assert isinstance(vessel, MassMatrixConfig)
    assert isinstance(vessel.actuators, AzimuthThrustersConfig)
    known = load_vessel("milliampere")
    assert isinstance(known, MassMatrixConfig)
    assert (vessel.mass, vessel.damping) == (known.mass, known.damping)


def test_mass_spring_damper() -> None:
    """(5.13) under section 5.3.1's square wave, against SciPy; without force its energy falls."""
    config = MassSpringDamperConfig()
    plant = config.build()
    t = 0.1 * np.arange(500)
    w = torch.from_numpy(np.where(np.mod(t, 6 * np.pi) < 3 * np.pi, 1.0, -1.0))[None, :, None]
    x0 = torch.zeros(1, 2, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, 0.1, substeps=5))(x0, w, x0[:, :0])

    def rate(_: float, y: np.ndarray, force: float) -> list[float]:
        return [y[1], -1.3 * y[1] + 0.1 * force - 0.5 * y[0]]

    x = np.zeros(2)
    for k in range(500):
        force = float(w[0, k, 0])
        np.testing.assert_allclose(states[0, k], x, atol=1e-7)
        x = solve_ivp(
            rate,
            (0, 0.1),
            x,
            args=(force,),
            rtol=1e-10,
            atol=1e-12,
        ).y[:, -1]
    start = torch.tensor([[1.0, -0.4]], dtype=torch.float64)
    free, _, _ = Rollout(PlantDynamics(plant, 0.05))(start, w[:, :400] * 0, start[:, :0])
    energy = 0.5 * config.m.value * free[0, :, 1] ** 2 + 0.5 * config.k.value * free[0, :, 0] ** 2
    assert bool((energy[1:] < energy[:-1]).all())
    assert plant.demand(torch.tensor([2.0, -0.5]), torch.zeros(2)).tolist() == [[1.0], [-0.5]]
    with pytest.raises(ValueError, match="its unit must be kg/s"):
        MassSpringDamperConfig.model_validate({"d": {"value": 1.0, "unit": "kg", "source": "made"}})
