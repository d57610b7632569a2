"""A seaway against its own spectrum, and the force on a box against the integral of the pressure
over its surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import quad

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.physics.environment import (
    GRAVITY,
    JonswapSpectrum,
    Waves,
    WavesConfig,
)

SEA: dict[str, Any] = {
    "significant_height": 1.2,
    "peak_period": 5.0,
    "direction": "30 deg",
    "hull": {"length": 20.0, "breadth": 5.0, "draught": 1.5},
}


def sea(rows: int = 1, seed: int = 0, **changes: Any) -> Waves:
    return validate(SEA | changes, WavesConfig, "here").build(rows, np.random.default_rng(seed))


def elevations(waves: Waves, t: np.ndarray) -> np.ndarray:
    """[B, T] at the origin."""
    with torch.no_grad():
        zero = torch.zeros(waves.omega.shape[0], dtype=torch.float64)
        phases = [waves.phases(zero, zero, float(time)) for time in t]
        return torch.stack([(waves.amplitude * p.cos()).sum(-1) for p in phases], dim=1).numpy()


def test_forms_of_the_spectrum() -> None:
    """Peak at the peak period; with gamma 1 m0 = H^2/16 and the ITTC's A = 173 H^2/T1^4, B =
    691/T1^4.
    """
    height, period = 2.0, 7.0
    omega = np.linspace(0.05, 8, 20_000)
    plain, raised = (
        JonswapSpectrum(gamma=gamma).density(omega, height, period) for gamma in (1.0, 3.3)
    )
    for density in (plain, raised):
        assert 2 * np.pi / omega[density.argmax()] == pytest.approx(period, rel=2e-3)
    assert raised.max() == pytest.approx(3.3 * plain.max(), rel=2e-3)
    area, _ = quad(
        lambda o: float(JonswapSpectrum(gamma=1.0).density(np.array(o), height, period)),
        0.05, 60, limit=500,
    )  # fmt: skip
    assert area == pytest.approx(height**2 / 16, rel=1e-5)
    t1 = 0.7718 * period
    table = 173 * height**2 / t1**4 * omega**-5 * np.exp(-691 / t1**4 * omega**-4)
    np.testing.assert_allclose(plain[omega > 0.5], table[omega > 0.5], rtol=0.02)


@pytest.mark.parametrize("gamma", [1.0, 3.3])
@pytest.mark.parametrize("directions", [1, 8])
def test_the_surface_has_the_spectrums_variance_height_and_peak(
    gamma: float, directions: int
) -> None:
    waves = sea(rows=30, spectrum={"gamma": gamma}, directions=directions)
    np.testing.assert_allclose(
        0.5 * waves.amplitude.square().sum(1), np.full(30, 1.2**2 / 16), rtol=1e-12
    )
    t = np.arange(0, 900, 0.5)
    zeta = elevations(waves, t)
    assert 4 * np.sqrt(np.mean(zeta**2)) == pytest.approx(1.2, rel=0.02)
    assert abs(zeta.mean()) < 0.01
    power = np.abs(np.fft.rfft(zeta * np.hanning(t.size), axis=1)) ** 2
    mean = np.convolve(power.mean(0), np.ones(9) / 9, mode="same")
    assert 1 / np.fft.rfftfreq(t.size, 0.5)[mean.argmax()] == pytest.approx(5.0, rel=0.06)
    # a Gaussian sea: kurtosis 3
    assert np.mean(zeta**4) / np.mean(zeta**2) ** 2 == pytest.approx(3.0, abs=0.25)


def test_the_force_has_the_variance_that_spectrum_and_response_give() -> None:
    """sigma^2 = integral of |H|^2 S; the sums of (5.33) against an integral on a fine grid."""
    waves = sea(rows=200, frequencies=80)
    psi = torch.full((200,), 0.9, dtype=torch.float64)
    zero = torch.zeros_like(psi)
    with torch.no_grad():
        force = torch.stack([waves(zero, zero, psi, 3.7 * k) for k in range(100)]).numpy()
    fine = sea(frequencies=2000)
    quadrature, yaw = fine.response(psi[:1])
    response = torch.cat((quadrature, yaw.unsqueeze(-1)), dim=-1)[0]
    variance = (0.5 * fine.amplitude[0].square().unsqueeze(-1) * response.square()).sum(0).numpy()
    np.testing.assert_allclose(force.var(axis=(0, 1)), variance, rtol=0.06)
    assert variance.min() > 0


@pytest.mark.parametrize("angle", [0.0, 17.0, 90.0, 143.0, 180.0, 250.0])
def test_the_response_is_the_pressure_on_the_hull(angle: float) -> None:
    """The undisturbed wave's pressure on walls and bottom of the box, by quadrature over its
    surface.
    """
    waves = sea(direction=float(np.radians(angle)), frequencies=10)
    psi = torch.zeros(1, dtype=torch.float64)
    quadrature, yaw = waves.response(psi)
    length, breadth, draught = 20.0, 5.0, 1.5
    rho_g = 1025.0 * GRAVITY
    nodes, weights = np.polynomial.legendre.leggauss(60)
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))

    def on(span: float, low: float) -> tuple[np.ndarray, np.ndarray]:
        return low + 0.5 * span * (nodes + 1), 0.5 * span * weights

    for i, number in enumerate(waves.number[0].tolist()):
        for theta in (0.3, 2.0):

            def pressure(x: Any, y: Any, z: Any, k: float = number, theta: float = theta) -> Any:
                return rho_g * np.exp(-k * z) * np.cos(theta - k * (x * c + y * s))

            (xs, wx), (ys, wy), (zs, wz) = (
                on(length, -length / 2),
                on(breadth, -breadth / 2),
                on(draught, 0.0),
            )
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


def test_symmetry_of_the_force() -> None:
    """Head and following seas push along only; waves from port mirror those from starboard."""
    for angle in (0.0, 180.0):
        waves = sea(direction=float(np.radians(angle)))
        force = waves(*torch.zeros(3, 1, dtype=torch.float64), 2.0)[0]
        assert abs(float(force[0])) > 1
        np.testing.assert_allclose(force[1:], np.zeros(3), atol=1e-9)
    zero = torch.zeros(1, dtype=torch.float64)
    one, other = (sea(direction=sign * 0.7)(zero, zero, zero, 4.0)[0] for sign in (1, -1))
    np.testing.assert_allclose(one * torch.tensor([1.0, -1.0, -1.0, -1.0]), other, rtol=1e-9)


def test_long_waves_push_down_their_slope() -> None:
    """Buoyancy on a tilted surface: minus displacement times slope, no moment about midships."""
    waves = sea(peak_period=60.0, frequencies=10, direction=0.0)
    quadrature, _ = waves.response(torch.zeros(1, dtype=torch.float64))
    slope = waves.number[0]
    displacement = 1025.0 * GRAVITY * 20 * 5 * 1.5
    np.testing.assert_allclose(quadrature[0, :, 0], -displacement * slope, rtol=0.05)


def test_a_moving_vessel_meets_waves_at_the_encounter_frequency() -> None:
    """(5.31): omega_e = omega - omega^2 U cos(chi) / g along a straight course at steady speed."""
    waves = sea(direction=float(np.radians(40)))
    speed, course = 6.0, np.radians(-100)
    t = 12.0
    north, east = (
        torch.tensor([speed * t * f(course)], dtype=torch.float64) for f in (np.cos, np.sin)
    )
    phase = waves.phases(north, east, t)
    chi = np.radians(40) - course
    encounter = waves.omega - waves.omega**2 * speed / GRAVITY * np.cos(chi)
    torch.testing.assert_close(phase, encounter * t + waves.phase)


def test_one_seed_one_sea() -> None:
    t = np.arange(0, 20, 1.0)
    np.testing.assert_array_equal(
        elevations(sea(rows=3, seed=4), t), elevations(sea(rows=3, seed=4), t)
    )
    assert (
        np.abs(elevations(sea(rows=3, seed=4), t) - elevations(sea(rows=3, seed=5), t)).max() > 0.1
    )
    rows = elevations(sea(rows=2, seed=4), t)
    assert np.abs(rows[0] - rows[1]).max() > 0.1


def test_gradients() -> None:
    waves = sea(frequencies=10, directions=3)
    place = [
        torch.tensor([value], dtype=torch.float64, requires_grad=True) for value in (3.0, -2.0, 0.4)
    ]
    assert torch.autograd.gradcheck(lambda n, e, p: waves(n, e, p, 1.5) / 1e3, place, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"significant_height": "-1 m"}, "significant_height"),
        ({"peak_period": "5 m"}, "peak_period"),
        ({"spectrum": {"kind": "jonswop"}}, "jonswap"),
        ({"spectrum": {"kind": "jonswap", "gamma": 0.5}}, "gamma"),
        ({"hull": {"length": 20.0, "breadth": 5.0}}, "draught"),
    ],
)
def test_wrong_seas_are_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate(SEA | change, WavesConfig, "here")
    assert "\n" not in str(caught.value)
