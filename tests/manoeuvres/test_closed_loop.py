"""Stop conditions, spirals and excitation: what ends when, and the frequencies of demands."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from residnet.autopilot.manoeuvres import FOUR_CORNER_POSES, FourCorner
from residnet.autopilot.motion_config import MotionPIDConfig
from residnet.core.errors import UsageError
from residnet.core.log import Log
from residnet.dynamics.base import Dynamics
from residnet.engine.recorded_plant import RecordedPlantDynamics
from residnet.engine.rollout import Rollout, Source
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.closed_loop import (
    Spiral,
    SteadyConfig,
    TurningCircle,
    Zigzag,
    initial_steadiness,
    is_steady,
    reset_steady_time,
    update_steadiness,
)
from residnet.manoeuvres.open_loop import MultiSine, RandomSteps
from residnet.manoeuvres.sources import StackedSource, StopRecorder
from residnet.manoeuvres.trials import SimulatedVessel, TrialEnvironment, simulate_manoeuvres
from residnet.manoeuvres.trials_config import DisturbanceConfig, SensorsConfig
from residnet.physics.vessel import load_vessel

DEG = math.pi / 180
STATE = ("x", "y", "psi", "u", "v", "r")
HELM = Helm(
    lambda drive, steer: torch.stack((30 * DEG * steer, drive), dim=-1),
    STATE,
    ("cmd_delta", "cmd_n"),
)


class Nomoto(Dynamics):
    """T r_dot + r = K (delta - r_0), exactly over a step, at 1 m/s; `offset` makes a vessel that
    pulls to one side.
    """

    def __init__(
        self, gain: float = 0.4, time: float = 3.0, offset: float = 0.0, dt: float = 0.1
    ) -> None:
        super().__init__(dt, "euler")
        self.gain = gain
        self.time = time
        self.offset = offset
        self.steps = 0

    def state_derivative(self, x: Tensor, p: Tensor, rho: Tensor) -> Tensor:
        return x

    def step(self, x: Tensor, w: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
        self.steps += 1
        final = self.gain * (w[:, 0] - self.offset)
        keep = math.exp(-self.dt / self.time)
        r = final + (x[:, 5] - final) * keep
        psi = x[:, 2] + final * self.dt + (x[:, 5] - final) * self.time * (1 - keep)
        out = x.clone()
        out[:, 2], out[:, 5] = psi, r
        out[:, 0], out[:, 1] = (
            x[:, 0] + self.dt * torch.cos(psi),
            x[:, 1] + self.dt * torch.sin(psi),
        )
        return out, s


def flown(
    source: Source, rows: int, steps: int, model: Nomoto | None = None
) -> tuple[Tensor, Tensor, Tensor, Nomoto]:
    model = model or Nomoto()
    watched = StopRecorder(source, rows)
    x0 = torch.zeros(rows, 6, dtype=torch.float64)
    x0[:, 3] = 1.0
    with torch.no_grad():
        x, w, _ = Rollout(model, watched)(
            x0, torch.zeros(rows, steps, 2, dtype=torch.float64), x0[:, :0]
        )
    return x, w, watched.stop_step, model


def times(steps: int, dt: float = 0.1) -> Tensor:
    return torch.arange(steps, dtype=torch.float64) * dt


def test_stop_recorder_stops_each_row_and_the_loop() -> None:
    circles = [
        TurningCircle(drive=1, steer=1.0, start=1),
        TurningCircle(drive=1, steer=-0.5, start=1, until=math.pi),
    ]
    zigzags = [Zigzag(drive=1, steer=0.5, heading=10 * DEG, start=1, reversals=3)]
    t = times(2000)
    source = StackedSource(
        [TurningCircle.build_source(circles, HELM, t), Zigzag.build_source(zigzags, HELM, t)],
        [2, 1],
    )
    x, w, stopped, model = flown(source, 3, 2000)
    assert x.shape == (3, 2001, 6)
    assert w.shape == (3, 2000, 2)
    assert model.steps == int(stopped.max()) + 1
    for row, turned in ((0, 3 * math.pi), (1, -math.pi)):
        k = int(stopped[row])
        assert abs(float(x[row, k, 2])) >= abs(turned) > abs(float(x[row, k - 1, 2]))
        assert torch.equal(x[row, k:], x[row, k].expand(2001 - k, -1)), "it stays where it stopped"
    psi = x[2, :, 2]
    k = int(stopped[2])
    # starboard, port, starboard, then back to the initial course from starboard
    assert float(psi[k]) <= 0 < float(psi[k - 1])
    assert (torch.sign(w[2, : k + 1, 0]).diff() != 0).sum() == 4


def test_turning_circle_pull_out_ends_at_steady_yaw_rate() -> None:
    """After the turn r decays with T = 3 s; the running mean with the window's time constant
    follows until both are calm.
    """
    circle = TurningCircle(
        drive=1,
        steer=1.0,
        start=1,
        until=math.pi,
        pull_out=True,
        steady=SteadyConfig(window=2.0, tolerance=0.01),
    )
    t = times(1500)
    x, w, stopped, _ = flown(TurningCircle.build_source([circle], HELM, t), 1, 1500)
    k = int(stopped)
    turned = int(np.argmax(x[0, :, 2].numpy() >= math.pi))
    assert float(w[0, turned - 1, 0]) == pytest.approx(30 * DEG)
    assert float(w[0, turned : k + 1, 0].abs().max()) == 0
    assert 2.0 < (k - turned) * 0.1 < 30.0
    assert float(x[0, k, 5].abs()) < 0.03 * float(x[0, :, 5].abs().max())


def test_update_steadiness_equals_calculation_by_hand() -> None:
    given = {"window": 1.0, "tolerance": 0.1, "dt": 0.5}
    numbers = {name: torch.tensor([value]) for name, value in given.items()}
    memory = initial_steadiness(torch.tensor([0.0]))
    seen = []
    for _ in range(6):
        memory = update_steadiness(torch.tensor([1.0]), numbers, memory)
        seen.append((round(float(memory[0, 0]), 4), bool(is_steady(numbers, memory))))
    # the mean halves its distance each step: within 0.1 from the third on, for a window of two
    # steps
    assert [mean for mean, _ in seen] == [0.5, 0.75, 0.875, 0.9375, 0.9688, 0.9844]
    assert [steady for _, steady in seen] == [False] * 4 + [True] * 2
    assert not bool(is_steady(numbers, reset_steady_time(memory, torch.tensor([True]))))


def test_spiral_of_a_linear_vessel_has_no_loop() -> None:
    """Steady r = K (delta - offset) at every angle, up and down alike."""
    spiral = Spiral(
        drive=1,
        rudders=tuple(a * DEG for a in (20, 5, 0, -5, -20, -5, 0, 5)),
        start=1,
        steady=SteadyConfig(window=5, tolerance=0.002),
    )
    t = times(4000)
    x, w, stopped, _ = flown(
        Spiral.build_source([spiral], HELM, t), 1, 4000, Nomoto(offset=2 * DEG)
    )
    assert int(stopped) > 0
    end = int(stopped) + 1
    channels = {name: x[0, :end, i].numpy() for i, name in enumerate(STATE)}
    channels |= {name: w[0, :end, i].numpy() for i, name in enumerate(HELM.inputs)}
    found = spiral.compute_indices(Log("made", t[:end].numpy(), channels))
    assert found["yaw_rates"] == pytest.approx(
        [0.4 * (a - 2) * DEG for a in (20, 5, 0, -5, -20, -5, 0, 5)], abs=0.01 * 0.4 * 22 * DEG
    )
    assert found["loop_height"] < 0.01 * 0.4 * 22 * DEG


@pytest.mark.parametrize("kind", [MultiSine, RandomSteps])
def test_multi_sine_and_random_steps_keep_band_and_amplitude(kind: Any) -> None:
    dt, t = 0.1, times(40000)
    wave = kind(
        drive=0.5, drive_amplitude=0.2, steer_amplitude=0.6, band=(0.02, 0.2), seed=3, start=10.0
    )
    drive, steer = (demand.numpy() for demand in wave.demands_at(t))
    assert (drive[t < 9.99] == 0.5).all()
    assert (steer[t < 9.99] == 0).all()
    assert 0.18 < np.abs(drive - 0.5).max() <= 0.2 + 1e-12
    assert 0.55 < np.abs(steer).max() <= 0.6 + 1e-12
    for demand in (drive - drive.mean(), steer):
        power = np.abs(np.fft.rfft(demand * np.hanning(t.numel()))) ** 2
        frequency = np.fft.rfftfreq(t.numel(), dt)
        inside = power[(frequency > 0.018) & (frequency < 0.22)].sum() / power.sum()
        # steps have harmonics and a level of their own besides
        assert inside > (0.99 if kind is MultiSine else 0.5)
    assert abs(np.corrcoef(drive[200:], steer[200:])[0, 1]) < 0.1
    other, _ = wave.model_copy(update={"seed": 4}).demands_at(t)
    assert not np.array_equal(other.numpy(), drive)
    # a demand does not depend on how long it is asked for
    for short, long in zip(wave.demands_at(t[:300]), (drive, steer), strict=True):
        np.testing.assert_array_equal(short, long[:300])
    if kind is RandomSteps:
        # held for half periods of the band
        holds = np.diff(np.flatnonzero(np.diff(steer) != 0)) * dt
        assert holds.min() >= 0.5 / 0.2 - dt - 1e-3
        assert holds.max() <= 0.5 / 0.02 + dt + 1e-3


def test_manoeuvres_refuse_impossible_rudder_angles_and_vessels() -> None:
    circle = TurningCircle(drive=1, rudder=-15 * DEG)
    assert circle.steer_share(HELM) == pytest.approx(-0.5)
    assert circle.side == -1
    with pytest.raises(UsageError, match="is 30 deg"):
        TurningCircle(drive=1, rudder=31 * DEG).steer_share(HELM)
    gains = (1.0, 1.0, 1.0)
    control = MotionPIDConfig(proportional=gains, integral=gains, derivative=gains)
    with pytest.raises(UsageError, match="all three"):
        FourCorner.build_source([FourCorner(control=control)], HELM, times(2))


@pytest.mark.long
@pytest.mark.parametrize("vessel", ["milliampere", "milliampere_azimuth"])
def test_four_corner_course_of_the_ferry(vessel: str) -> None:
    """Gains from the ferry's own mass; it keeps near the filtered poses and comes back to where it
    began.
    """
    plant: Any = load_vessel(vessel).build()
    mass = plant.hull.mass.diagonal()
    omega = torch.tensor([0.26, 0.26, 0.4], dtype=torch.float64)
    proportional, integral, derivative = (
        tuple(part.tolist()) for part in (mass * omega**2, 0.1 * mass * omega**3, 2 * mass * omega)
    )
    control = MotionPIDConfig(proportional=proportional, integral=integral, derivative=derivative)
    course = FourCorner(control=control)
    assert course.duration_within(10.0) == 720.0
    model = RecordedPlantDynamics(plant, 0.2, 2)
    helm = Helm.from_plant(plant)
    craft = SimulatedVessel(vessel, model, helm, plant.n_commands, plant.make_initial_state(1))
    (flight,) = simulate_manoeuvres(
        craft, [course], TrialEnvironment(plant, DisturbanceConfig(), SensorsConfig(), 0), 10.0, 0.2
    )
    motion = flight.true_log
    assert len(motion) == 3600
    found = course.compute_indices(motion)
    assert found["mean_position_error"] < 1.0
    assert found["mean_heading_error"] < 5 * DEG
    # each segment ends near its pose, the ninth's turn goes the long way round as it is written
    for i, (north, east, heading) in enumerate(FOUR_CORNER_POSES):
        k = (i + 1) * 300 - 1
        assert math.hypot(motion["x"][k] - north, motion["y"][k] - east) < 1.5
        assert motion["psi"][k] == pytest.approx(heading, abs=8 * DEG)
