"""Depth by the stern planes of a torpedo: the law, what it is trained in, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml
from pydantic import ValidationError
from tiny import write_yaml

from residnet.autopilot.heading.conditions import (
    ClosedLoopSimulation,
    ConditionsConfig,
    DepthStepConfig,
    simulate_heading_steps,
)
from residnet.autopilot.heading.controllers import ControlTask, DepthConfig, DepthPolicySpec
from residnet.autopilot.heading.steering_variation import DEPTH, VariedPlant
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.autopilot.tasks.autopilot.config import AutopilotConfig
from residnet.core.errors import ConfigError, FitError
from residnet.dynamics.simulated import PlantDynamics
from residnet.engine.rollout import Rollout
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
CONFIG = Path(__file__).parents[2] / "configs" / "autopilot_remus_depth.yaml"
TURNING = NomotoModel(0.88, 0.81, 2.55, 0.28)
LAW: dict[str, Any] = {
    "kind": "ptos", "lag": 1.0, "steepness": 6.2, "share": 0.34, "damping": 0.8,
    "heading_rate": 4.0, "yaw_rate_rate": 15.0, "push_rate": 0.25, "cross_rate": 1.2,
}  # fmt: skip
SIGHT = {"lookahead": 10.0, "depth_rate": 1.0, "drift_rate": 0.2}
COMPLETE = DepthConfig.model_validate({"pitch": LAW, **SIGHT})


@pytest.fixture(scope="module")
def vessel() -> SteeredPlant:
    return SteeredPlant(load_vessel("remus_100").build(), axis=DEPTH)


def test_the_planes_come_first_and_nothing_varied_is_the_plant(vessel: SteeredPlant) -> None:
    plant = vessel.plant
    assert vessel.inputs == ("cmd_delta_s", "cmd_delta", "cmd_n")
    x, w = vessel.straight_course(torch.ones(1, dtype=torch.float64))
    w[:, 0], w[:, 1] = 0.1, -0.05
    mine, _, _ = Rollout(VariedPlant(plant, 0.1, axis=DEPTH))(
        x, w.expand(1, 50, -1), torch.tensor([[1.0, 1.0, 0.0]], dtype=torch.float64)
    )
    own = w[:, [vessel.inputs.index(name) for name in plant.input_names]]
    truth, _, _ = Rollout(PlantDynamics(plant, 0.1))(x, own.expand(1, 50, -1), x[:, :0])
    assert torch.allclose(mine, truth, rtol=0, atol=1e-12)
    assert mine[0, -1, vessel.state_column("z")] > 1.0


def test_a_depth_is_held_to_a_centimetre_with_a_trim_that_is_off(vessel: SteeredPlant) -> None:
    policy = COMPLETE.build(ControlTask(vessel, TURNING, 15 * DEG, 0.1))
    biased = torch.tensor([[1.0, 1.0, 2 * DEG], [0.8, 1.2, -DEG]])
    flown = simulate_heading_steps(
        vessel, policy, torch.tensor([3.0, -2.0]), biased, dt=0.1, duration=45.0
    )
    assert float(flown.error[:, -100:].abs().max()) < 0.01
    assert float(flown.state("theta").abs().max()) < 35 * DEG
    assert float(flown.overshoot().max()) < 1.0


def test_rows_are_the_policies_of_their_own_constants(vessel: SteeredPlant) -> None:
    steering = ControlTask(vessel, TURNING, 15 * DEG, 0.1)
    wanted = COMPLETE.complete_parameters()
    open_ = DepthConfig.model_validate({"pitch": {"kind": "ptos", "lag": 1.0}})
    assert list(open_.parameter_values()) == list(wanted) == list(open_.search_ranges(TURNING))
    assert open_.with_parameters(wanted) == COMPLETE
    rows = {name: torch.tensor([value, 2.0 * value]) for name, value in wanted.items()}
    many = open_.build_batched(rows, steering).float()
    one = COMPLETE.build(steering).float()
    x = torch.zeros(2, len(vessel.state))
    x[:, vessel.state_column("u")], x[:, vessel.state_column("theta")] = 2.5, -0.1
    reference = torch.tensor([[0.5], [0.5]])
    s = one.initial_state(x)
    with torch.no_grad():
        got = many(x, reference, s)[0]
        alone = one(x, reference, s)[0]
    assert float(got[0]) == pytest.approx(float(alone[0]), abs=1e-6)
    assert float(got[1]) != pytest.approx(float(alone[1]), abs=1e-3)


def test_gradients_of_the_cost_reach_law_line_of_sight_and_network(vessel: SteeredPlant) -> None:
    torch.manual_seed(0)
    described = {
        "state": vessel.state, **TURNING.to_json(), "limit": 15 * DEG, "rate": None, "dt": 0.1,
        "trained_at": 0.1, "units": 3, "law": LAW,
    }  # fmt: skip
    law: Any = described
    policy = DepthPolicySpec(law=law, steepest=0.5, sight=SIGHT).build().float()
    conditions = ConditionsConfig(depth=DepthStepConfig(), hold=0.0, duration=6.0, dt=0.1)
    assert conditions.axis is DEPTH
    changes = conditions.sample_steps(4, 0.1, torch.Generator().manual_seed(1))
    assert changes.noise.shape == (4, 60, 3)
    run = ClosedLoopSimulation(vessel, policy, 0.1, "heun", torch.float32)
    flown = run.to_trajectories(changes, *run.rollout(4)(*run.rollout_arguments(changes))[:2])
    flown.step_metrics(conditions)["cost"].mean().backward()
    network: Any = policy.inner_policy
    for part in (policy.constants, network.constants, network.network.out.weight):
        assert part.grad is not None
        assert torch.isfinite(part.grad).all()
        assert float(part.grad.abs().max()) > 0


def test_planes_that_are_reversed_are_refused() -> None:
    torpedo = SteeredPlant(load_vessel("remus_100").build(), axis=DEPTH._replace(side=1.0))
    with pytest.raises(FitError, match="check the sign"):
        torpedo.estimate_nomoto(15 * DEG, 8.0, 0.1)


# 20 s until the pitch has not settled; reversed planes are refused in half of the time
@pytest.mark.long
def test_a_vessel_that_nothing_rights_is_refused(tmp_path: Path) -> None:
    content = yaml.safe_load(Path("configs/vessels/remus_100.yaml").read_text())
    content["rigid_body"]["z_G"]["value"] = 0.0
    neutral = write_yaml(tmp_path / "neutral.yaml", content)
    torpedo = SteeredPlant(load_vessel(str(neutral)).build(), axis=DEPTH)
    with pytest.raises(FitError, match="without a restoring moment"):
        torpedo.estimate_nomoto(15 * DEG, 20.0, 0.1)


def test_vessels_without_planes_and_mixed_axes_are_refused() -> None:
    with pytest.raises(ConfigError, match="needs a vessel with the command cmd_delta_s"):
        SteeredPlant(load_vessel("nomoto_oceanos").build(), axis=DEPTH).model(0.1)
    given = yaml.safe_load(CONFIG.read_text())
    for change, message in (
        ({"vessel": "patrol_p06"}, "no command 'cmd_delta_s'"),
        ({"rudder": "31 deg"}, "0.5236 rad at most"),
        ({"peers": {**given["peers"], "lone": {"kind": "pd"}}}, "peers.lone: test.depth is given"),
        ({"test": {**given["test"], "depth": None}}, "conditions.stated.depth"),
        ({"policies": {"learned": {"start": None}}}, "a depth policy begins with a peer"),
        ({"policies": {"learned": {"start": "pid"}}}, "or of kind depth with such a pitch"),
        ({"pace": 2.0}, "remove 'predictive' and 'pace'"),
    ):
        with pytest.raises(ValidationError, match=message):
            AutopilotConfig.model_validate({**given, **change})
    with pytest.raises(ValidationError, match="waves"):
        ConditionsConfig(depth=DepthStepConfig(), waves=0.01)
