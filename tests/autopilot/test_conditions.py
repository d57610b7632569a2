"""Heading changes under stated conditions: what is drawn, what acts when, and their cost."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from residnet.autopilot.base import Policy
from residnet.autopilot.heading.conditions import (
    ClosedLoopSimulation,
    ClosedLoopTrajectories,
    ConditionsConfig,
    HeadingStepBatch,
    LimitCycleTest,
    SteadinessLimits,
    count_excess_overshoots,
    noise_free,
    sample_gauss_markov,
    sample_wave_motion,
    with_nominal_rows,
)
from residnet.autopilot.heading.controllers import ControlTask, PdConfig, PidConfig, PtosConfig
from residnet.autopilot.heading.steering_variation import HEADING
from residnet.autopilot.heading.tuning import TuningConfig, tune_parameters
from residnet.autopilot.heading.turning import NomotoModel
from residnet.autopilot.heading.vessels import SteeredPlant
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
VESSEL = SteeredPlant(load_vessel("nomoto_oceanos").build())
STEERING = ControlTask(VESSEL, NomotoModel(3.47, 3.94, 3.2), 5 * DEG, 0.05)
CALM = ConditionsConfig(
    effect=(1.0, 1.0), time=(1.0, 1.0), delay=(0.0, 0.0), bias=0.0, push=0.0,
    noise_psi=0.0, noise_r=0.0, hold=1.0, duration=6.0, dt=0.05,
)  # fmt: skip


class Ramp(Policy):
    """Commands that grow by a hundredth of a degree with every step, whatever is seen."""

    def __init__(self) -> None:
        super().__init__()
        self.n_state = 1

    def forward(
        self, x: torch.Tensor, reference: torch.Tensor, s: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return s + 0.01 * DEG, s + 0.01 * DEG


def drawn(
    config: ConditionsConfig, rows: int = 4, seed: int = 3, share: float = 1.0
) -> HeadingStepBatch:
    return config.sample_steps(rows, config.dt, torch.Generator().manual_seed(seed), share)


def test_a_command_acts_after_its_delay_and_the_push_beside_the_bias() -> None:
    config = CALM.model_copy(update={"delay": (0.0, 0.4), "bias": DEG, "push": 0.5 * DEG})
    changes = drawn(config, 6)
    run = ClosedLoopSimulation(VESSEL, Ramp(), config.dt)
    states, inputs, _ = run.rollout(8)(*run.rollout_arguments(changes))
    arrived, push, issued = inputs.unbind(2)
    for row, delay in enumerate(changes.delay_steps.long().tolist()):
        shifted = torch.cat((torch.zeros(delay), issued[row])).double()[: issued.shape[1]]
        assert torch.equal(arrived[row], shifted)
    assert len(set(changes.delay_steps.tolist())) > 2
    # the yaw rate that this gives, with Nomoto's exact step, bias and push included
    angle = arrived + push + changes.vessel_variation[:, 2:3]
    keep = math.exp(-0.05 / 3.94)
    r = torch.zeros(6, dtype=torch.float64)
    for k in range(inputs.shape[1]):
        r = keep * r + (1 - keep) * 3.47 * angle[:, k]
    assert torch.allclose(states[:, -1, VESSEL.state_column("r")], r, atol=1e-8)


def test_the_cost_is_what_it_says() -> None:
    changes = drawn(CALM, 1)
    start = int(changes.step_index[0])
    steps = changes.push.shape[1]
    side = float(changes.target.sign()[0])
    # before the jump anything may happen; then half of the time 3 deg short, half 2 deg beyond
    error = torch.full((1, steps), 3.0 * DEG)
    error[0, start + 60 :] = -2.0 * DEG
    error[0, :start] = 70 * DEG
    command = torch.zeros(1, steps)
    command[0, start + 5 :: 2] = DEG
    psi = changes.target[:, None] - side * error
    states = torch.cat((psi, psi[:, -1:]), dim=1).unsqueeze(2)
    about = (changes.dt, ("psi",), HEADING, changes.step_index, changes.n_counted)
    flown = ClosedLoopTrajectories(states, command, changes.target, *about)
    found = flown.step_metrics(CALM)
    changed = int((np.diff(command[0, : start + 120].numpy()) != 0).sum())
    assert float(found["time_outside"]) == pytest.approx(3.0 * 3 / 4 + 3.0 * 2 / 3, rel=1e-4)
    assert float(found["overshoot"]) == pytest.approx(2.0 * DEG, rel=1e-4)
    assert float(found["travel"]) == pytest.approx(changed * DEG, rel=1e-4)
    assert float(found["cost"]) == pytest.approx(
        float(found["time_outside"]) + 0.5 * 2.0 + 0.01 * changed, rel=1e-4
    )


def test_late_swing_is_the_variance_of_the_last_share_alone() -> None:
    changes = drawn(CALM)
    flown = ClosedLoopSimulation(VESSEL, Ramp(), CALM.dt).simulate(changes)
    steps = round(changes.n_counted / 3)
    # of evenly spaced values
    expected = (0.01 * DEG) ** 2 * (steps**2 - 1) / 12
    assert torch.allclose(flown.late_command_variance(1 / 3), torch.full((4,), expected).double())
    assert torch.equal(flown.late_command_variance(0.0), torch.zeros(4).double())


def test_the_first_flights_go_to_corners_of_the_spread() -> None:
    config = ConditionsConfig(dt=0.05, duration=10.0)
    changes = drawn(config, 60)
    moved = config.with_corner_rows(changes, 40, torch.Generator().manual_seed(0), 0.5)
    assert torch.equal(moved.vessel_variation[40:], changes.vessel_variation[40:])
    assert torch.equal(moved.delay_steps[40:], changes.delay_steps[40:])
    assert torch.equal(moved.vessel_variation[:, 2], changes.vessel_variation[:, 2])
    for column in (0, 1):
        assert set(moved.vessel_variation[:40, column].mul(100).round().tolist()) == {90.0, 110.0}
    assert set(moved.delay_steps[:40].tolist()) == {0.0, 4.0}


def test_disturbances_have_the_statistics_that_are_stated() -> None:
    config = ConditionsConfig(dt=0.05, duration=20.0)
    changes = drawn(config, 400)
    assert float(changes.push.std()) == pytest.approx(config.push, rel=0.05)
    found = sample_gauss_markov(4000, 40, 0.02, torch.Generator().manual_seed(0))
    assert torch.allclose(found.std(0), torch.ones(40), atol=0.06), "from its first sample on"
    lag = round(config.push_time / config.dt)
    pushed = changes.push.numpy()
    correlation = np.mean(pushed[:, lag:] * pushed[:, :-lag]) / pushed.var()
    assert correlation == pytest.approx(math.exp(-1), abs=0.08)
    assert float(changes.noise[:, :, 0].std()) == pytest.approx(config.noise_psi, rel=0.02)
    low = changes.vessel_variation.amin(0)
    high = changes.vessel_variation.amax(0)
    assert 0.8 <= float(low[0]) < 0.82
    assert 1.18 < float(high[0]) <= 1.2
    assert float(changes.delay_steps.max()) == round(0.4 / 0.05)
    # a coarser step sees the same spectrum of noise, and none of it is a calm flight
    coarse = config.sample_steps(400, 0.2, torch.Generator().manual_seed(1))
    assert float(coarse.noise[:, :, 1].std()) == pytest.approx(0.5 * config.noise_r, rel=0.03)
    none = drawn(config, 50, share=0.0)
    assert float(none.noise.abs().max()) == float(none.push.abs().max()) == 0.0
    assert torch.equal(none.vessel_variation, torch.tensor([[1.0, 1.0, 0.0]]).expand(50, 3))


def test_the_motion_in_waves_has_its_size_its_period_and_its_own_rate() -> None:
    period = torch.full((300,), 7.0)
    motion, rate = sample_wave_motion(period, 1200, 0.05, torch.Generator().manual_seed(0)).unbind(
        2
    )
    assert float(motion.std()) == pytest.approx(1.0, rel=0.03)
    slope = (motion[:, 2:] - motion[:, :-2]) / 0.1
    assert torch.allclose(slope, rate[:, 1:-1], atol=0.02)
    power = torch.fft.rfft(motion).abs().square().mean(0)
    assert float(power.argmax()) / (1200 * 0.05) == pytest.approx(1.0 / 7.0, rel=0.15)


def test_waves_are_added_to_what_is_measured_and_change_nothing_else() -> None:
    config = ConditionsConfig(dt=0.05, duration=10.0)
    calm = drawn(config, 60)
    rough = drawn(config.model_copy(update={"waves": DEG}), 60)
    assert torch.equal(calm.push, rough.push)
    assert torch.equal(calm.vessel_variation, rough.vessel_variation)
    added = (rough.noise - calm.noise)[:, :, 0].std(1)
    assert float(added.min()) > 0.0
    assert 0.4 * DEG < float(added.mean()) < 0.6 * DEG
    assert float(noise_free(config.model_copy(update={"waves": DEG})).waves) == 0.0


@pytest.mark.parametrize(
    "wrong",
    [{"effect": (1.2, 0.8)}, {"heading": (0.5, 4.0)}, {"delay": (-0.1, 0.2)}, {"wind": (9.0, 3.0)}],
)
def test_ranges_are_in_order(wrong: dict[str, tuple[float, float]]) -> None:
    with pytest.raises(ValidationError, match="must be in order"):
        ConditionsConfig(**wrong)  # type: ignore[arg-type]


def test_evolution_finds_better_gains_than_a_grid_of_guesses_and_again_the_same() -> None:
    config = ConditionsConfig(dt=0.1, duration=8.0, hold=0.0, delay=(0.0, 0.2))
    settings = TuningConfig(flights=8, population=4, generations=5)
    found = tune_parameters(PdConfig(), STEERING, config, settings, 5)
    changes = config.sample_steps(8, 0.1, torch.Generator().manual_seed(5))
    gains: dict[str, Any] = dict(found.parameters)
    # a low pass depends on the step that it runs at
    steering = STEERING._replace(dt=0.1)
    again = ClosedLoopSimulation(VESSEL, PdConfig(**gains).build(steering), 0.1).simulate(changes)
    assert found.cost == pytest.approx(float(again.step_metrics(config)["cost"].mean()), rel=1e-2)
    for kp in (0.5, 2.0, 6.0):
        for damping in (0.5, 1.5):
            law = PdConfig(kp=kp, damping_time=damping).build(STEERING)
            guess = (
                ClosedLoopSimulation(VESSEL, law, 0.1)
                .simulate(changes)
                .step_metrics(config)["cost"]
                .mean()
            )
            assert found.cost < float(guess) * 1.01
    assert tune_parameters(PdConfig(), STEERING, config, settings, 5) == found


def test_pid_is_never_worse_than_the_pd_within_it() -> None:
    config = ConditionsConfig(dt=0.1, duration=8.0, hold=0.0, bias=0.0, push=0.0)
    settings = TuningConfig(flights=8, population=2, generations=1)
    given: dict[str, Any] = {"kp": 2.0, "damping_time": 1.0}
    pd, pid = (
        tune_parameters(law(**given), STEERING, config, settings, 5)
        for law in (PdConfig, PidConfig)
    )
    # an integral of a million T is not quite none
    assert pid.cost <= pd.cost * (1 + 1e-6)


LATE = ConditionsConfig(dt=0.1, duration=8.0, delay=(0.3, 0.4))
STEEP = PtosConfig(
    steepness=250.0, share=0.9, damping=0.6, heading_rate=5.0, yaw_rate_rate=10.0, push_rate=1.0,
    cross_rate=0.1,
)  # fmt: skip


def refused(controller: PdConfig | PtosConfig, limits: SteadinessLimits) -> int:
    run = ClosedLoopSimulation(VESSEL, controller.build(STEERING._replace(dt=0.1)), 0.1)
    return LimitCycleTest(limits, LATE, 1).count_failures(run)


def test_flights_that_swing_or_overshoot_are_counted() -> None:
    limits = SteadinessLimits(flights=8)
    # late commands are too late for a steep law; the nominal vessel of sixteen flights has none
    assert refused(STEEP, limits) >= 8
    assert refused(PdConfig(kp=1.4, damping_time=1.4), limits) == 0
    limits = SteadinessLimits(flights=2, overshoot=0.3 * DEG)
    hasty = PdConfig(kp=1.5, damping_time=1.1)
    assert refused(hasty, limits) > refused(hasty, limits.model_copy(update={"overshoot": 1.0}))
    # one flight in twenty may overshoot by more
    overshoot = torch.zeros(60)
    overshoot[:3] = 1.0
    assert count_excess_overshoots(overshoot, 0.5) == 0
    overshoot[3:5] = 0.6
    assert (count_excess_overshoots(overshoot, 0.5), count_excess_overshoots(overshoot, 2.0)) == (
        2,
        0,
    )
    overshoot[5] = math.nan
    assert count_excess_overshoots(overshoot, 0.5) == 3


def test_nominal_rows_have_no_delay_bias_or_weather() -> None:
    config = ConditionsConfig(wind=(2.0, 8.0), current=0.5, delay=(0.2, 0.4))
    drawn = config.sample_steps(6, config.dt, torch.Generator().manual_seed(0))
    changed = with_nominal_rows(drawn, 2, 3)
    assert torch.equal(changed.vessel_variation[2:5], torch.tensor([[1.0, 1.0, 0.0]]).expand(3, 3))
    assert not changed.delay_steps[2:5].any()
    assert not any(values[2:5].any() for values in changed.weather.values())
    for rows in (slice(0, 2), slice(5, 6)):
        assert torch.equal(changed.vessel_variation[rows], drawn.vessel_variation[rows])
        assert torch.equal(changed.delay_steps[rows], drawn.delay_steps[rows])
