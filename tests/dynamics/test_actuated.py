"""Actuators in front of a learned model: the plant's own and given ones."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.baselines.given_config import ZeroBaselineConfig
from residnet.core.errors import ConfigError
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.rollout import Rollout
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.manoeuvres.actuated import ActuatedDynamics, ConfiguredActuators, PlantActuators
from residnet.manoeuvres.input_shares import InputShare
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180


def still(columns: tuple[str, ...], dt: float = 0.1) -> HybridDynamics:
    signals = SignalsConfig(inputs=columns).build()
    return HybridDynamics(signals, ZeroBaselineConfig().build(signals.names), ZeroHead(), dt)


@pytest.mark.parametrize(
    "vessel", ["wam_v_cal", "example_rudder_boat", "mariner", "patrol_p06", "nomoto_mariner"]
)
def test_the_gear_is_the_plants_whatever_its_kind(vessel: str) -> None:
    """Actuator states equal those of the plant that is given the same commands."""
    plant = load_vessel(vessel).build()
    step = 0.1
    substeps = 2
    gear = PlantActuators(plant, step, substeps)
    random = np.random.default_rng(0)
    demands = torch.from_numpy(random.uniform(-1, 1, (2, 2, 12))).repeat_interleave(5, dim=-1)
    commands = gear.commands_for_demand(demands[0], demands[1])
    w = torch.zeros(2, 60, len(plant.input_names), dtype=torch.float64)
    w[:, :, : plant.n_commands] = commands
    start = plant.make_initial_state(2)
    with torch.no_grad():
        truth, _, _ = Rollout(PlantDynamics(plant, step, substeps))(start, w, start[:, :0])
        model = ActuatedDynamics(
            still(gear.input_names[:1], step), gear.input_names[:1], "start", gear
        )
        mine, _, _ = Rollout(model)(model.make_initial_state(2), w, start[:, :0])
    hull = ("x", "y", "phi", "psi", "u", "v", "p", "r")
    assert len(gear.state_names) == len([name for name in plant.state_names if name not in hull])
    for name in gear.state_names:
        if name != "_yaw_lag":
            found = mine[..., model.state_names.index(name)]
            wanted = truth[..., plant.state_names.index(name)]
            torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-9)
    assert float((truth[:, -1, 0] - truth[:, 0, 0]).abs().max()) > 0.01


def test_given_gear_by_hand() -> None:
    """The rudder moves by 5 deg/s at most, the revolutions jump; a missing input is one line."""
    shares = {
        "n": InputShare(drive="600 rpm", limit="480 rpm"),
        "delta": InputShare(steer="35 deg", rate="5 deg/s"),
    }
    gear = ConfiguredActuators(shares, ("wind_speed", "wind_dir"), 0.5)
    assert gear.input_names == ("cmd_n", "cmd_delta", "wind_speed", "wind_dir")
    assert gear.state_names == ("delta",)
    command = gear.commands_for_demand(torch.tensor([1.0, 0.5]), torch.tensor([-1.0, 2.0]))
    torch.testing.assert_close(command, torch.tensor([[8.0, -35 * DEG], [5.0, 35 * DEG]]))
    a = gear.make_initial_state(1, ())
    w = torch.tensor([[8.0, 4 * DEG, 0.0, 0.0]], dtype=torch.float64)
    path = [a := gear.step_states(a, w) for _ in range(3)]
    assert [float(p) / DEG for p in path] == pytest.approx([2.5, 4.0, 4.0])
    model = ActuatedDynamics(still(("n", "delta"), 0.5), ("n", "delta"), "start", gear)
    seen = [*model.actuators.state_names, *model.actuators.input_names]
    assert [seen[i] for i in model.input_columns] == ["cmd_n", "delta"]
    with pytest.raises(ConfigError, match="needs the input 'tau'"):
        ActuatedDynamics(still(("tau",)), ("tau",), "start", gear)


@pytest.mark.parametrize(
    "wrong",
    [
        {"steer": "3 m"},
        {"steer": "35 deg", "rate": "5 deg"},
        {},
        {"steer": 0.5, "limit": 0},
    ],
)
def test_a_wrong_share_is_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"inputs\.delta"):
        ConfiguredActuators({"delta": InputShare(**wrong)}, (), 0.1)


class Take(ResidualHead):
    """Surge acceleration equal to the first input."""

    def forward(self, z: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        return torch.nn.functional.pad(z[..., 3:4], (0, 2)), s


@pytest.mark.parametrize(
    ("hold", "expected"), [("start", [0.0, 1.0, 2.0]), ("mean", [0.5, 1.5, 2.5])]
)
def test_inputs_are_held_as_in_the_fit(hold: Any, expected: list[float]) -> None:
    """An input that moves by 1 per second: from each step's start, or its mean over the step."""
    gear = ConfiguredActuators({"n": InputShare(drive=9.0, rate=1.0)}, (), 1.0)
    hybrid = still(("n",), 1.0)
    model = ActuatedDynamics(
        HybridDynamics(hybrid.signals, hybrid.baseline, Take(), 1.0), ("n",), hold, gear
    )
    w = torch.full((1, 3, 1), 9.0, dtype=torch.float64)
    with torch.no_grad():
        states, _, _ = Rollout(model)(model.make_initial_state(1), w, torch.zeros(1, 0))
    assert states[0, :, 3].diff().tolist() == pytest.approx(expected)


def test_a_gear_with_lag_and_delay_follows_its_command() -> None:
    gear = ConfiguredActuators({"delta": InputShare(steer=0.5, lag=2.0, delay=0.3)}, (), 0.1)
    assert gear.state_names == ("delta", "_delta_delay1", "_delta_delay2", "_delta_delay3")
    a = gear.make_initial_state(1, ())
    angles = []
    for _ in range(40):
        a = gear.step_states(a, torch.full((1, 1), 0.5, dtype=torch.float64))
        angles.append(float(a[0, 0]))
    # three steps of dead time, then a first-order response
    assert angles[:3] == [0.0, 0.0, 0.0]
    expected = [0.5 * (1.0 - math.exp(-0.1 * (k - 2) / 2.0)) for k in range(3, 40)]
    assert angles[3:] == pytest.approx(expected)
