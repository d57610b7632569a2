"""Actuators in front of a learned model: the plant's own, given ones, and closed-loop manoeuvres
that the model has not seen.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.baselines.given import StillConfig
from residnet.core.config import validate
from residnet.core.errors import ConfigError, ExportError
from residnet.data.align import GridConfig
from residnet.data.prepare import PrepareConfig, prepare, samples
from residnet.data.simulated import (
    Craft,
    Disturbance,
    Flight,
    Sea,
    SensorNoise,
    SimulatedTrials,
    fly,
    simulate,
)
from residnet.dynamics import lowering
from residnet.dynamics.actuated import ActuatedDynamics, GivenActuators, InputShare, PlantActuators
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics, RecordedPlantDynamics
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.heads.linear import RidgeConfig
from residnet.manoeuvres.base import Helm, Manoeuvre
from residnet.manoeuvres.closed_loop import Zigzag
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
TERMS = (
    "u", "v", "r", "tau_x", "tau_n", "u^2", "u|u|", "v|v|", "r|r|", "u v", "u r", "v r", "|u|v",
    "u^3", "r^3",
)  # fmt: skip


def still(columns: tuple[str, ...], dt: float = 0.1) -> HybridDynamics:
    signals = SignalsConfig(inputs=columns).build()
    return HybridDynamics(signals, StillConfig().build(signals.names), ZeroHead(), dt)


@pytest.mark.parametrize(
    "vessel", ["wam_v_cal", "example_rudder_boat", "mariner", "patrol_p06", "nomoto_mariner"]
)
def test_the_gear_is_the_plants_whatever_its_kind(vessel: str) -> None:
    """Actuator states equal those of the plant that is given the same commands."""
    plant = load_vessel(vessel).build()
    step, substeps = 0.1, 2
    gear = PlantActuators(plant, step, substeps)
    random = np.random.default_rng(0)
    demands = torch.from_numpy(random.uniform(-1, 1, (2, 2, 12))).repeat_interleave(5, dim=-1)
    commands = gear.demand(demands[0], demands[1])
    w = torch.zeros(2, 60, len(plant.inputs), dtype=torch.float64)
    w[:, :, : plant.commands] = commands
    start = plant.approach(2)
    with torch.no_grad():
        truth, _, _ = Rollout(PlantDynamics(plant, step, substeps))(start, w, start[:, :0])
        model = ActuatedDynamics(still(gear.inputs[:1], step), gear.inputs[:1], "start", gear)
        mine, _, _ = Rollout(model)(model.approach(2), w, start[:, :0])
    assert len(gear.state) == len(plant.state) - len(
        [n for n in plant.state if n in ("x", "y", "phi", "psi", "u", "v", "p", "r")]
    )
    for name in gear.state:
        if name != "_yaw_lag":
            torch.testing.assert_close(
                mine[:, :, model.state.index(name)],
                truth[:, :, plant.state.index(name)],
                rtol=1e-9,
                atol=1e-9,
            )
    assert float((truth[:, -1, 0] - truth[:, 0, 0]).abs().max()) > 0.01


def test_given_gear_by_hand() -> None:
    """The rudder moves by 5 deg/s at most, the revolutions jump; a missing input is one line."""
    shares = {
        "n": InputShare(drive="600 rpm", limit="480 rpm"),
        "delta": InputShare(steer="35 deg", rate="5 deg/s"),
    }
    gear = GivenActuators(shares, ("wind_speed", "wind_dir"), 0.5)
    assert gear.inputs == ("cmd_n", "cmd_delta", "wind_speed", "wind_dir")
    assert gear.state == ("delta",)
    command = gear.demand(torch.tensor([1.0, 0.5]), torch.tensor([-1.0, 2.0]))
    torch.testing.assert_close(command, torch.tensor([[8.0, -35 * DEG], [5.0, 35 * DEG]]))
    a = gear.approach(1, ())
    w = torch.tensor([[8.0, 4 * DEG, 0.0, 0.0]], dtype=torch.float64)
    path = [a := gear.move(a, w) for _ in range(3)]
    assert [float(p) / DEG for p in path] == pytest.approx([2.5, 4.0, 4.0])
    model = ActuatedDynamics(still(("n", "delta"), 0.5), ("n", "delta"), "start", gear)
    assert [([*model.actuators.state, *model.actuators.inputs])[i] for i in model.take] == [
        "cmd_n",
        "delta",
    ]
    with pytest.raises(ConfigError, match="driven by 'tau'"):
        ActuatedDynamics(still(("tau",)), ("tau",), "start", gear)
    for wrong in (
        {"steer": "3 m"},
        {"steer": "35 deg", "rate": "5 deg"},
        {},
        {"steer": 0.5, "limit": 0},
    ):
        with pytest.raises(ConfigError, match=r"inputs\.delta"):
            GivenActuators({"delta": InputShare(**wrong)}, (), 0.1)  # type: ignore[arg-type]


class Take(ResidualHead):
    """Surge acceleration equal to the first input."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return torch.nn.functional.pad(z[..., 3:4], (0, 2)), s


