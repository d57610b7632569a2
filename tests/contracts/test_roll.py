"""The contracts of every head, baseline and format where the models roll."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
import torch

from residnet.baselines.regressors import RegressorsConfig
from residnet.control.heading.vessels import SteeredModel, SteeredPlant
from residnet.core.layout import ROLL, Live, levelled
from residnet.core.log import Log
from residnet.data.doctor import inspect
from residnet.data.simulated import Craft, Disturbance, Sea, SensorNoise, fly
from residnet.dynamics.actuated import ActuatedDynamics, PlantActuators
from residnet.dynamics.base import Integrator
from residnet.dynamics.rollout import Rollout, scripted
from residnet.dynamics.store import save_model
from residnet.heads.linear import RidgeConfig
from residnet.heads.recurrent import RecurrentConfig
from residnet.identification.changes import Change, ChangedDynamics
from residnet.identification.monitoring import MonitorConfig, Piece, Watch, Watcher
from residnet.identification.recipe import Preparation
from residnet.judge.freerun import integrate
from residnet.manoeuvres.base import Helm
from residnet.manoeuvres.open_loop import ConstantInput
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel
from residnet.simulators.ardupilot import ArduPilotBackEnd, servos
from residnet.simulators.vehicle import vehicle
from residnet.testing import example_samples
from residnet.testing.checks import ROLLING, SUBMERGED, example_model, example_spec

PHI, P = ROLL.names.index("phi"), ROLL.names.index("p")


def test_an_angle_has_no_equation_of_its_own_and_restores() -> None:
    samples = example_samples(signals=ROLLING)
    config = RegressorsConfig(bounded=True, dissipative=True)
    baseline = config.build(samples.names)
    table = config.fit(baseline, samples)
    assert {entry.axis for entry in table} == {"u_dot", "v_dot", "r_dot", "p_dot"}
    assert not samples.target[:, ROLL.moving.index("phi")].any()
    roll = {entry.term: entry.value for entry in table if entry.axis == "p_dot"}
    # 2 pi over the natural period of 6.76 s of document 004, Table 5.2
    assert (-roll["phi"]) ** 0.5 == pytest.approx(2 * np.pi / 6.76, rel=0.1)
    assert roll["p"] < 0.0


@pytest.mark.parametrize("integrator", get_args(Integrator))
@pytest.mark.parametrize("head", [RidgeConfig(), RecurrentConfig(hidden_size=6)])
def test_the_roll_angle_moves_by_the_roll_rate(integrator: Integrator, head: Any) -> None:
    spec = example_spec(head, ROLLING).model_copy(update={"integrator": integrator})
    model = example_model(spec).double()
    x = torch.zeros(2, len(ROLL.names), dtype=torch.float64)
    x[:, 3:] = torch.tensor(np.array(spec.low[:5]) * 0.3 + np.array(spec.high[:5]) * 0.7)
    w = torch.tensor(np.array(spec.low[5:]) * 0.4 + np.array(spec.high[5:]) * 0.6).expand(2, 60, 2)
    s = model.initial_state(2).double()
    states = scripted(Rollout(model), 10_000)(x, w, s)[0]
    alone, after = [x], x
    for k in range(60):
        after, s = model.step(after, w[:, k], s)
        alone.append(after)
    torch.testing.assert_close(states, torch.stack(alone, dim=1), rtol=0, atol=1e-9)
    moved = states[0].detach().numpy()
    rate = np.diff(moved[:, PHI]) / spec.dt
    ends = moved[:-1, P], moved[1:, P]
    # the angle's rate lies between the velocities at both ends of a step
    apart = np.abs(ends[1] - ends[0]).max() + 1e-9
    assert np.abs(rate - 0.5 * (ends[0] + ends[1])).max() <= 0.51 * apart
    assert np.ptp(moved[:, PHI]) > 0.01
    pose = integrate(moved[0, :3], moved[:, 3:], spec.dt)
    np.testing.assert_allclose(moved[:, :3], pose, atol=0.05 * np.ptp(moved[:, 0]))


def test_the_pose_moves_with_the_roll() -> None:
    nu = np.array([[1.0, 0.5, 0.2, 0.0, 1.0]])
    level = np.cos(1.0)
    np.testing.assert_allclose(levelled(nu), [[1.0, 0.5 * level, 0.2 * level]])
    assert levelled(nu[:, :3]) is not nu
    np.testing.assert_array_equal(levelled(nu[:, :3]), nu[:, :3])


def test_what_logs_tell() -> None:
    def told(*names: str, moving: bool = True) -> Live:
        return Live.told({name: moving * np.arange(99.0) for name in names})

    assert told("x", "y", "psi", "phi").velocities == ("u", "v", "r", "p")
    assert told("x", "y", "psi", "p").planar
    assert told("x", "y", "psi", "phi", "p", moving=False).planar
    motion, noise = 0.1 * np.sin(np.arange(0.0, 60.0, 0.1)), np.random.default_rng(0)
    for size, moves in ((0.05, True), (0.2, False)):
        phi = motion + size * noise.normal(size=motion.size)
        assert Live.told({"u": motion, "phi": phi}).rolls == moves
    rolls, planar = told("u", "r", "phi", "p"), Live()
    assert rolls.dead == ("v",)
    assert rolls.channels == ("u", "r", "p", "phi")
    assert Live.shared([rolls, planar]).velocities == ("u", "r")
    assert Live.shared([Live(("u",)), Live(("r",))]).planar


def test_a_draft_sets_the_rates_of_a_roll_beside_means() -> None:
    t = np.arange(0.0, 60.0, 0.1)
    log = Log("swing", t, dict.fromkeys(("u", "v", "r", "p", "phi", "delta"), np.sin(t)))
    for live, beside in ((Live(("u", "v", "r", "p")), "means"), (Live(), None)):
        drafted = Preparation.of([log], ["delta"], live).content()
        assert drafted.get("beside") == beside


@pytest.mark.parametrize(
    ("signals", "names"),
    [
        (ROLLING, ("restoring", "damping roll")),
        pytest.param(SUBMERGED, ("restoring pitch", "damping pitch"), marks=pytest.mark.long),
    ],
    ids=["roll", "six"],
)
def test_a_monitor_tells_stiffness_from_damping(
    signals: SignalsConfig, names: tuple[str, ...]
) -> None:
    spec, live = example_spec(None, signals), signals.live
    model = example_model(spec).double()
    noise = np.full(len(live.states), 0.003)
    noise[:5] = 0.0, 0.0, 0.002, 0.02, 0.02
    low, high = (np.array(ends[live.size :]) for ends in (spec.low, spec.high))

    def logs(change: Change, count: int, seed: int) -> list[list[Piece]]:
        random = np.random.default_rng(seed)
        w = random.uniform(low, high, size=(count, 6, low.size)).repeat(50, axis=1)
        x = torch.zeros(count, noise.size).double()
        x[:, 3] = 0.7 * spec.high[0]
        changed = ChangedDynamics(model, [change], count, low.size)
        with torch.no_grad():
            states = Rollout(changed)(x, torch.from_numpy(w), x[:, :0])[0].numpy()
        y = states + noise * random.normal(size=states.shape)
        return [
            [Piece(a[k : k + 101], b[k : k + 100], a[:0], b[:0]) for k in (0, 100, 200)]
            for a, b in zip(y, w, strict=True)
        ]

    watch = Watch(spec, model, logs(Change("none", "", "", 1.0), 30, 0), MonitorConfig())
    assert list(watch.seen) == [*live.channels, "heading"]
    for cause in names:
        watcher = Watcher(watch)
        (known,) = (one for one in watch.causes if one.name == cause)
        for log in logs(replace(known, size=-0.3), 5, 1):
            watcher.restart()
            for sums in watch.sums(log):
                verdict = watcher.take(sums)
        first = verdict.suspects[0]
        assert verdict.alarm
        assert first.change.name == cause
        assert first.size == pytest.approx(-0.3, rel=0.3)


def test_a_model_that_rolls_flies_behind_the_gear_of_its_vessel() -> None:
    spec, plant = example_spec(RidgeConfig(), ROLLING), load_vessel("patrol_p06_linear").build()
    model, columns = example_model(spec).double(), spec.signals.columns
    gear = PlantActuators(plant, spec.dt)
    flown = ActuatedDynamics(model, columns, "start", gear)
    helm = Helm(gear.demand, flown.state, gear.inputs)
    craft = Craft("own", flown, helm, gear.commands, flown.approach(1))
    turn = ConstantInput(drive=0.8, steer=0.5, duration=12.0)
    log = fly(craft, [turn], Sea(None, Disturbance(), SensorNoise(), 0), 12.0, spec.dt)[0].motion
    x, w = flown.approach(1)[:, : len(ROLL.names)], torch.from_numpy(log.stack(columns))[None]
    with torch.no_grad():
        alone = Rollout(model)(x, w[:, :-1], model.initial_state(1).double())[0][0].numpy()
    np.testing.assert_allclose(log.stack(ROLL.names), alone, atol=1e-9)
    assert np.ptp(log["phi"]) > 0.01
    # a heading controller sees the same steps
    steered = SteeredModel(model, columns, "start", SteeredPlant(plant))
    straight, held = steered.start(torch.ones(1).double())
    memory = steered.memory(torch.tensor([[1.0, 1.0, 0.0]]).double())
    with torch.no_grad():
        moved = steered.model(spec.dt).step(straight, held, memory)[0]
        wanted = model.step(straight[:, :8], held[:, :2], model.initial_state(1).double())[0]
    assert steered.state[:8] == ROLL.names
    torch.testing.assert_close(moved[:, :8], wanted)


def test_a_simulator_shows_the_roll(tmp_path: Path) -> None:
    spec = example_spec(RidgeConfig(), ROLLING)
    save_model(tmp_path / "models" / "example", spec, example_model(spec))
    known = vehicle(tmp_path, model="example")
    assert known.states == ROLL.names
    assert known.low.tolist() == pytest.approx(spec.low[5:])
    back = ArduPilotBackEnd(known, servos(known), port=0)
    try:
        pulses = [1900, 1500, 1900, *[0] * 13]
        for frame in range(1, 200):
            said = json.loads(back.answer(struct.pack("<HHI16H", 18458, 50, frame, *pulses)) or b"")
    finally:
        back.close()
    phi, p = (float(back.after[0, place]) for place in (PHI, P))
    assert abs(phi) > 0.01
    assert said["attitude"][0] == pytest.approx(phi, abs=0.1 * abs(p) + 1e-6)
    assert said["imu"]["gyro"][0] == pytest.approx(p, abs=0.05)


@pytest.mark.parametrize("gain", [1.0, -1.0, 57.3])
def test_the_doctor_sets_the_roll_rate_against_the_roll_angle(gain: float) -> None:
    random, t = np.random.default_rng(2), np.arange(0.0, 120.0, 0.1)
    phi = 0.05 * np.sin(0.9 * t) + 0.001 * random.normal(size=t.size)
    p = gain * 0.05 * 0.9 * np.cos(0.9 * t) + 0.001 * random.normal(size=t.size)
    still = dict.fromkeys(("x", "y", "psi", "u", "v", "r"), 0.0 * t)
    log = Log("rolls", t, {**still, "phi": phi, "p": p}, {"phi": "rad", "p": "rad/s"})
    found = [one.text for one in inspect(log, []).findings if one.code == "roll_rate"]
    assert len(found) == (gain != 1.0)
    assert all(text.startswith(f"phi moves by {1.0 / gain:.2g} times") for text in found)
