"""Waves against their spectrum and the integral of the pressure on a box; wind by its signs, and
both forms of its coefficients against each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from residnet.core.config import load_config, validate_config
from residnet.core.errors import ConfigError
from residnet.core.registry import find_vessel_files
from residnet.physics.environment import IrregularWaves
from residnet.physics.environment_config import (
    JonswapSpectrumConfig,
    WavesConfig,
    WindLoadConfig,
    WindLoadsConfig,
)
from residnet.physics.hull import FossenConfig
from residnet.physics.parameters import GRAVITY
from residnet.physics.vessel import load_vessel

SEA: dict[str, Any] = {
    "significant_height": 1.2,
    "peak_period": 5.0,
    "direction": "30 deg",
    "hull": {"length": 20.0, "breadth": 5.0, "draught": 1.5},
}


def sea(rows: int = 1, seed: int = 0, **changes: Any) -> IrregularWaves:
    return validate_config(SEA | changes, WavesConfig, "here").build(
        rows, np.random.default_rng(seed)
    )


def elevations(waves: IrregularWaves, t: np.ndarray) -> np.ndarray:
    """[B, T] at the origin."""
    zero = torch.zeros(waves.omega.shape[0], dtype=torch.float64)
    phases = [waves.component_phases(zero, zero, float(time)) for time in t]
    return torch.stack([(waves.amplitude * p.cos()).sum(-1) for p in phases], dim=1).numpy()


def test_forms_of_the_spectrum() -> None:
    """Peak at the peak period; with gamma 1 m0 = H^2/16 and the ITTC's A = 173 H^2/T1^4, B =
    691/T1^4.
    """
    height = 2.0
    period = 7.0
    omega = np.linspace(0.05, 8, 20_000)
    form = JonswapSpectrumConfig(gamma=1.0)
    plain, raised = (
        one.spectral_density(omega, height, period) for one in (form, JonswapSpectrumConfig())
    )
    for density in (plain, raised):
        assert 2 * np.pi / omega[density.argmax()] == pytest.approx(period, rel=2e-3)
    assert raised.max() == pytest.approx(3.3 * plain.max(), rel=2e-3)
    area, _ = quad(
        lambda o: float(form.spectral_density(np.array(o), height, period)), 0.05, 60, limit=500
    )
    assert area == pytest.approx(height**2 / 16, rel=1e-5)
    t1 = 0.7718 * period
    table = 173 * height**2 / t1**4 * omega**-5 * np.exp(-691 / t1**4 * omega**-4)
    np.testing.assert_allclose(plain[omega > 0.5], table[omega > 0.5], rtol=0.02)


@pytest.mark.parametrize(("gamma", "directions"), [(1.0, 1), (3.3, 8)])
def test_the_surface_has_the_spectrums_variance_height_and_peak(
    gamma: float, directions: int
) -> None:
    waves = sea(rows=30, spectrum={"gamma": gamma}, directions=directions)
    energy = 0.5 * waves.amplitude.square().sum(1)
    np.testing.assert_allclose(energy, np.full(30, 1.2**2 / 16), rtol=1e-12)
    t = np.arange(0, 900, 0.5)
    zeta = elevations(waves, t)
    assert 4 * np.sqrt(np.mean(zeta**2)) == pytest.approx(1.2, rel=0.02)
    assert abs(zeta.mean()) < 0.01
    power = np.abs(np.fft.rfft(zeta * np.hanning(t.size), axis=1)) ** 2
    mean = np.convolve(power.mean(0), np.ones(9) / 9, mode="same")
    assert 1 / np.fft.rfftfreq(t.size, 0.5)[mean.argmax()] == pytest.approx(5.0, rel=0.06)
    # a Gaussian sea: kurtosis 3
    assert np.mean(zeta**4) / np.mean(zeta**2) ** 2 == pytest.approx(3.0, abs=0.25)
    # one seed is one sea, and every row another
    t = t[:20]
    np.testing.assert_array_equal(elevations(sea(seed=4), t), elevations(sea(seed=4), t))
    assert np.abs(elevations(sea(seed=4), t) - elevations(sea(seed=5), t)).max() > 0.1
    assert np.abs(zeta[0] - zeta[1]).max() > 0.1


@pytest.mark.parametrize("angle", [0.0, 17.0, 90.0, 143.0, 250.0])
def test_the_response_is_the_pressure_on_the_hull(angle: float) -> None:
    """The undisturbed wave's pressure on walls and bottom of the box, by quadrature over its
    surface; the force is the sum over the components.
    """
    waves = sea(direction=float(np.radians(angle)), frequencies=10)
    psi = torch.zeros(1, dtype=torch.float64)
    quadrature, yaw = waves.force_response(psi)
    length = 20.0
    breadth = 5.0
    draught = 1.5
    rho_g = 1025.0 * GRAVITY
    nodes, weights = np.polynomial.legendre.leggauss(60)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    (xs, wx), (ys, wy), (zs, wz) = (
        (low + 0.5 * span * (nodes + 1), 0.5 * span * weights)
        for span, low in ((length, -length / 2), (breadth, -breadth / 2), (draught, 0.0))
    )
    for i, number in enumerate(waves.wave_number[0].tolist()):
        for theta in (0.3, 2.0):

            def pressure(x: Any, y: Any, z: Any, k: float = number, theta: float = theta) -> Any:
                return rho_g * np.exp(-k * z) * np.cos(theta - k * (x * c + y * s))

            total = np.zeros(4)
            for side in (1, -1):
                y, z = np.meshgrid(ys, zs, indexing="ij")
                f = -side * pressure(side * length / 2, y, z) * np.outer(wy, wz)
                total += [f.sum(), 0, 0, -(y * f).sum()]
                x, z = np.meshgrid(xs, zs, indexing="ij")
                f = -side * pressure(x, side * breadth / 2, z) * np.outer(wx, wz)
                total += [0, f.sum(), -(z * f).sum(), (x * f).sum()]
            x, y = np.meshgrid(xs, ys, indexing="ij")
            lift = -pressure(x, y, draught) * np.outer(wx, wy)
            total += [0, 0, (y * lift).sum(), 0]
            found = [*(quadrature[0, i] * np.sin(theta)).tolist(), float(yaw[0, i] * np.cos(theta))]
            np.testing.assert_allclose(found, total, rtol=1e-9, atol=1e-8 * rho_g)
    phase = waves.component_phases(psi + 3.0, psi - 2.0, 1.5)[0]
    parts = torch.cat((quadrature[0] * phase.sin()[:, None], (yaw[0] * phase.cos())[:, None]), 1)
    wanted = (waves.amplitude[0][:, None] * parts).sum(0)
    torch.testing.assert_close(waves(psi + 3.0, psi - 2.0, psi, 1.5)[0], wanted)


def test_a_moving_vessel_meets_waves_at_the_encounter_frequency() -> None:
    """(5.31): omega_e = omega - omega^2 U cos(chi) / g along a straight course at steady speed."""
    waves = sea(direction=float(np.radians(40)))
    t = 12.0
    speed = 6.0
    course = np.radians(-100)
    north, east = (torch.tensor([speed * t * f(course)]).double() for f in (np.cos, np.sin))
    chi = np.radians(40) - course
    encounter = waves.omega - waves.omega**2 * speed / GRAVITY * np.cos(chi)
    torch.testing.assert_close(waves.component_phases(north, east, t), encounter * t + waves.phase)


AREAS: dict[str, Any] = {
    "frontal_area": 3.0,
    "lateral_area": 6.0,
    "length": 5.0,
    "centre_height": 0.8,
    "source": "made",
}
SYMMETRIC = AREAS | {"kind": "symmetric", "c_x": 0.7, "c_y": 0.8, "c_n": 0.1}
ANGLES = np.linspace(0, np.pi, 181)
SWAY = (-0.8 * np.sin(ANGLES)).round(12)
TABLE = AREAS | {
    "kind": "table",
    "angle": ANGLES.tolist(),
    "C_X": (-0.7 * np.cos(ANGLES)).tolist(),
    "C_Y": SWAY.tolist(),
    "C_N": (-0.1 * np.sin(2 * ANGLES)).round(12).tolist(),
}


def loads(content: dict[str, Any]) -> WindLoadConfig:
    config: WindLoadConfig = validate_config(content, WindLoadsConfig, "here")
    return config


HEAD, SIDE, TURN = (0.5 * 1.225 * 100.0 * size for size in (3 * 0.7, 6 * 0.8, 6 * 5 * 0.1))
HALF = 0.5**0.5


@pytest.mark.parametrize(
    ("degrees", "expected"),
    [
        # pushed and heeled to port; wind on the bow turns the vessel away, on the quarter up
        (0, (-HEAD, 0, 0, 0)),
        (180, (HEAD, 0, 0, 0)),
        (90, (0, -SIDE, -0.8 * SIDE, 0)),
        (-45, (-HALF * HEAD, HALF * SIDE, 0.8 * HALF * SIDE, TURN)),
        (135, (HALF * HEAD, -HALF * SIDE, -0.8 * HALF * SIDE, TURN)),
    ],
)
@pytest.mark.parametrize("content", [SYMMETRIC, TABLE], ids=["symmetric", "table"])
def test_wind_of_10_metres_a_second_from_an_angle_off_the_bow(
    content: dict[str, Any], degrees: float, expected: tuple[float, ...]
) -> None:
    angle = torch.tensor(np.radians(degrees), dtype=torch.float64)
    for speed in (10.0, 20.0):
        found = loads(content).wind_forces(-speed * torch.cos(angle), -speed * torch.sin(angle))
        np.testing.assert_allclose(found, np.array(expected) * (speed / 10) ** 2, atol=1e-9)


def test_a_fine_table_of_the_symmetric_form_is_it_and_calm_air_is_smooth() -> None:
    air = torch.from_numpy(np.random.default_rng(0).normal(size=(2, 300)) * 8)
    # linear between degrees: the error of a chord
    chord = 2e-4 * 0.5 * 1.225 * 600 * 30
    one, other = (loads(content).wind_forces(*air) for content in (TABLE, SYMMETRIC))
    torch.testing.assert_close(one, other, rtol=0, atol=chord)
    for content in (TABLE, SYMMETRIC):
        calm = torch.zeros(2, dtype=torch.float64, requires_grad=True)
        out = loads(content).wind_forces(calm, calm)
        assert float(out.detach().abs().max()) < 1e-5
        (slope,) = torch.autograd.grad(out.sum(), calm)
        assert bool(torch.isfinite(slope).all())


def test_a_plant_feels_the_wind_relative_to_itself() -> None:
    """Running before the wind at its own speed it feels none; heading and wind turn together."""
    section = (
        "wind={kind: symmetric, frontal_area: 3, lateral_area: 6, length: 5, c_x: 0.7, c_y: 0.8,"
        " c_n: 0.1, source: made}"
    )
    plant = load_config(find_vessel_files()["wam_v_cal"], [section], FossenConfig).build()
    assert plant.input_names[-2:] == ("wind_speed", "wind_dir")
    still = load_vessel("wam_v_cal").build()
    assert "wind_speed" not in still.input_names
    x = torch.zeros(1, 8, dtype=torch.float64)
    x[:, 2], x[:, 3] = 0.6, 2.0
    w = torch.zeros(1, len(plant.input_names), dtype=torch.float64)
    w[:, -2], w[:, -1] = 2.0, 0.6 + np.pi
    torch.testing.assert_close(
        plant.derivative(x, w), still.derivative(x, w[:, :-2]), rtol=0, atol=1e-8
    )
    w[:, -1] = 0.6
    force = (plant.derivative(x, w) - still.derivative(x, w[:, :-2]))[0, 3:6] @ plant.hull.mass.T
    np.testing.assert_allclose(force, [-0.16 * HEAD, 0, 0], atol=1e-8)


@pytest.mark.parametrize(
    ("content", "kind", "message"),
    [
        (SEA | {"significant_height": "-1 m"}, WavesConfig, "significant_height"),
        (SEA | {"peak_period": "5 m"}, WavesConfig, "peak_period"),
        (SEA | {"spectrum": {"kind": "jonswop"}}, WavesConfig, "jonswap"),
        (SEA | {"spectrum": {"kind": "jonswap", "gamma": 0.5}}, WavesConfig, "gamma"),
        (SEA | {"hull": {"length": 20.0, "breadth": 5.0}}, WavesConfig, "draught"),
        (SYMMETRIC | {"frontal_area": "3 m"}, WindLoadsConfig, "m\\^2"),
        (TABLE | {"C_Y": (-SWAY).tolist()}, WindLoadsConfig, "C_Y must not be positive"),
        (TABLE | {"C_X": [1.0] * 181}, WindLoadsConfig, "C_X must not be positive"),
        (TABLE | {"C_N": [0.0, 0.0]}, WindLoadsConfig, "2 values for 181"),
        (TABLE | {"C_N": [0.1] * 181}, WindLoadsConfig, "by symmetry"),
        (TABLE | {"angle": [0.0, 1.0, 2.0]}, WindLoadsConfig, "180 deg"),
    ],
)
def test_what_is_wrong_is_one_line(content: dict[str, Any], kind: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate_config(content, kind, "here")
    assert "\n" not in str(caught.value)
