"""The predictor of document 004's autopilot: its data, its training, and the controller that stands
on it.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch

from residnet.autopilot.heading.controllers import ControlTask
from residnet.autopilot.heading.predictive import (
    DocumentConfig,
    PredictiveConfig,
    PredictorTraining,
)
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.autopilot.training.predictor import simulate_rudder_responses, train_predictor
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
LIMIT = 5 * DEG
GAIN = 3.47
TIME = 3.94
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
SETTINGS = PredictorTraining(states=1000, epochs=40, batch=50)


@pytest.fixture(scope="module")
def steering() -> ControlTask:
    """The heading control of the vessel, with its identified Nomoto model."""
    return ControlTask(VESSEL, VESSEL.estimate_nomoto(LIMIT, 60.0), LIMIT, 0.1)


def test_answers_are_nomotos_closed_form(steering: ControlTask) -> None:
    """T r_dot + r = K delta from the yaw rate r0 under a held angle, for every state and angle of
    the data.
    """
    law = DocumentConfig(horizon=2.0)
    horizon = 2.0
    angles = torch.linspace(-LIMIT, LIMIT, 41, dtype=torch.float64)
    x, change = simulate_rudder_responses(
        VESSEL, law.build_exact_predictor(steering), angles, SETTINGS, 50, 3
    )
    start = x[:, VESSEL.state_column("r"), None]
    steady = GAIN * angles[None, :]
    decay = 1 - math.exp(-horizon / TIME)
    torch.testing.assert_close(change[:, 1], (steady - start) * decay, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(
        change[:, 0], steady * horizon + (start - steady) * TIME * decay, rtol=1e-4, atol=1e-7
    )
    # the states fill what random angles lead to, on both sides
    assert float(start.min()) < -0.3 * GAIN * LIMIT < 0.3 * GAIN * LIMIT < float(start.max())


def test_a_linear_network_finds_nomotos_affine_map(steering: ControlTask, tmp_path: Path) -> None:
    """Correction G21: layers without activation are exact here; the network's slope with the yaw
    rate is that of the closed form.
    """
    config = PredictiveConfig(horizon=2.0, hidden=(20,), linear=True, training=SETTINGS)
    torch.manual_seed(0)
    network = config.predictor_spec(steering).build()
    notes = train_predictor("mlp", network, config, steering, 0, tmp_path)
    assert notes["rms_heading"] < 0.01 * DEG
    assert notes["rms_yaw_rate"] < 0.01 * DEG
    x = torch.zeros(2, len(VESSEL.state), dtype=torch.float64)
    x[:, VESSEL.state_column("u")] = 3.2
    x[1, VESSEL.state_column("r")] = 0.1
    heading = torch.tensor([0.5, 0.5], dtype=torch.float64)
    error, rate = network(x, heading, torch.zeros(41))
    decay = math.exp(-2.0 / TIME)
    assert float(rate[1, 20] - rate[0, 20]) == pytest.approx(0.1 * decay, rel=0.01)
    assert float(error[0, 20] - error[1, 20]) == pytest.approx(0.1 * TIME * (1 - decay), rel=0.01)
    assert (tmp_path / "tensorboard" / "mlp").is_dir()


def test_the_document_s_law_turns_the_short_way(steering: ControlTask) -> None:
    """From 170 deg to -170 deg the bow goes through south."""
    law = DocumentConfig(horizon=6.0).build(steering)
    x, _ = VESSEL.straight_course(torch.ones(1, dtype=torch.float64))
    x[:, VESSEL.state_column("psi")] = 170 * DEG
    command, _ = law(x, torch.tensor([[-170 * DEG]], dtype=torch.float64), x[:, :0])
    assert float(command) > 0
