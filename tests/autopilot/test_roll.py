"""Roll reduction: fins, wave loads, laws, and the training of a policy."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch

from residnet.autopilot.roll import RollPolicy, RollSimulation, sample_wave_loads
from residnet.autopilot.roll_config import (
    GAIN_NAMES,
    EquivalentBoxConfig,
    RollTraining,
    RollTuning,
    RollWeights,
    Sea,
)
from residnet.autopilot.training.roll import RollFit, train_roll_policy, tune_roll_law
from residnet.core.errors import ConfigError
from residnet.physics.vessel import load_vessel

PATROL_BOX = EquivalentBoxConfig(volume=355.88, breadth=7.726, metacentric_radius=3.34).build_box()
LIMITS = math.radians(20.0), math.radians(25.0)
NO_GAINS: Mapping[str, float] = {}
HEADING_ONLY = {
    "heading_gain": 0.5,
    "yaw_rate_gain": 3.0,
    "filter_share": 0.1,
    "rudder_roll_rate_gain": 0.0,
    "rudder_roll_gain": 0.0,
    "fin_roll_rate_gain": 0.0,
    "fin_roll_gain": 0.0,
}
BEAM_SEAS = [Sea(4, 90.0), Sea(4, 270.0)]


def make_policy(units: int = 0, gains: Mapping[str, float] = NO_GAINS) -> RollPolicy:
    values = {name: torch.tensor([value]) for name, value in {**HEADING_ONLY, **gains}.items()}
    return RollPolicy(values, LIMITS, units, 0.1, is_trained=units > 0)


@pytest.fixture(scope="module")
def simulation() -> RollSimulation:
    torch.set_num_threads(1)
    plant = load_vessel("patrol_fins").build()
    return RollSimulation(plant, PATROL_BOX, duration=50.0, transient=10.0)


def test_fins_follow_the_equations_of_the_document() -> None:
    rudders = load_vessel("patrol_fins").actuators  # type: ignore[union-attr]
    fins = rudders.fins
    assert fins is not None
    speed = 7.71
    nu = torch.tensor([[speed, 0.0, 0.0, 0.0]], dtype=torch.float64)
    angle = torch.tensor([math.radians(10.0)], dtype=torch.float64)
    x, y, k, n = fins.force(angle, nu)[0].tolist()
    # (5.20), (5.21) by hand
    lift = 0.5 * 1025 * speed**2 * 1.7 * 2.443 * math.radians(10.0)
    drag = 0.5 * 1025 * speed**2 * 1.7 * (2.443 * math.radians(10.0)) ** 2 / (0.9 * math.pi * 2.0)
    lever = 3.6 * math.cos(math.radians(34.0)) + 1.9 * math.sin(math.radians(34.0))
    assert k == pytest.approx(2 * lever * lift, rel=1e-4)
    assert x == pytest.approx(-2 * drag, rel=1e-4)
    assert y == pytest.approx(-2 * math.sin(math.radians(34.0)) * lift, rel=1e-4)
    assert n == pytest.approx(1.0 * y, rel=1e-9)
    # a roll rate to starboard is damped, and the lift saturates at the stall angle
    rolling = torch.tensor([[speed, 0.0, 0.1, 0.0]], dtype=torch.float64)
    assert float(fins.force(0.0 * angle, rolling)[0, 2]) < 0.0
    stalled, beyond = (
        float(fins.force(torch.tensor([value]).double(), nu)[0, 2]) for value in (0.41, 0.43)
    )
    assert stalled == pytest.approx(beyond, rel=1e-12)
    assert load_vessel("patrol_fins").actuators.command_names() == (  # type: ignore[union-attr]
        "cmd_delta",
        "cmd_fin",
        "cmd_thrust",
    )


def test_long_waves_incline_the_vessel_like_its_hydrostatics() -> None:
    """The roll moment of a box in long beam seas is rho g V (BM - depth of buoyancy) per slope."""
    box = PATROL_BOX
    assert box.length * box.breadth * box.draught == pytest.approx(355.88)
    waves = Sea(3, 90.0).waves(box).model_copy(update={"peak_period": 40.0})
    sea = waves.build(1, np.random.default_rng(0))
    quadrature, _ = sea.force_response(torch.zeros(1, dtype=torch.float64))
    longest = int(sea.wave_number.argmin())
    slope = float(sea.wave_number[0, longest])
    expected = 1025 * 9.81 * 355.88 * (3.34 - 0.5 * box.draught) * slope
    assert abs(float(quadrature[0, longest, 2])) == pytest.approx(expected, rel=0.02)


def test_wave_loads_are_those_of_the_waves_at_the_encounter_frequency() -> None:
    waves = Sea(5, 135.0).waves(PATROL_BOX)
    t = torch.tensor([0.0, 3.0, 17.5], dtype=torch.float64)
    loads = sample_wave_loads(waves, 2, 7.71, t, np.random.default_rng(4))
    sea = waves.build(2, np.random.default_rng(4))
    zeros = torch.zeros(2, dtype=torch.float64)
    for k, time in enumerate(t.tolist()):
        expected = sea(zeros + 7.71 * time, zeros, zeros, time)
        torch.testing.assert_close(loads[:, k], expected)


def test_fins_and_rudder_reduce_the_roll(simulation: RollSimulation) -> None:
    inputs, _ = simulation.sample_inputs(BEAM_SEAS, 4, 0)
    with torch.no_grad():
        without, fins, rudder = (
            simulation.simulate(make_policy(gains=gains), inputs)
            for gains in (
                NO_GAINS,
                {"fin_roll_rate_gain": 2.0},
                {"rudder_roll_rate_gain": 0.5},
            )
        )
    for runs in (fins, rudder):
        assert float(runs.roll.square().mean()) < 0.9 * float(without.roll.square().mean())
    assert float(fins.commands[..., 1].abs().max()) <= LIMITS[1] + 1e-6
    assert float(without.commands[..., 1].abs().max()) == 0.0


def test_training_starts_from_the_law_and_improves_it(simulation: RollSimulation) -> None:
    gains = {"fin_roll_rate_gain": 0.5, "rudder_roll_rate_gain": 0.1}
    inputs, heights = simulation.sample_inputs(BEAM_SEAS, 8, 77)
    policy = make_policy(4, gains)
    with torch.no_grad():
        law_runs = simulation.simulate(make_policy(gains=gains), inputs)
        start_runs = simulation.simulate(policy, inputs)
    # the network adds nothing before the training
    torch.testing.assert_close(law_runs.roll, start_runs.roll)
    settings = RollTraining(
        epochs=2, steps=4, rows_per_sea=4, validation_rows=4, learning_rate=0.02
    )
    notes = train_roll_policy("roll", policy, simulation, BEAM_SEAS, settings)
    assert notes["best_validation"] < notes["start_validation"]
    weights = RollWeights()
    with torch.no_grad():
        costs = simulation.simulate(policy, inputs).costs(heights, weights).mean()
    assert float(costs) < float(law_runs.costs(heights, weights).mean())
    # the same to port and starboard
    measured = torch.tensor([[0.02, -0.01, 0.1, 0.05]])
    memory = torch.full((1, policy.n_state), 0.1)
    commands, _ = policy(measured, memory)
    mirrored, _ = policy(-measured, -memory)
    torch.testing.assert_close(mirrored, -commands)


def test_a_larger_heading_error_than_that_of_the_law_costs(simulation: RollSimulation) -> None:
    inputs, heights = simulation.sample_inputs(BEAM_SEAS, 4, 5)
    law = make_policy(gains={"fin_roll_rate_gain": 2.0})
    lazy = make_policy(gains={"fin_roll_rate_gain": 2.0, "heading_gain": 0.05})
    settings = RollTraining(heading_excess=2.0, validation_rows=1)
    losses = {}
    with torch.no_grad():
        runs = {name: simulation.simulate(p, inputs) for name, p in (("law", law), ("lazy", lazy))}
        for name, start_law in (("free", None), ("limited", law)):
            fit = RollFit(law, simulation, BEAM_SEAS, RollWeights(), settings, 0, start_law)
            losses[name] = {
                key: float(fit.compute_loss(run, inputs, heights)) for key, run in runs.items()
            }
    mean_costs = runs["lazy"].costs(heights, RollWeights()).mean()
    assert losses["free"]["lazy"] == pytest.approx(float(mean_costs))
    # the law itself has no excess
    assert losses["limited"]["law"] == pytest.approx(losses["free"]["law"])
    rms = {name: float(run.heading.square().mean().sqrt()) for name, run in runs.items()}
    assert rms["lazy"] > 1.1 * rms["law"]
    penalty = losses["limited"]["lazy"] - losses["free"]["lazy"]
    assert penalty == pytest.approx(2.0 * (rms["lazy"] / rms["law"] - 1.0), rel=1e-3)


def test_an_epoch_far_above_the_best_is_discarded(simulation: RollSimulation) -> None:
    settings = RollTraining(validation_rows=1)
    fit = RollFit(make_policy(), simulation, BEAM_SEAS, RollWeights(), settings, 0)
    assert fit.find_worse_epochs() == []
    fit.start_score = 2.0
    losses = (1.9, 1.93, 2.0, math.nan, 1.5, 1.6)
    fit.history = [{"epoch": float(i), "validation": loss} for i, loss in enumerate(losses)]
    assert fit.find_worse_epochs() == [False, False, True, True, False, True]


def test_tuning_finds_a_better_law(simulation: RollSimulation) -> None:
    inputs, heights = simulation.sample_inputs(BEAM_SEAS, 1, 11)
    gains, cost = tune_roll_law(
        simulation, BEAM_SEAS, LIMITS, settings=RollTuning(generations=2, population=2)
    )
    assert set(gains) == set(GAIN_NAMES)
    with torch.no_grad():
        tuned = simulation.simulate(make_policy(gains=gains), inputs).costs(heights, RollWeights())
        untuned = simulation.simulate(make_policy(), inputs).costs(heights, RollWeights())
    assert float(tuned.mean()) == pytest.approx(cost, rel=1e-4)
    assert cost < float(untuned.mean())


def test_a_vessel_without_fins_is_refused_in_one_line() -> None:
    with pytest.raises(ConfigError, match="no stabiliser fins; give its rudders the section"):
        RollSimulation(load_vessel("patrol_p06").build(), PATROL_BOX)
