"""A learned model that is Nomoto's own, steered beside the plant: with any variation both move
alike.
"""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from made_models import nomoto_model

from residnet.baselines.regressors import RegressorsConfig
from residnet.control.heading.controllers import PdConfig, Steering
from residnet.control.heading.vessels import SteeredModel, SteeredPlant, fly
from residnet.core.errors import ConfigError
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.steering_variation import DEPTH
from residnet.physics.vessel import load_vessel
from residnet.testing.checks import SUBMERGED, example_spec

DEG = math.pi / 180
GAIN, TIME = 3.47, 3.94
VARIED = torch.tensor(
    [[1.0, 1.0, 0.0], [0.8, 1.2, 0.5 * DEG], [1.2, 0.8, -DEG]], dtype=torch.float64
)


def pair(name: str) -> tuple[SteeredPlant, SteeredModel]:
    vessel = SteeredPlant(load_vessel(name).build())
    spec, model = nomoto_model(GAIN, TIME, 0.1)
    return vessel, SteeredModel(model, spec.signals.columns, spec.hold, vessel)


@pytest.mark.long
@pytest.mark.parametrize("name", ["nomoto_oceanos", "nomoto_oceanos_rate10"])
def test_a_perfect_model_flies_as_its_vessel(name: str) -> None:
    vessel, learned = pair(name)
    flights = []
    for steered in (vessel, learned):
        pd = PdConfig(kp=3.0, damping_time=1.5).build(
            Steering(steered, vessel.turning(5 * DEG, 60.0), 5 * DEG, 0.01)
        )
        flights.append(
            fly(steered, pd, torch.tensor([0.5, 0.3, -0.4]), VARIED, dt=0.01, duration=8.0)
        )
    # the model divides what a step changes by `time`, which is of first order in the step
    assert float((flights[0].state("psi") - flights[1].state("psi")).abs().max()) < 1e-3
    assert float((flights[0].inputs - flights[1].inputs).abs().max()) < 0.1 * DEG


def test_turning_is_that_of_the_model() -> None:
    turning = pair("nomoto_oceanos")[1].turning(5 * DEG, 60.0)
    assert turning.gain == pytest.approx(GAIN, rel=1e-6)
    assert turning.time == pytest.approx(TIME, rel=1e-3)


def test_a_rudder_that_lags_is_part_of_the_answer() -> None:
    # fins of a torpedo in six degrees of freedom follow with a time constant of a second
    vessel, learned = pair("remus_100")
    assert (vessel.rate, vessel.lag) == (None, pytest.approx(1.0, rel=1e-3))
    turning = learned.turning(5 * DEG, 60.0)
    assert turning.gain == pytest.approx(GAIN, rel=1e-6)
    assert turning.time == pytest.approx(TIME + 1.0, rel=1e-2)


def test_planes_of_a_learned_torpedo_pitch_it_as_the_vessel_does() -> None:
    vessel = SteeredPlant(load_vessel("remus_100").build(), axis=DEPTH)
    # accelerations as the parameters of the vessel have them
    known = {
        "u": {
            "u|u|": -0.192,
            "n|n|": 0.00508,
            "|n| u": -0.0312,
            "w q": -1.9,
            "u^2 delta_s^2": -0.113,
        },
        "w": {"u w": -0.48, "w|w|": -2.58, "u q": 0.527, "u^2 delta_s": -0.0594},
        "q": {"q": -1.44, "q|q|": -2.7, "sin(theta)": -0.81, "u^2 delta_s": -0.383},
    }
    rows = {axis: tuple(known.get(axis, ("u v",))) for axis in SUBMERGED.live.velocities}
    changes = {"baseline": RegressorsConfig.model_validate({"terms": rows}), "integrator": "rk4"}
    model = example_spec(None, SUBMERGED).model_copy(update=changes).build().double()
    baseline: Any = model.baseline
    with torch.no_grad():
        for axis, row in known.items():
            for term, value in row.items():
                place = baseline.outputs.index(f"{axis}_dot"), baseline.library.terms.index(term)
                baseline.theta[place] = value
    learned = SteeredModel(model, SUBMERGED.columns, "start", vessel)
    found, wanted = (one.turning(5 * DEG, 20.0, 0.1) for one in (learned, vessel))
    assert found.gain == pytest.approx(wanted.gain, rel=0.05)
    assert found.time == pytest.approx(wanted.time, rel=0.1)
    with pytest.raises(ConfigError, match="depth control needs a model that tells z"):
        SteeredModel(nomoto_model(GAIN, TIME, 0.1)[1], ("delta",), "start", vessel)


def test_gradients_pass_through_the_model_in_single_precision() -> None:
    _, learned = pair("nomoto_oceanos_rate10")
    model = learned.model(0.1)
    x, w = learned.start(torch.ones(3))
    command = torch.full((3, 20, 1), 0.02, requires_grad=True)
    states, _, _ = Rollout(model, None)(x, command, learned.memory(VARIED.float()))
    states[:, -1, 2].sum().backward()
    assert states.dtype == torch.float32
    # heading per rad of rudder that is held grows with the time that is left
    assert command.grad is not None
    assert bool((command.grad[:, 1] > command.grad[:, 10]).all())
    assert w.shape == (3, 1)


def test_a_model_without_rudder_is_refused() -> None:
    _, model = nomoto_model(GAIN, TIME, 0.1)
    vessel = SteeredPlant(load_vessel("nomoto_oceanos").build())
    with pytest.raises(ConfigError, match="driven by 'delta'"):
        SteeredModel(model, ("n_port",), "start", vessel)
    with pytest.raises(ConfigError, match="does not command"):
        SteeredModel(model, ("delta", "n"), "start", vessel)
