"""Channels from state and inputs: names, shapes, forces, and the wind seen from the vessel."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from residnet.core.config import validate
from residnet.core.errors import ConfigError
from residnet.physics.signals import Signals, SignalsConfig
from residnet.physics.vessel import load_vessel


def wind(psi_deg: float, u: float, v: float, speed: float, direction_deg: float) -> list[float]:
    """(wind_u, wind_v, wind_mag) of one sample."""
    signals = SignalsConfig(inputs=("n", "delta"), exogenous=("wind_speed", "wind_dir")).build()
    x = torch.tensor([[3.0, -4.0, np.radians(psi_deg), u, v, 0.1]], dtype=torch.float64)
    w = torch.tensor([[10.0, 0.2, speed, np.radians(direction_deg)]], dtype=torch.float64)
    z = signals(x, signals.prepare(w))
    assert signals.names == ("u", "v", "r", "n", "delta", "wind_u", "wind_v", "wind_mag")
    assert z[0, :5].tolist() == [u, v, 0.1, 10.0, 0.2]
    return z[0, 5:].tolist()


@pytest.mark.parametrize(
    ("psi", "u", "v", "speed", "direction", "expected"),
    [
        # heading north, at rest, wind FROM north: the air comes from ahead, moving aft
        (0, 0, 0, 10, 0, (-10, 0)),
        # wind FROM east on a vessel heading north: from starboard, moving to port
        (0, 0, 0, 10, 90, (0, -10)),
        # heading east, wind FROM east: from ahead
        (90, 0, 0, 10, 90, (-10, 0)),
        # heading east, wind FROM north: from port, moving to starboard
        (90, 0, 0, 10, 0, (0, 10)),
        # following wind of the vessel's own speed: calm on board
        (0, 5, 0, 5, 180, (0, 0)),
        # ahead into the wind: the sum
        (0, 5, 0, 10, 0, (-15, 0)),
        # drifting to starboard in a calm: air from starboard
        (30, 0, 1, 0, 77, (0, -1)),
        # by hand: air moves to 45 deg + 180 deg, (-7.0711, -7.0711) in NED; heading 30 deg:
        # (-9.6593, -2.5882); less (2, 0.5)
        (30, 2, 0.5, 10, 45, (-11.6593, -3.0882)),
    ],
)
def test_relative_wind(
    psi: float, u: float, v: float, speed: float, direction: float, expected: tuple[float, float]
) -> None:
    along, across, magnitude = wind(psi, u, v, speed, direction)
    assert (along, across) == pytest.approx(expected, abs=6e-5)
    assert magnitude == pytest.approx(np.hypot(*expected), abs=2e-4)


def test_wind_keeps_a_gradient_in_a_calm() -> None:
    signals = SignalsConfig(inputs=("n",), exogenous=("wind_speed", "wind_dir")).build()
    x = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    signals(x, signals.prepare(torch.zeros(1, 3, dtype=torch.float64))).sum().backward()
    assert x.grad is not None
    assert bool(torch.isfinite(x.grad).all())


def build(**changes: object) -> Signals:
    return SignalsConfig.model_validate({"inputs": ("n_port", "n_stbd"), **changes}).build()


def test_names() -> None:
    plain, forces = ("u", "v", "r", "n_port", "n_stbd"), ("tau_x", "tau_y", "tau_n")
    assert build().names == plain
    assert build(forces="wam_v_cal").names == (*plain, *forces)
    both = build(forces="wam_v_cal", exogenous=("wind_dir", "wind_speed"))
    assert both.names == (*plain, *forces, "wind_u", "wind_v", "wind_mag")


def test_order_of_the_wind_columns_is_the_config_s() -> None:
    one, two = (
        build(exogenous=("wind_speed", "wind_dir")),
        build(exogenous=("wind_dir", "wind_speed")),
    )
    x = torch.randn(5, 6, dtype=torch.float64)
    w = torch.randn(5, 4, dtype=torch.float64)
    torch.testing.assert_close(one(x, one.prepare(w)), two(x, two.prepare(w[:, [0, 1, 3, 2]])))


def test_forces_are_the_vessel_s() -> None:
    signals = build(forces="wam_v_cal")
    w = torch.tensor([[20.0, -10.0]], dtype=torch.float64)
    tau = load_vessel("wam_v_cal").actuators.build().forces(w)
    z = signals(torch.zeros(1, 6, dtype=torch.float64), signals.prepare(w))
    assert torch.equal(z[:, 5:], tau)


@pytest.mark.parametrize("exogenous", [(), ("wind_speed", "wind_dir")])
@pytest.mark.parametrize("forces", [None, "wam_v_cal"])
@pytest.mark.parametrize("shape", [(4,), (3, 5), (0,), (2, 0)])
def test_batched_shapes_equal_sample_by_sample(
    exogenous: tuple[str, ...], forces: str | None, shape: tuple[int, ...]
) -> None:
    signals = build(exogenous=exogenous, forces=forces)
    x, w = (
        torch.randn(*shape, 6, dtype=torch.float64),
        torch.randn(*shape, 2 + len(exogenous), dtype=torch.float64) * 20,
    )
    z = signals(x, signals.prepare(w))
    assert z.shape == (*shape, signals.count)
    rows = [
        signals(a[None], signals.prepare(b[None]))
        for a, b in zip(x.reshape(-1, 6), w.reshape(-1, w.shape[-1]), strict=True)
    ]
    if rows:
        torch.testing.assert_close(
            z.reshape(-1, signals.count), torch.cat(rows), rtol=1e-13, atol=1e-13
        )


def test_wind_turns_with_the_vessel() -> None:
    """Heading and wind direction turned together, and another position: the same relative wind."""
    signals = build(exogenous=("wind_speed", "wind_dir"))
    x, w = torch.randn(6, 6, dtype=torch.float64), torch.rand(6, 4, dtype=torch.float64) * 5
    turned, veered = x.clone(), w.clone()
    turned[:, :3] += torch.tensor([100.0, -50.0, 1.234], dtype=torch.float64)
    veered[:, 3] += 1.234
    torch.testing.assert_close(
        signals(x, signals.prepare(w)),
        signals(turned, signals.prepare(veered)),
        rtol=1e-9,
        atol=1e-12,
    )


def test_a_resolved_config_needs_no_vessel_file() -> None:
    config = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal")
    resolved = config.resolved()
    assert resolved.forces == load_vessel("wam_v_cal").actuators
    assert resolved.resolved() is resolved
    again = SignalsConfig.model_validate(resolved.model_dump())
    assert again.build().names == config.build().names


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exogenous": ["wind_sped", "wind_dir"]}, "did you mean 'wind_speed'"),
        ({"exogenous": ["wind_speed"]}, "needs both wind_speed and wind_dir"),
        ({"inputs": ["n", "n"]}, r"\['n'\] are named twice"),
        ({"inputs": ["n", "delta", "m"], "forces": "wam_v_cal"}, "made by two thrusters"),
        ({"inputs": ["n", "u"]}, "input 'u' is a channel that the model has"),
        (
            {"inputs": ["tau_x", "tau_n"], "forces": "wam_v_cal"},
            "input 'tau_x' is a channel that the model has",
        ),
        ({"forces": "wam_v_kal"}, "did you mean 'wam_v_cal'"),
    ],
)
def test_wrong_combinations(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate({"inputs": ["n_port", "n_stbd"], **changes}, SignalsConfig, "here")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("exogenous", [(), ("wind_speed", "wind_dir")])
@pytest.mark.parametrize("forces", [None, "wam_v_cal"])
def test_slopes_are_the_derivatives_by_heading_and_velocities(
    exogenous: tuple[str, ...], forces: str | None
) -> None:
    inputs = ("n_port", "n_stbd")
    signals = SignalsConfig(inputs=inputs, exogenous=exogenous, forces=forces).build().double()
    torch.manual_seed(4)
    x = torch.randn(5, 6, dtype=torch.float64)
    p = signals.prepare(torch.randn(5, len(inputs + exogenous), dtype=torch.float64))
    found = signals.slopes(x, p)
    assert found.shape == (4, 5, signals.count)
    for row, column in enumerate((2, 3, 4, 5)):
        step = torch.zeros(6, dtype=torch.float64)
        step[column] = 1e-6
        about = (signals(x + step, p) - signals(x - step, p)) / 2e-6
        torch.testing.assert_close(found[row], about, rtol=1e-6, atol=1e-7)
