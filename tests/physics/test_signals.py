"""Channels from state and inputs: names, shapes, forces, and the wind seen from the vessel."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError
from residnet.physics.signals import Signals
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel

WIND = ("wind_speed", "wind_dir")


def build(**changes: object) -> Signals:
    return SignalsConfig.model_validate({"inputs": ("n_port", "n_stbd"), **changes}).build()


@pytest.mark.parametrize(
    ("psi", "u", "v", "speed", "direction", "expected"),
    [
        # heading north, at rest, wind FROM north: the air comes from ahead, moving aft
        (0, 0, 0, 10, 0, (-10, 0)),
        # heading east, wind FROM north: from port, moving to starboard
        (90, 0, 0, 10, 0, (0, 10)),
        # following wind of the vessel's own speed: calm on board
        (0, 5, 0, 5, 180, (0, 0)),
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
    x = torch.tensor([[3.0, -4.0, np.radians(psi), u, v, 0.1]], dtype=torch.float64)
    w = torch.tensor([[10.0, 0.2, speed, np.radians(direction)]], dtype=torch.float64)
    for order, columns in ((WIND, w), (WIND[::-1], w[:, [0, 1, 3, 2]])):
        signals = build(exogenous=order)
        z = signals(x, signals.prepare(columns))[0].tolist()
        assert z[:5] == [u, v, 0.1, 10.0, 0.2]
        assert z[5:7] == pytest.approx(expected, abs=6e-5)
        assert z[7] == pytest.approx(np.hypot(*expected), abs=2e-4)


def test_names_and_forces_are_the_vessels() -> None:
    plain = ("u", "v", "r", "n_port", "n_stbd")
    forces = ("tau_x", "tau_y", "tau_n")
    assert build().names == plain
    signals = build(forces="wam_v_cal")
    assert signals.names == (*plain, *forces)
    both = build(forces="wam_v_cal", exogenous=WIND[::-1])
    assert both.names == (*plain, *forces, "wind_u", "wind_v", "wind_mag")
    w = torch.tensor([[20.0, -10.0]], dtype=torch.float64)
    z = signals(torch.zeros(1, 6, dtype=torch.float64), signals.prepare(w))
    assert torch.equal(z[:, 5:], load_vessel("wam_v_cal").actuators.build().thruster_forces(w))


def test_inputs_of_ones_own_have_the_unit_that_their_name_says() -> None:
    units = SignalsConfig(inputs=("cmd_azimuth", "thrust_port", "servo_1")).channel_units()
    assert [*units.values()][-3:] == ["rad", "N", "-"]


def test_wind_keeps_a_gradient_in_a_calm() -> None:
    signals = build(exogenous=WIND)
    x = torch.zeros(1, 6, dtype=torch.float64, requires_grad=True)
    out = signals(x, signals.prepare(torch.zeros(1, 4, dtype=torch.float64)))
    assert bool(torch.isfinite(torch.autograd.grad(out.sum(), x)[0]).all())


@pytest.mark.parametrize("exogenous", [(), WIND])
@pytest.mark.parametrize("shape", [(4,), (3, 5), (2, 0)])
def test_batched_shapes_equal_sample_by_sample(
    exogenous: tuple[str, ...], shape: tuple[int, ...]
) -> None:
    signals = build(exogenous=exogenous, forces="wam_v_cal")
    x = torch.randn(*shape, 6, dtype=torch.float64)
    w = torch.randn(*shape, 2 + len(exogenous), dtype=torch.float64) * 20
    z = signals(x, signals.prepare(w))
    assert z.shape == (*shape, signals.n_channels)
    pairs = zip(x.reshape(-1, 6), w.reshape(-1, w.shape[-1]), strict=True)
    rows = [signals(a[None], signals.prepare(b[None])) for a, b in pairs]
    found = z.reshape(-1, signals.n_channels)
    torch.testing.assert_close(found, torch.cat(rows or [found]), rtol=1e-13, atol=1e-13)


def test_a_resolved_config_needs_no_vessel_file() -> None:
    config = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal")
    resolved = config.with_thrusters()
    assert resolved.forces == load_vessel("wam_v_cal").actuators
    assert resolved.with_thrusters() is resolved
    again = SignalsConfig.model_validate(resolved.model_dump())
    assert again.build().names == config.build().names


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"exogenous": ["wind_sped", "wind_dir"]}, "did you mean 'wind_speed'"),
        ({"exogenous": ["wind_speed"]}, "expected both wind_speed and wind_dir"),
        ({"inputs": ["n", "n"]}, r"\['n'\] are named twice"),
        ({"inputs": ["n", "delta", "m"], "forces": "wam_v_cal"}, "inputs of two thrusters"),
        ({"inputs": ["n", "u"]}, "input 'u' is a state or a computed"),
        (
            {"inputs": ["tau_x", "tau_n"], "forces": "wam_v_cal"},
            "input 'tau_x' is a state or a computed",
        ),
        ({"forces": "wam_v_kal"}, "did you mean 'wam_v_cal'"),
    ],
)
def test_wrong_combinations(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        validate_config({"inputs": ["n_port", "n_stbd"], **changes}, SignalsConfig, "here")
    assert "\n" not in str(caught.value)
