"""Right-hand sides of every kind of vessel against their equations written out, and the figures
that the documents and their corrections print.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from exact_steps import NomotoDynamics
from numpy.polynomial.polynomial import polyval
from scipy.signal import TransferFunction, lsim
from torch import Tensor

from residnet.core.config import load_config
from residnet.core.registry import find_vessel_files
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.rollout import Rollout
from residnet.physics.abkowitz_config import AbkowitzConfig
from residnet.physics.froude import SPEED_REGIMES, classify_speed_regime, compute_froude_number
from residnet.physics.vessel import VesselConfig, load_vessel


def plant_of(name: str, *overrides: str) -> Any:
    return load_config(find_vessel_files()[name], list(overrides), VesselConfig).build()


def rolled(model: Dynamics, x0: Tensor, w: Tensor) -> Tensor:
    """States [B, T+1, nx] under inputs [B, T, m]."""
    with torch.no_grad():
        return Rollout(model)(x0, w, x0[:, :0])[0]


def scattered(spread: list[float], count: int = 200, seed: int = 0) -> Tensor:
    """Numbers away from the kinks at zero."""
    random = np.random.default_rng(seed)
    size = random.uniform(0.05, 1.0, (count, len(spread))) * spread
    return torch.from_numpy(size * random.choice([-1.0, 1.0], size.shape))


def test_matrices_of_a_hull_written_out() -> None:
    """M nu_dot + C nu + D nu = tau as document 003 eqs. (5)-(9) and W1, W2 have it."""
    skewed = ("rigid_body.x_G", 0.4), ("added_mass.Y_rdot", -60), ("added_mass.N_vdot", -90)
    overrides = [f"{name}.value={value}" for name, value in skewed]
    vessel = load_config(find_vessel_files()["wam_v_cal"], overrides, VesselConfig)
    body = vessel.rigid_body
    added = vessel.added_mass
    damping = vessel.damping
    m, arm = body.m.value, body.m.value * body.x_G.value
    m11, m22 = m - added.X_udot.value, m - added.Y_vdot.value
    m23, m32 = arm - added.Y_rdot.value, arm - added.N_vdot.value
    mass = np.array([[m11, 0, 0], [0, m22, m23], [0, m32, body.I_z.value - added.N_rdot.value]])
    nu, tau = scattered([1.5, 0.6, 0.4]), scattered([300.0] * 3, seed=1)
    got = vessel.build_hull()(nu, tau).numpy()
    for (u, v, r), force, out in zip(nu.numpy(), tau.numpy(), got, strict=True):
        value = {
            "u": u, "v": v, "r": r, "u|u|": u * abs(u), "v|v|": v * abs(v), "r|r|": r * abs(r),
            "|u|v": abs(u) * v,
        }  # fmt: skip
        side = m22 * v + 0.5 * (m23 + m32) * r
        coriolis = np.array([[0, 0, -side], [0, 0, m11 * u], [side, -m11 * u, 0]])
        rows = damping.values()
        drag = np.array([sum(p.value * value[t] for t, p in row.items()) for row in rows])
        residual = mass @ out + coriolis @ [u, v, r] + drag - force
        assert np.abs(residual).max() < 1e-10 * np.abs(force).max()


@pytest.mark.parametrize(
    ("name", "speed", "pole", "allowed"),
    [
        ("milliampere", 0.0, -0.019, 1e-3),
        ("milliampere", 2.0, 0.296, 6e-3),
        ("odin_forces", 1.0, 0.194, 6e-3),
    ],
)
def test_poles_of_sway_and_yaw(name: str, speed: float, pole: float, allowed: float) -> None:
    """Corrections J6 and H5: unstable above walking pace."""
    hull = plant_of(name).hull
    nu = torch.tensor([speed, 0.0, 0.0], dtype=torch.float64)
    slope = torch.autograd.functional.jacobian(lambda x: hull(x, torch.zeros_like(x)), nu)
    largest = float(torch.linalg.eigvals(slope[1:, 1:]).real.max())
    assert largest == pytest.approx(pole, abs=allowed)


def test_jets_thrust_as_printed_saturate_and_turn_to_the_side_that_is_asked_for() -> None:
    """Correction H15: value at rest, roots, where it turns, and the speed at which it is zero."""
    config: Any = load_vessel("odin_jets").actuators

    def thrust(rpm: float, u: float = 0.0) -> float:
        return float(config.jet_thrust(*torch.tensor([[rpm / 60], [u]], dtype=torch.float64)))

    assert thrust(0) == pytest.approx(118, abs=0.5)
    assert thrust(168) == pytest.approx(-90, abs=0.5)
    assert thrust(57.7) > 0 > thrust(57.9)
    assert thrust(278.6) < 0 < thrust(278.8)
    assert thrust(1000, 22.9) > 0 > thrust(1000, 23.3)
    assert max(range(2001), key=lambda rpm: -thrust(rpm)) == 168
    actuators = config.build()
    nu = torch.zeros(2, 3, dtype=torch.float64)
    turn = np.radians(27)
    beyond, limits = torch.tensor(
        [[[50.0, 1.0], [-5.0, -1.0]], [[2000 / 60, turn], [0.0, -turn]]], dtype=torch.float64
    )
    torch.testing.assert_close(
        actuators.force(nu[:, :0], beyond, nu), actuators.force(nu[:, :0], limits, nu)
    )
    command = actuators.commands_for_demand(
        *torch.tensor([[0.5, 0.5], [0.3, -0.3]], dtype=torch.float64)
    )
    tau = actuators.force(nu[:, :0], command, nu)
    assert float(tau[0, 2]) > 0 > float(tau[1, 2])
    torch.testing.assert_close(tau[:, 2], -3.82 * tau[:, 1])


def test_froude_phases() -> None:
    """Appendix D with the length of correction H17: 0.4 at 4.06 m/s, 1.0 at 10.1 m/s."""
    vessel = load_vessel("odin_forces")
    u = torch.tensor([0.0, 4.0, 4.1, 10.1, 10.2, 3.0], dtype=torch.float64)
    v = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, -4.0], dtype=torch.float64)
    froude = compute_froude_number(u, v, vessel.length.value)
    assert float(froude[3]) == pytest.approx(1.0, abs=0.005)
    assert [SPEED_REGIMES[i] for i in classify_speed_regime(froude).tolist()] == [
        "displacement", "displacement", "semi_displacement", "semi_displacement", "planing",
        "semi_displacement",
    ]  # fmt: skip
    assert classify_speed_regime(torch.tensor([0.4, 1.0, 1.1])).tolist() == [1, 2, 2]
    with pytest.raises(ValueError, match="length"):
        compute_froude_number(u, v, 0.0)


def test_azimuth_thrusters_written_out() -> None:
    """(5.1), (5.2) in rpm."""
    rng = np.random.default_rng(0)
    rpm = rng.uniform(-5200, 5200, (100, 2))
    angle = rng.uniform(-3, 3, (100, 2))
    thrust = polyval(rpm, [-1.07, 0.00478, 8.7e-6, 6.16e-9, -1.78e-13, -1.31e-16])
    along = np.cos(angle) * thrust
    across = np.sin(angle) * thrust
    wanted = np.stack([along.sum(1), across.sum(1), 1.8 * (across[:, 0] - across[:, 1])], axis=1)
    command = torch.from_numpy(np.concatenate([rpm / 60, angle], axis=1))
    got = plant_of("milliampere_azimuth").actuators.force(command[:, :0], command, command[:, :3])
    np.testing.assert_allclose(got, wanted, rtol=1e-9, atol=1e-9)


def test_allocation_makes_the_wanted_forces_with_least_thrust() -> None:
    thrusters = plant_of("milliampere_azimuth").actuators
    tau = torch.from_numpy(np.random.default_rng(0).normal(size=(200, 3)) * [150, 150, 150])
    command = thrusters.allocate(tau)
    torch.testing.assert_close(thrusters.force(tau[:, :0], command, tau), tau, rtol=1e-9, atol=1e-9)
    thrust = thrusters.thrust_at(command[:, :2])
    angle = command[:, 2:]
    parts = torch.cat((thrust * torch.cos(angle), thrust * torch.sin(angle)), dim=1).numpy()
    rows = np.array([[1, 1, 0, 0], [0, 0, 1, 1], [0, 0, 1.8, -1.8]])
    np.testing.assert_allclose(parts, tau.numpy() @ np.linalg.pinv(rows).T, atol=1e-9)
    # beyond what a thruster can do, each keeps its angle at full thrust
    far = thrusters.allocate(torch.tensor([[5000.0, 0.0, 0.0]], dtype=torch.float64))
    torch.testing.assert_close(far, torch.tensor([[87.5, 87.5, 0.0, 0.0]], dtype=torch.float64))
    nothing = thrusters.force(tau[:1, :0], thrusters.allocate(tau[:1] * 0), tau[:1])
    torch.testing.assert_close(nothing, tau[:1] * 0, atol=1e-9, rtol=0)


THRUST = 1960 * 7.71**2


def test_a_foil_beyond_stall_lifts_no_more() -> None:
    rudders = load_vessel("patrol_p06").actuators.build()
    delta = torch.linspace(-0.6, 0.6, 241, dtype=torch.float64)
    u, v, thrust = (torch.full_like(delta, value) for value in (7.0, 0.5, THRUST))
    lift, drag = rudders.config.lift_and_drag(delta, u, v, thrust)
    torch.testing.assert_close(lift, -lift.flip(0), rtol=1e-12, atol=1e-9)
    torch.testing.assert_close(drag, drag.flip(0), rtol=1e-12, atol=1e-9)
    stalled = delta > np.radians(23)
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


LENGTH = 160.93
SERVICE = 7.7175


def mariner(u: float, v: float, r: float, delta: float) -> np.ndarray:
    """Accelerations by the published derivatives (times 1e-5); delta positive to port, as there."""
    speed = np.hypot(u, v)
    e, v, r, d = (u - SERVICE) / speed, v / speed, r * LENGTH / speed, delta
    x = (
        -184 * e - 110 * e**2 - 215 * e**3 - 899 * v**2 + 18 * r**2 + 798 * r * v - 95 * d**2
        - 190 * e * d**2 + 93 * v * d + 93 * e * v * d
    )  # fmt: skip
    y = (
        -1160 * v - 499 * r - 8078 * v**3 + 15356 * v**2 * r - 1160 * v * e - 499 * r * e + 278 * d
        - 90 * d**3
        + 556 * e * d + 278 * e**2 * d - 4 * v * d**2 + 1190 * v**2 * d - 4 - 8 * e - 4 * e**2
    )  # fmt: skip
    n = (
        -264 * v - 166 * r + 1636 * v**3 - 5483 * v**2 * r - 264 * v * e - 166 * r * e - 139 * d
        + 45 * d**3
        - 278 * e * d - 139 * e**2 * d + 13 * v * d**2 - 489 * v**2 * d + 3 + 6 * e + 3 * e**2
    )  # fmt: skip
    m11, m22 = 798 + 42.0, 798 + 748.0
    m23, m32, m33 = 798 * -0.023 + 9.354, 798 * -0.023 - 4.646, 39.2 + 43.8
    side = np.linalg.solve([[m22, m23], [m32, m33]], [y, n])
    return np.array([x / m11, side[0], side[1] / LENGTH]) * speed**2 / LENGTH


def test_the_mariner_written_out() -> None:
    plant = load_vessel("mariner").build()
    rng = np.random.default_rng(0)
    for _ in range(50):
        nu = np.array([7.0, 0.0, 0.0]) + rng.normal(size=3) * [1.0, 0.8, 0.01]
        delta = rng.uniform(-0.6, 0.6)
        x = torch.tensor([[0.0, 0.0, 0.0, *nu, delta]], dtype=torch.float64)
        w = torch.zeros(1, len(plant.input_names), dtype=torch.float64)
        w[0, 0] = delta
        u, v, r = nu
        np.testing.assert_allclose(
            plant.derivative(x, w)[0, 3:6], mariner(u, v, r, -delta), rtol=1e-10, atol=1e-14
        )


def test_prime_and_si_are_the_same_vessel() -> None:
    """At the service speed, where the present speed does not scale the series."""
    prime = load_vessel("mariner")
    assert isinstance(prime, AbkowitzConfig)
    force = 0.5 * 1025 * LENGTH**2 * SERVICE**2
    length = LENGTH
    speed = SERVICE
    unit = {"du": 1 / speed, "v": 1 / speed, "r": length / speed, "delta": 1.0}

    def scaled(term: str, value: float, size: float) -> float:
        for factor in term.split():
            name, _, power = factor.partition("^")
            size *= unit.get(name, 1.0) ** int(power or 1)
        return value * size

    rows = {
        axis: {term: scaled(term, value, size) for term, value in row.items()}
        for axis, row, size in zip(
            "XYN", dict(prime.coefficients).values(), (force, force, force * length), strict=True
        )
    }
    kilo = 0.5 * 1025 * length**3
    body = prime.mass
    mass = {
        "m": body.m * kilo, "I_z": body.I_z * kilo * length**2, "x_G": body.x_G * length,
        "X_udot": body.X_udot * kilo,
        "Y_vdot": body.Y_vdot * kilo, "Y_rdot": body.Y_rdot * kilo * length,
        "N_vdot": body.N_vdot * kilo * length,
        "N_rdot": body.N_rdot * kilo * length**2,
    }  # fmt: skip
    si = AbkowitzConfig.model_validate(
        prime.model_dump() | {"units": "si", "coefficients": rows, "mass": mass}
    )
    a, b = prime.build(), si.build()
    v = 0.5
    x = torch.tensor(
        [[0.0, 0.0, 0.3, np.sqrt(SERVICE**2 - v**2), v, 0.008, -0.2]], dtype=torch.float64
    )
    w = torch.zeros(1, len(a.input_names), dtype=torch.float64)
    w[0, 1:4] = torch.tensor([2e5, -1e5, 3e7])
    torch.testing.assert_close(a.derivative(x, w), b.derivative(x, w), rtol=1e-9, atol=1e-12)


def test_coriolis_of_the_rigid_body_may_stand_outside_the_series() -> None:
    """Taking m out of X_vr and Y_r, and m x_G out of N_r and X_rr, and adding C_RB gives the same
    (at the service speed).
    """
    inside = load_vessel("mariner")
    m, x_g = 798e-5, -0.023
    changes = {
        "X.v r": 798e-5 - m,
        "X.r^2": 18e-5 - m * x_g,
        "Y.r": -499e-5 + m,
        "Y.du r": -499e-5 + m,
        "N.r": -166e-5 + m * x_g,
        "N.du r": -166e-5 + m * x_g,
    }
    overrides = [f"coefficients.{key}={value}" for key, value in changes.items()]
    outside: Any = plant_of("mariner", "coriolis=rigid_body", *overrides)
    a, b = inside.build(), outside
    # at the service speed: the series counts 1 + (U - U0) / U where the body has u / U
    x = torch.tensor(
        [[0.0, 0.0, 0.3, np.sqrt(SERVICE**2 - 0.25), 0.5, 0.008, -0.2]], dtype=torch.float64
    )
    w = torch.zeros(1, len(a.input_names), dtype=torch.float64)
    torch.testing.assert_close(a.derivative(x, w), b.derivative(x, w), rtol=1e-9, atol=1e-14)


def test_revolutions_enter_where_the_series_knows_them() -> None:
    shaft = "shaft={n_0: 1.5, n_max: 2, n_rate: 0.1}"
    plant = plant_of("mariner", shaft, "coefficients.X.dn=400.0e-5", "coefficients.X.dn^2=50.0e-5")
    assert plant.input_names[:2] == ("cmd_delta", "cmd_n")
    x = plant.make_initial_state(2)
    assert x[:, 7].tolist() == [1.5, 1.5]
    x[1, 7] = 1.8
    w = torch.zeros(2, len(plant.input_names), dtype=torch.float64)
    rate = plant.derivative(x, w)
    share = 0.3 / 1.5
    force = (400e-5 * share + 50e-5 * share**2) * SERVICE**2 / LENGTH / (840e-5)
    assert float(rate[1, 3] - rate[0, 3]) == pytest.approx(force)


NOMOTO = ("nomoto_oceanos", "nomoto_mariner_yaw", "nomoto_mariner")


def commands(steps: int, dt: float) -> np.ndarray:
    """Steps of the rudder [T] within 0.2 rad, each of 2 s."""
    levels = np.random.default_rng(0).uniform(-0.2, 0.2, steps)
    return levels[(np.arange(steps) * dt // 2).astype(int)]


def flown(model: NomotoDynamics | PlantDynamics, rudder: np.ndarray) -> np.ndarray:
    x0 = model.plant.make_initial_state(1)
    return rolled(model, x0, torch.from_numpy(rudder)[None, :, None])[0].numpy()


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


@pytest.mark.parametrize("name", NOMOTO)
@pytest.mark.parametrize("dt", [0.01, 0.5])
def test_steps_of_the_rudder_as_the_transfer_functions_say(name: str, dt: float) -> None:
    plant = plant_of(name, "rudder.rate=null")
    rudder = commands(400, dt)
    states = flown(NomotoDynamics(plant, dt), rudder)
    known = transfer_functions(name)
    for channel, function in known.items():
        # lsim holds inputs over a step and is exact in it
        _, truth, _ = lsim((function.num, function.den), rudder, np.arange(400) * dt, interp=False)
        np.testing.assert_allclose(
            states[:-1, plant.state_names.index(channel)], truth, rtol=0, atol=1e-11 * np.ptp(truth)
        )
    if "v" not in known:
        assert not states[:, 4].any()


@pytest.mark.parametrize("name", NOMOTO)
def test_the_exact_step_is_that_of_rk4(name: str) -> None:
    """Whole states under a rudder with a rate; RK4 and positions by Simpson's rule are of fourth
    order.
    """
    plant = plant_of(name, "rudder.rate=5 deg/s")
    rudder = commands(200, 0.05)
    exact, stepped = (flown(kind(plant, 0.05), rudder) for kind in (NomotoDynamics, PlantDynamics))
    np.testing.assert_array_equal(exact[:, -1], stepped[:, -1])
    assert (np.abs(exact - stepped).max(0) <= 1e-7 * np.ptp(exact, axis=0)).all()


def test_an_unstable_ship_has_both_signs_negative() -> None:
    plant = plant_of("nomoto_oceanos", "K.value=-1", "T.value=-20")
    end = flown(NomotoDynamics(plant, 0.1), np.full(100, 0.1))[-1]
    assert end[5] == pytest.approx(0.1 * (np.exp(10.0 / 20) - 1), rel=1e-12)
