"""Flying: where logs end, what they say, what surrounds the craft."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.core.errors import DataError
from residnet.data.sea import Disturbance, SensorNoise, WindField
from residnet.data.simulated import Craft, Sea, fly, log_names
from residnet.dynamics.base import Dynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import TurningCircle, Zigzag
from residnet.manoeuvres.open_loop import ConstantInput
from residnet.physics.environment import Box, JonswapSpectrum, WavesConfig
from residnet.physics.vessel import load_vessel

STEP = 0.1
STILL = SensorNoise(u=0, v=0, r=0)


def ship(vessel: str, disturbance: Disturbance) -> tuple[Craft, Sea]:
    plant = load_vessel(vessel).build()
    craft = Craft(
        vessel,
        PlantDynamics(plant, STEP, 1),
        Helm.from_plant(plant),
        plant.commands,
        plant.approach(1),
    )
    return craft, Sea(plant, disturbance, STILL, 0)


class Runaway(Dynamics):
    """u grows by its square: infinite in finite time; the wind speed is added to v."""

    def __init__(self, dt: float) -> None:
        super().__init__(dt, "euler")

    def rate(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        return torch.zeros_like(x)

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        out = x.clone()
        out[:, 3] = x[:, 3] ** 2 + w[:, 0]
        out[:, 4] = w[:, 1]
        return out, s


def runaway() -> Craft:
    helm = Helm(
        lambda drive, steer: drive.unsqueeze(-1),
        ("x", "y", "psi", "u", "v", "r"),
        ("cmd_n", "wind_speed", "wind_dir"),
    )
    return Craft("runaway", Runaway(STEP), helm, 1, torch.zeros(1, 6, dtype=torch.float64))


def test_logs_end_where_the_manoeuvre_does() -> None:
    craft, sea = ship("wam_v_cal", Disturbance())
    manoeuvres: list[Manoeuvre] = [
        TurningCircle(drive=0.6, steer=0.6, start=3, until=math.pi / 2),
        ConstantInput(drive=0.5, steer=0.1, duration=7),
        TurningCircle(drive=0.6, steer=0.6, start=3, until=math.pi / 2, duration=4),
        ConstantInput(drive=0.5, steer=0.1, name="last"),
    ]
    flights = fly(craft, manoeuvres, sea, 20, STEP, {"vessel": "wam_v_cal"})
    assert [f.log.name for f in flights] == [
        "turning_circle_01",
        "constant_01",
        "turning_circle_02",
        "last",
    ]
    psi = flights[0].motion["psi"]
    assert psi[-1] >= math.pi / 2 > psi[-2]
    assert [len(f.log) for f in flights[1:]] == [70, 40, 200]
    assert [f.fault is None for f in flights] == [True, True, False, True]
    assert flights[2].fault == "timed out after 3.9 s before a heading change of 90 deg"
    assert flights[2].log.meta["timed_out"] is True
    assert flights[1].log.meta["demand"]["steer"] == 0.1
    np.testing.assert_array_equal(flights[1].motion["u"], flights[3].motion["u"][:70])


def test_a_motion_that_is_not_finite_ends_there() -> None:
    # u: 0, 0.9, 1.71, 3.82, 15.5, ...: beyond the largest number after 13 steps or so
    manoeuvres = [ConstantInput(drive=0.9, steer=0), ConstantInput(drive=0.1, steer=0)]
    wild, tame = fly(runaway(), manoeuvres, Sea(None, Disturbance(), STILL, 0), 5, STEP)
    assert wild.log.meta["diverged"] is True
    assert np.isfinite(wild.motion["u"]).all()
    assert 5 < len(wild.motion) < 20
    assert "no longer finite" in str(wild.fault)
    assert len(tame.motion) == 50
    assert tame.fault is None
    start = torch.full((1, 6), math.nan, dtype=torch.float64)
    with pytest.raises(
        DataError, match="constant_01: the motion is not finite from its first step"
    ):
        fly(
            Craft("bad", Runaway(STEP), runaway().helm, 1, start),
            manoeuvres,
            Sea(None, Disturbance(), STILL, 0),
            5,
            STEP,
        )


def test_wind_reaches_a_model_without_a_vessel_and_its_log() -> None:
    wind = Disturbance(wind=WindField(speed=4.0, direction=1.0))
    (flight,) = fly(
        runaway(), [ConstantInput(drive=0.1, steer=0)], Sea(None, wind, STILL, 0), 5, STEP
    )
    assert (flight.motion["v"][1:] == 4.0).all()
    assert (flight.log["wind_speed"] == 4.0).all()
    assert (flight.log["wind_dir"] == 1.0).all()


def test_a_manoeuvre_stops_in_waves_too() -> None:
    box = Box(length=5.5, breadth=1.8, draught=0.4)
    waves = WavesConfig(
        spectrum=JonswapSpectrum(), significant_height=0.2, peak_period=3.0, direction=0.5, hull=box
    )
    for vessel, disturbance in (
        ("wam_v_cal", Disturbance()),
        ("wam_v_cal", Disturbance(waves=waves)),
    ):
        craft, sea = ship(vessel, disturbance)
        (flight,) = fly(
            craft, [Zigzag(drive=0.6, steer=0.5, heading=0.3, start=5, reversals=2)], sea, 40, STEP
        )
        assert flight.fault is None
        assert len(flight.motion) < 350
    assert np.abs(flight.motion["v"][:50]).max() > 0, "the waves push before the first order"


def test_names_are_numbered_by_kind() -> None:
    made = [
        ConstantInput(drive=0, steer=0),
        Zigzag(drive=0, steer=0, heading=1),
        ConstantInput(drive=0, steer=0, name="x"),
    ]
    assert log_names([*made, ConstantInput(drive=0, steer=0)]) == [
        "constant_01",
        "zigzag_01",
        "x",
        "constant_03",
    ]