@pytest.mark.parametrize(
    ("hold", "expected"), [("start", [0.0, 1.0, 2.0]), ("mean", [0.5, 1.5, 2.5])]
)
def test_inputs_are_held_as_in_the_fit(hold: Any, expected: list[float]) -> None:
    """An input that moves by 1 per second: from each step's start, or its mean over the step."""
    gear = GivenActuators({"n": InputShare(drive=9.0, rate=1.0)}, (), 1.0)
    hybrid = still(("n",), 1.0)
    model = ActuatedDynamics(
        HybridDynamics(hybrid.signals, hybrid.baseline, Take(), 1.0), ("n",), hold, gear
    )
    w = torch.full((1, 3, 1), 9.0, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(model)(model.approach(1), w, torch.zeros(1, 0))
    assert states[0, :, 3].diff().tolist() == pytest.approx(expected)


@pytest.fixture(scope="module")
def flights() -> list[tuple[Flight, Flight]]:
    """Manoeuvres flown by the WAM-V, and by a ridge regression of a few noisy constant inputs,
    zigzags and 3-2-1-1 of it.
    """
    # at 15 deg/s a longer step would reverse the zigzag up to a degree late
    step = 0.05
    content = {
        "vessel": "wam_v_cal",
        "trials": [
            {"kind": "constant", "drive": [0.2, 0.5, 0.8], "steer": [-0.6, -0.2, 0.3, 0.7]},
            {"kind": "zigzag", "count": 12, "heading": ["10 deg", "30 deg"]},
            {"kind": "three_two_one_one", "count": 6},
        ],
        "duration": 40, "step": step, "substeps": 1,
        "noise": {"u": 0.01, "v": 0.01, "r": "0.1 deg/s"},
        "identification": {}, "validation": {},
    }  # fmt: skip
    trials = validate(content, SimulatedTrials, "trials")
    signals = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal")
    config = PrepareConfig(grid=GridConfig(step=step))
    data = samples(
        [prepare(log, "train", signals.columns, config) for log in simulate(trials.draw(), trials)],
        signals.build(),
    )
    head = RidgeConfig(features=("u", "v", "r", "tau_x", "tau_n"), terms=TERMS).build(
        signals.build().names
    )
    head.calibrate(data)
    head.solve(data)
    built = signals.build()
    hybrid = HybridDynamics(built, StillConfig().build(built.names), head, step).double().eval()
    plant = load_vessel("wam_v_cal").build()
    gear = PlantActuators(plant, step, 1)
    actuated = ActuatedDynamics(hybrid, signals.columns, "mean", gear)
    sea = Sea(plant, Disturbance(), SensorNoise(), 0)
    ship = Craft(
        "ship",
        PlantDynamics(plant, step, 1),
        Helm.from_plant(plant),
        plant.commands,
        plant.approach(1),
    )
    model = Craft(
        "model",
        actuated,
        Helm(gear.demand, actuated.state, gear.inputs),
        gear.commands,
        actuated.approach(1),
    )
    flown: list[Manoeuvre] = [
        Zigzag(drive=drive, steer=steer, heading=bound * DEG, start=15, reversals=5)
        for bound, drive, steer in (
            (10, 0.4, 0.3),
            (10, 0.9, 0.6),
            (20, 0.55, 0.4),
            (20, 0.9, 0.8),
            (15, 0.7, -0.5),
        )
    ]
    pair = [fly(craft, flown, sea, 60, step) for craft in (ship, model)]
    return list(zip(*pair, strict=True))


@pytest.mark.long
def test_a_learned_model_flies_zigzags_by_itself(flights: list[tuple[Flight, Flight]]) -> None:
    for ship, model in flights[:5]:
        truth, mine = (flight.manoeuvre.indices(flight.motion) for flight in (ship, model))
        assert ship.fault is None
        assert model.fault is None
        assert mine["first_overshoot"] == pytest.approx(truth["first_overshoot"], abs=1.0 * DEG)
        assert mine["period"] == pytest.approx(truth["period"], rel=0.05)
        assert truth["first_overshoot"] > 4 * DEG
        # it steers by the heading that it has itself
        assert not np.array_equal(
            ship.motion["psi"][: len(model.motion)], model.motion["psi"][: len(ship.motion)]
        )


def test_a_plant_that_cannot_be_recorded_is_stepped_as_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: object) -> None:
        raise ExportError("a step that Python decides by values")

    plant = load_vessel("wam_v_vrx").build()
    x = plant.approach(2)
    w, s = torch.ones(2, len(plant.inputs), dtype=torch.float64), x[:, :0]
    wanted = PlantDynamics(plant, 0.1, 5).step(x, w, s)[0]
    recorded = RecordedPlantDynamics(plant, 0.1, 5)
    assert torch.allclose(recorded.step(x, w, s)[0], wanted, rtol=1e-13, atol=1e-15)
    monkeypatch.setattr(lowering, "lowered", refuse)
    plain = RecordedPlantDynamics(plant, 0.1, 5)
    assert torch.equal(plain.step(x, w, s)[0], wanted)
