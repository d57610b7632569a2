"""Abkowitz vessels: the Mariner's equations written out, units of both systems, gradients, and
wrong files.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from residnet.core.config import load_config
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.physics.abkowitz import AbkowitzConfig
from residnet.physics.vessel import load_vessel, vessel_files

MARINER = vessel_files()["mariner"]
LENGTH, SERVICE = 160.93, 7.7175


def mariner(u: float, v: float, r: float, delta: float) -> np.ndarray:
    """Accelerations by the published derivatives (times 1e-5); delta positive to port, as there."""
    speed = np.hypot(u, v)
    e, v, r = (u - SERVICE) / speed, v / speed, r * LENGTH / speed
    d = delta
    x = (
        -184 * e
        - 110 * e**2
        - 215 * e**3
        - 899 * v**2
        + 18 * r**2
        + 798 * r * v
        - 95 * d**2
        - 190 * e * d**2
        + 93 * v * d
        + 93 * e * v * d
    )
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
        w = torch.zeros(1, len(plant.inputs), dtype=torch.float64)
        w[0, 0] = delta
        u, v, r = nu
        np.testing.assert_allclose(
            plant.rate(x, w)[0, 3:6], mariner(u, v, r, -delta), rtol=1e-10, atol=1e-14
        )


def test_a_turn_of_the_mariner() -> None:
    """35 deg to starboard from 15 kn, against SciPy on the equations written out; advance and
    tactical diameter of a few lengths.
    """
    plant = load_vessel("mariner").build()
    steps, dt = 1400, 0.5
    w = torch.zeros(1, steps, len(plant.inputs), dtype=torch.float64)
    w[:, :, 0] = np.radians(35)
    x0 = plant.approach(1)
    assert float(x0[0, 3]) == SERVICE
    with torch.no_grad():
        states, _, _ = Rollout(PlantDynamics(plant, dt, substeps=5))(x0, w, x0[:, :0])

    def rate(_: float, s: np.ndarray) -> np.ndarray:
        c, i = np.cos(s[2]), np.sin(s[2])
        gear = np.clip(np.radians(35) - s[6], -np.radians(5), np.radians(5))
        u, v, r, delta = s[3:7]
        return np.array([c * u - i * v, i * u + c * v, r, *mariner(u, v, r, -delta), gear])

    truth = solve_ivp(rate, (0, steps * dt), x0[0].numpy(), rtol=1e-9, atol=1e-10, max_step=1.0).y[
        :, -1
    ]
    assert (
        np.abs(states[0, -1, :6].numpy() - truth[:6]) < [0.5, 0.5, 2e-3, 1e-4, 1e-4, 1e-6]
    ).all()
    track = states[0]
    quarter = track[torch.nonzero(track[:, 2] > np.pi / 2)[0, 0]]
    half = track[torch.nonzero(track[:, 2] > np.pi)[0, 0]]
    assert 2.5 < float(quarter[0]) / LENGTH < 5.0
    assert 4.0 < float(half[1]) / LENGTH < 7.0


def test_prime_and_si_are_the_same_vessel() -> None:
    """At the service speed, where the present speed does not scale the series."""
    prime = load_vessel("mariner")
    assert isinstance(prime, AbkowitzConfig)
    force, length, speed = 0.5 * 1025 * LENGTH**2 * SERVICE**2, LENGTH, SERVICE
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
    kilo, body = 0.5 * 1025 * length**3, prime.mass
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
    w = torch.zeros(1, len(a.inputs), dtype=torch.float64)
    w[0, 1:4] = torch.tensor([2e5, -1e5, 3e7])
    torch.testing.assert_close(a.rate(x, w), b.rate(x, w), rtol=1e-9, atol=1e-12)


def test_coriolis_of_the_rigid_body_may_stand_outside_the_series() -> None:
    """Taking m out of X_vr and Y_r, and m x_G out of N_r and X_rr, and adding C_RB gives the same
    (at the service speed).
    """
    inside = load_vessel("mariner")
    m, x_g = 798e-5, -0.023
    changes = {
        "coefficients.X.v r": 798e-5 - m,
        "coefficients.X.r^2": 18e-5 - m * x_g,
        "coefficients.Y.r": -499e-5 + m,
    }
    changes |= {
        "coefficients.Y.du r": -499e-5 + m,
        "coefficients.N.r": -166e-5 + m * x_g,
        "coefficients.N.du r": -166e-5 + m * x_g,
    }
    outside = load_config(
        MARINER,
        ["coriolis=rigid_body", *(f"{key}={value}" for key, value in changes.items())],
        AbkowitzConfig,
    )
    a, b = inside.build(), outside.build()
    # at the service speed: the series counts 1 + (U - U0) / U where the body has u / U
    x = torch.tensor(
        [[0.0, 0.0, 0.3, np.sqrt(SERVICE**2 - 0.25), 0.5, 0.008, -0.2]], dtype=torch.float64
    )
    w = torch.zeros(1, len(a.inputs), dtype=torch.float64)
    torch.testing.assert_close(a.rate(x, w), b.rate(x, w), rtol=1e-9, atol=1e-14)


def test_gradients_and_rest() -> None:
    plant = load_vessel("mariner").build()
    x = torch.tensor(
        [[1.0, -2.0, 0.7, 7.2, -0.3, 0.01, 0.2], [0.0, 0.0, 0.1, 6.0, 0.4, -0.005, -0.1]],
        dtype=torch.float64,
    )
    w = torch.zeros(2, len(plant.inputs), dtype=torch.float64)
    w[:, 0] = torch.tensor([0.21, -0.12])
    assert torch.autograd.gradcheck(plant.rate, (x.requires_grad_(), w.requires_grad_()))
    rest = torch.zeros(1, 7, dtype=torch.float64)
    assert bool(torch.isfinite(plant.rate(rest, w[:1].detach())).all())


def test_revolutions_enter_where_the_series_knows_them() -> None:
    shaft = "shaft={n_0: 1.5, n_max: 2, n_rate: 0.1}"
    vessel = load_config(
        MARINER,
        [shaft, "coefficients.X.dn=400.0e-5", "coefficients.X.dn^2=50.0e-5"],
        AbkowitzConfig,
    )
    plant = vessel.build()
    assert plant.inputs[:2] == ("cmd_delta", "cmd_n")
    x = plant.approach(2)
    assert x[:, 7].tolist() == [1.5, 1.5]
    x[1, 7] = 1.8
    w = torch.zeros(2, len(plant.inputs), dtype=torch.float64)
    rate = plant.rate(x, w)
    share = 0.3 / 1.5
    force = (400e-5 * share + 50e-5 * share**2) * SERVICE**2 / LENGTH / (840e-5)
    assert float(rate[1, 3] - rate[0, 3]) == pytest.approx(force)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("coefficients.Y.w=1", "no channel 'w'"),
        ("coefficients.Y.u=1", "no channel 'u'"),
        ("coefficients.Y.v^-1=1", "divides"),
        ("coefficients.X.dn=1", "belong together"),
        ("delta_sign=1", "check delta_sign"),
        ("delta_sign=0", "delta_sign"),
        ("mass.m=-798e-5", "greater than 0"),
        ("units=imperial", "prime"),
        ("speed=15 m", r"m/s"),
        ("length.value=-3", "positive"),
        ("rudder.limit=5 deg/s", "rad"),
    ],
)
def test_wrong_files_are_one_line(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(MARINER, [override], AbkowitzConfig)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["mass.X_udot=900.0e-5"], "mariner: the mass matrix is not positive definite"),
        (
            ["mass.x_G=0.0", "mass.Y_rdot=-358.21502e-5", "mass.N_vdot=-358.21502e-5"],
            "mariner: the mass matrix is (singular|not positive definite)",
        ),
    ],
)
def test_impossible_masses_are_one_line(overrides: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        load_config(MARINER, overrides, AbkowitzConfig).build()
    assert "\n" not in str(caught.value)
