"""Free runs: what a window starts from, what it is given, what is stored where it diverges; poses
from velocities.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_logs import made, prepared, random_states

from residnet.baselines.given import StillConfig
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.log import Log
from residnet.data.prepare import Prepared
from residnet.dynamics.base import Dynamics, Integrator
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.heads.lstm import LstmConfig
from residnet.judge import freerun
from residnet.judge.freerun import Candidate, Prediction, free_run, integrate
from residnet.judge.protocol import Window
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel

STEP = 0.1
SIGNALS = SignalsConfig(inputs=("tau_x", "tau_n"))


def window(
    log: int,
    start: int,
    stop: int,
    past: int | None = None,
    nu: tuple[float, float, float] = (1.0, 0.0, 0.0),
) -> Window:
    return Window(log, start, stop, start if past is None else past, np.array(nu))


def hybrid(theta: np.ndarray, head: ResidualHead | None = None) -> HybridDynamics:
    """nu_dot = theta (u, v, r, tau_x, tau_n, 1)."""
    signals = SIGNALS.build()
    baseline = RegressorBaseline([("u", "v", "r", "tau_x", "tau_n", "1")] * 3, signals.names)
    baseline.theta.data.copy_(torch.from_numpy(theta))
    return HybridDynamics(signals, baseline, head or ZeroHead(), STEP)


def ran(
    model: Dynamics,
    windows: list[Window],
    logs: list[Prepared],
    limit: float = 1e6,
    dtype: torch.dtype = torch.float64,
) -> list[Prediction]:
    limits = np.full(3, limit)
    return free_run([Candidate("m", "head", model)], windows, logs, STEP, limits, dtype)["m"]


@pytest.mark.parametrize("rate", [0.05, -0.2])
def test_integrate_gives_a_circle(rate: float) -> None:
    """Constant u, v, r: a circle of radius U / |r|; the trapezoidal rule on the chord is off by (r
    dt)^2 / 12 of the arc only.
    """
    count, u, v = 400, 2.0, 0.3
    nu = np.tile([u, v, rate], (count, 1))
    pose = integrate(np.array([5.0, -3.0, 0.4]), nu, STEP)
    t = STEP * np.arange(count)
    psi = 0.4 + rate * t
    north = 5 + (u * (np.sin(psi) - np.sin(0.4)) + v * (np.cos(psi) - np.cos(0.4))) / rate
    east = -3 + (-u * (np.cos(psi) - np.cos(0.4)) + v * (np.sin(psi) - np.sin(0.4))) / rate
    np.testing.assert_allclose(pose[:, 2], psi, atol=1e-12)
    allowed = (rate * STEP) ** 2 / 12 * np.hypot(u, v) * t[-1] + 1e-12
    assert np.hypot(pose[:, 0] - north, pose[:, 1] - east).max() <= allowed


def test_integrate_straight_and_accelerating() -> None:
    t = STEP * np.arange(50)
    nu = np.stack((0.5 * t, 0 * t, 0 * t), axis=1)
    pose = integrate(np.array([0.0, 0.0, np.pi / 2]), nu, STEP)
    np.testing.assert_allclose(
        pose, np.stack((0 * t, 0.25 * t**2, np.full_like(t, np.pi / 2)), axis=1), atol=1e-12
    )
    assert integrate(np.array([1.0, 2.0, 3.0]), np.ones((1, 3)), STEP).tolist() == [[1.0, 2.0, 3.0]]


@pytest.mark.parametrize(("dtype", "near"), [(torch.float64, 1e-6), (torch.float32, 1e-5)])
def test_free_run_of_a_linear_model_in_closed_form(dtype: torch.dtype, near: float) -> None:
    """u' = -u + 2, measured velocities never looked at after the start; windows of different
    lengths in one batch.
    """
    theta = np.zeros((3, 6))
    theta[0, 0], theta[0, 5] = -1.0, 2.0
    logs = [made(random_states(60, np.random.default_rng(i)), STEP, name=str(i)) for i in range(2)]
    windows = [
        window(0, 3, 34, nu=(0.5, 0.1, 0.0)),
        window(1, 10, 15, nu=(4.0, 0.0, 0.2)),
        window(0, 20, 60),
    ]
    for w, p in zip(windows, ran(hybrid(theta), windows, logs, dtype=dtype), strict=True):
        t = STEP * np.arange(w.stop - w.start)
        assert not p.diverged
        np.testing.assert_allclose(p.states[:, 3], 2 + (w.nu[0] - 2) * np.exp(-t), atol=near)
        np.testing.assert_allclose(p.states[:, 4:], np.tile(w.nu[1:], (len(t), 1)), atol=near)
        np.testing.assert_array_equal(p.states[0, :3], logs[w.log].y[w.start, :3])
        np.testing.assert_allclose(
            p.states[:, :3], integrate(logs[w.log].y[w.start, :3], p.states[:, 3:], STEP)
        )


def test_inputs_are_held_from_their_own_sample() -> None:
    """u' = tau_x: the prediction is the running sum of the inputs from the window's start to the
    sample before.
    """
    theta = np.zeros((3, 6))
    theta[0, 3] = 1.0
    w = np.random.default_rng(0).normal(size=(50, 2))
    (p,) = ran(hybrid(theta), [window(0, 7, 30)], [made(np.zeros((50, 6)), STEP, w=w)])
    expected = 1.0 + STEP * np.concatenate(([0.0], np.cumsum(w[7:29, 0])))
    np.testing.assert_allclose(p.states[:, 3], expected, atol=1e-12)


def zero() -> HybridDynamics:
    signals = SIGNALS.build()
    return HybridDynamics(signals, StillConfig().build(signals.names), ZeroHead(), STEP)


@pytest.mark.parametrize(("growth", "limit"), [(1.0, 50.0), (800.0, 1e300), (3.0, 1e3)])
def test_a_diverged_window_holds_the_prediction_of_zero(growth: float, limit: float) -> None:
    theta = np.zeros((3, 6))
    theta[0, 0] = growth
    logs = [made(random_states(80, np.random.default_rng(3)), STEP)]
    windows = [window(0, 0, 80, nu=(1.0, 0.2, -0.05)), window(0, 10, 40, nu=(0.0, 0.3, 0.1))]
    runs = free_run(
        [Candidate("m", "head", hybrid(theta)), Candidate("zero", "zero", zero())],
        windows,
        logs,
        STEP,
        np.full(3, limit),
    )
    assert [p.diverged for p in runs["m"]] == [True, False]
    assert [p.diverged for p in runs["zero"]] == [False, False]
    for p, z in zip(runs["m"], runs["zero"], strict=True):
        # the second starts at rest, where growth has nothing to work on: it equals zero without
        # diverging
        np.testing.assert_allclose(p.states, z.states, atol=1e-12)
        assert np.isfinite(p.states).all()


def test_a_window_beyond_short_training_logs_is_no_divergence() -> None:
    """A vessel that does more than it did in training exceeds the limit itself, and so does `zero`
    that holds its velocities.
    """
    log = made(random_states(80, np.random.default_rng(3)), STEP)
    fast = float(np.abs(log.y[:, 3]).max())
    theta = np.zeros((3, 6))
    windows = [window(0, 0, 80, nu=(fast, 0.0, 0.0)), window(0, 0, 80, nu=(2.1 * fast, 0.0, 0.0))]
    found = ran(hybrid(theta), windows, [log], 0.1 * fast)
    assert [p.diverged for p in found] == [False, True]


def test_divergence_is_judged_within_the_window_only() -> None:
    """A short window shares its batch with a long one; what happens after its own end is not its
    business.
    """
    theta = np.zeros((3, 6))
    theta[0, 0] = 1.0
    log = made(random_states(80, np.random.default_rng(4)), STEP)
    short, long = ran(hybrid(theta), [window(0, 0, 20), window(0, 0, 80)], [log], 10.0)
    assert (short.diverged, long.diverged) == (False, True)
    assert short.states[-1, 3] == pytest.approx(np.exp(1.9), rel=1e-5)


def test_a_memory_is_warmed_up_by_the_measured_past() -> None:
    torch.manual_seed(0)
    head = LstmConfig(hidden_size=6).build(SIGNALS.build().names)
    model = hybrid(np.zeros((3, 6)), head).double()
    rng = np.random.default_rng(5)
    log = made(0.3 * random_states(60, rng), STEP, w=rng.normal(size=(60, 2)))
    windows = [window(0, 20, 40, past=5), window(0, 30, 50, past=15)]
    for w, p in zip(windows, ran(model, windows, [log]), strict=True):
        s = model.warmup(
            torch.from_numpy(log.y[None, w.past : w.start]),
            torch.from_numpy(log.w[None, w.past : w.start]),
        )
        x = torch.from_numpy(np.concatenate((log.y[w.start, :3], w.nu)))[None]
        with torch.no_grad():
            for k in range(w.start, w.stop):
                np.testing.assert_allclose(
                    p.states[k - w.start, 3:], x[0, 3:], rtol=1e-9, atol=1e-12
                )
                x, s = model.step(x, torch.from_numpy(log.w[None, k]), s)


@pytest.mark.parametrize(("vessel", "start"), [("wam_v_cal", 0.0), ("patrol_p06", 7.0)])
def test_the_plant_itself_predicts_its_own_noise_free_trial(vessel: str, start: float) -> None:
    """The candidate `truth`: what the measured state lacks (actuators, phi and p of a vessel that
    rolls) from the log, commands as inputs, no more known.
    """
    plant, count = load_vessel(vessel).build(), 200
    model = PlantDynamics(plant, STEP, 2)
    w = torch.zeros(1, count, len(plant.inputs), dtype=torch.float64)
    swing = torch.sin(torch.arange(count) * 0.1)
    w[0, :, 0] = 0.1 * torch.sign(swing) if start else 20 + 10 * swing
    w[0, :, 1] = 1e5 if start else 15.0
    x, states = plant.approach(1) if start else torch.zeros(1, 8, dtype=torch.float64), []
    with torch.no_grad():
        for k in range(count):
            states.append(x[0])
            x, _ = model.step(x, w[:, k], x[:, :0])
    channels = dict(zip(plant.state, torch.stack(states).numpy().T, strict=True))
    channels |= {name: w[0, :, i].numpy() for i, name in enumerate(plant.inputs[:2])}
    log = Log("trial", STEP * np.arange(count), channels)
    motion, whole = log.stack(("x", "y", "psi", "u", "v", "r")), np.ones(count, dtype=bool)
    trial = prepared(log, motion, np.zeros((count, 2)), whole, np.zeros(count, dtype=int))
    truth = Candidate("truth", "truth", model, plant.state, plant.inputs[:2], len(plant.inputs) - 2)
    windows = [window(0, s, s + 60, nu=tuple(motion[s, 3:])) for s in (0, 70, 130)]
    found = free_run([truth], windows, [trial], STEP, np.full(3, 1e6))["truth"]
    for one, p in zip(windows, found, strict=True):
        seen = motion[one.start : one.stop]
        np.testing.assert_allclose(p.states[:, 3:], seen[:, 3:], atol=1e-12)
        np.testing.assert_allclose(p.states[:, :3], seen[:, :3], atol=2e-3 * max(start, 1.0))
    assert not start or np.abs(log["phi"]).max() > 0.01


@pytest.mark.parametrize("remembers", [False, True])
def test_windows_run_together_as_they_run_alone(
    remembers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Long windows, short ones, pasts of any length and little memory: batches differ, predictions
    do not.
    """
    random = np.random.default_rng(4)
    theta = np.concatenate((-np.eye(3), 0.1 * random.normal(size=(3, 3))), axis=1)
    torch.manual_seed(1)
    head = LstmConfig(hidden_size=6).build(SIGNALS.build().names) if remembers else None
    model = hybrid(theta, head).double()
    ready = [
        made(0.3 * random_states(300, random), STEP, w=random.normal(size=(300, 2)), name=str(i))
        for i in range(2)
    ]
    lengths = (2, 3, 290, 40, 12, 11, 150, 60)
    windows = [window(i % 2, i, i + length, past=max(i - 3, 0)) for i, length in enumerate(lengths)]
    alone = [ran(model, [one], ready)[0].states for one in windows]
    for largest in (30_000_000, 1_000):
        monkeypatch.setattr(freerun, "_LARGEST", largest)
        for one, other, length in zip(ran(model, windows, ready), alone, lengths, strict=True):
            assert one.states.shape == (length, 6)
            np.testing.assert_allclose(one.states, other, rtol=1e-9, atol=1e-9)
    assert model.positions, "the judged model itself is left as it is"


@pytest.mark.parametrize("integrator", ["rk4", "semi_implicit_euler"])
def test_velocities_and_heading_do_without_positions(integrator: Integrator) -> None:
    random = np.random.default_rng(5)
    model = hybrid(np.concatenate((-np.eye(3), 0.1 * random.normal(size=(3, 3))), axis=1))
    model = HybridDynamics(model.signals, model.baseline, model.head, STEP, integrator)
    x0, w = (
        torch.from_numpy(random.normal(size=(4, 6))),
        torch.from_numpy(random.normal(size=(4, 30, 2))),
    )
    with torch.no_grad():
        whole = Rollout(model)(x0, w, x0[:, :0])[0]
        model.positions = False
        part = Rollout(model)(x0, w, x0[:, :0])[0]
    torch.testing.assert_close(part[..., 2:], whole[..., 2:], rtol=0, atol=1e-13)
    assert torch.equal(part[..., :2], x0[:, None, :2].expand(-1, 31, -1))
