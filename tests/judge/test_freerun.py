"""Free runs: what a window starts from, what it is given, what is stored where it diverges; poses
from velocities.
"""

from __future__ import annotations

import numpy as np
import pytest
import torch
from made_logs import made, prepared, random_states
from torch import Tensor

from residnet.baselines.given import StillConfig
from residnet.baselines.regressors import RegressorBaseline
from residnet.core.log import Log
from residnet.dynamics.base import Integrator
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.rollout import Rollout
from residnet.dynamics.simulated import PlantDynamics
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.heads.lstm import LstmConfig
from residnet.judge import freerun
from residnet.judge.freerun import Candidate, free_run, integrate
from residnet.judge.protocol import Window
from residnet.physics.signals import SignalsConfig
from residnet.physics.vessel import load_vessel

STEP = 0.1
LIMIT = np.array([1e6, 1e6, 1e6])
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


def test_free_run_of_a_linear_model_in_closed_form() -> None:
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
    run = free_run([Candidate("m", "baseline", hybrid(theta))], windows, logs, STEP, LIMIT)
    for w, p in zip(windows, run["m"], strict=True):
        t = STEP * np.arange(w.stop - w.start)
        assert not p.diverged
        np.testing.assert_allclose(p.states[:, 3], 2 + (w.nu[0] - 2) * np.exp(-t), atol=1e-6)
        np.testing.assert_allclose(p.states[:, 4:], np.tile(w.nu[1:], (len(t), 1)), atol=1e-12)
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
    log = made(np.zeros((50, 6)), STEP, w=w)
    (p,) = free_run(
        [Candidate("m", "baseline", hybrid(theta))], [window(0, 7, 30)], [log], STEP, LIMIT
    )["m"]
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
    limit = np.full(3, 0.1 * fast)
    found = free_run([Candidate("m", "head", hybrid(theta))], windows, [log], STEP, limit)["m"]
    assert [p.diverged for p in found] == [False, True]


def test_divergence_is_judged_within_the_window_only() -> None:
    """A short window shares its batch with a long one; what happens after its own end is not its
    business.
    """
    theta = np.zeros((3, 6))
    theta[0, 0] = 1.0
    log = made(random_states(80, np.random.default_rng(4)), STEP)
    run = free_run(
        [Candidate("m", "head", hybrid(theta))],
        [window(0, 0, 20), window(0, 0, 80)],
        [log],
        STEP,
        np.array([10.0, 10.0, 10.0]),
    )
    assert [p.diverged for p in run["m"]] == [False, True]
    assert run["m"][0].states[-1, 3] == pytest.approx(np.exp(1.9), rel=1e-5)


def test_a_memory_is_warmed_up_by_the_measured_past() -> None:
    torch.manual_seed(0)
    head = LstmConfig(hidden_size=6).build(SIGNALS.build().names)
    model = hybrid(np.zeros((3, 6)), head).double()
    rng = np.random.default_rng(5)
    log = made(0.3 * random_states(60, rng), STEP, w=rng.normal(size=(60, 2)))
    windows = [window(0, 20, 40, past=5), window(0, 30, 50, past=15)]
    run = free_run([Candidate("m", "head", model)], windows, [log], STEP, LIMIT)["m"]
    for w, p in zip(windows, run, strict=True):
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


def test_a_window_does_not_depend_on_its_neighbours() -> None:
    """Windows with pasts of different length, alone and in one batch."""
    torch.manual_seed(1)
    model = hybrid(
        np.zeros((3, 6)), LstmConfig(hidden_size=6).build(SIGNALS.build().names)
    ).double()
    rng = np.random.default_rng(6)
    log = made(0.3 * random_states(60, rng), STEP, w=rng.normal(size=(60, 2)))
    windows = [window(0, 20, 40, past=5), window(0, 8, 25, past=6), window(0, 0, 10, past=0)]
    together = free_run([Candidate("m", "head", model)], windows, [log], STEP, LIMIT)["m"]
    for w, p in zip(windows, together, strict=True):
        (alone,) = free_run([Candidate("m", "head", model)], [w], [log], STEP, LIMIT)["m"]
        np.testing.assert_allclose(p.states, alone.states, rtol=1e-9, atol=1e-9)


def test_single_precision_is_close() -> None:
    theta = np.zeros((3, 6))
    theta[0, 0], theta[0, 5] = -1.0, 2.0
    log = made(random_states(60, np.random.default_rng(7)), STEP)
    one = free_run([Candidate("m", "head", hybrid(theta))], [window(0, 0, 60)], [log], STEP, LIMIT)[
        "m"
    ][0]
    two = free_run(
        [Candidate("m", "head", hybrid(theta))],
        [window(0, 0, 60)],
        [log],
        STEP,
        LIMIT,
        dtype=torch.float32,
    )["m"][0]
    np.testing.assert_allclose(two.states, one.states, atol=1e-5)


def test_the_plant_itself_predicts_its_own_noise_free_trial() -> None:
    """The candidate `truth`: actuator states from the log, commands as inputs, no more known."""
    plant = load_vessel("wam_v_cal").build()
    model = PlantDynamics(plant, STEP, 2)
    count = 80
    w = torch.zeros(1, count, len(plant.inputs), dtype=torch.float64)
    w[0, :, 0] = 20 + 10 * torch.sin(torch.arange(count) * 0.1)
    w[0, :, 1] = 15.0
    x = torch.zeros(1, 8, dtype=torch.float64)
    states: list[Tensor] = []
    with torch.no_grad():
        for k in range(count):
            states.append(x[0])
            x, _ = model.step(x, w[:, k], x[:, :0])
    truth = torch.stack(states).numpy()
    channels = dict(zip(plant.state, truth.T, strict=True)) | {
        "cmd_port": w[0, :, 0].numpy(),
        "cmd_stbd": w[0, :, 1].numpy(),
    }
    log = Log("trial", STEP * np.arange(count), channels)
    good = np.ones(count, dtype=bool)
    trial = prepared(log, truth[:, :6], np.zeros((count, 2)), good, np.zeros(count, dtype=int))
    candidate = Candidate(
        "truth", "truth", model, plant.state, plant.inputs[:2], len(plant.inputs) - 2
    )
    windows = [window(0, s, s + 30, nu=tuple(truth[s, 3:6])) for s in (0, 25, 50)]
    for w_, p in zip(
        windows, free_run([candidate], windows, [trial], STEP, LIMIT)["truth"], strict=True
    ):
        np.testing.assert_allclose(p.states[:, 3:], truth[w_.start : w_.stop, 3:6], atol=1e-12)
        np.testing.assert_allclose(p.states[:, :3], truth[w_.start : w_.stop, :3], atol=2e-3)


def test_a_vessel_that_rolls_starts_from_the_logs_roll_too() -> None:
    """The truth of a 4-DOF vessel, whose state has phi and p among x, y, psi, u, v, r: its free run
    is the log itself.
    """
    plant = load_vessel("patrol_p06").build()
    model = PlantDynamics(plant, STEP, 2)
    count = 200
    w = torch.zeros(1, count, len(plant.inputs), dtype=torch.float64)
    w[0, :, 0] = 0.1 * torch.sign(torch.sin(torch.arange(count) * 0.05))
    w[0, :, 1] = 1e5
    x, states = plant.approach(1), []
    with torch.no_grad():
        for k in range(count):
            states.append(x[0])
            x, _ = model.step(x, w[:, k], x[:, :0])
    truth = torch.stack(states).numpy()
    channels = dict(zip(plant.state, truth.T, strict=True)) | {
        name: w[0, :, i].numpy() for i, name in enumerate(plant.inputs[:2])
    }
    log = Log("trial", STEP * np.arange(count), channels)
    motion = log.stack(("x", "y", "psi", "u", "v", "r"))
    trial = prepared(
        log, motion, np.zeros((count, 2)), np.ones(count, dtype=bool), np.zeros(count, dtype=int)
    )
    candidate = Candidate(
        "truth", "truth", model, plant.state, plant.inputs[:2], len(plant.inputs) - 2
    )
    windows = [window(0, s, s + 60, nu=tuple(motion[s, 3:])) for s in (0, 70, 130)]
    for w_, p in zip(
        windows, free_run([candidate], windows, [trial], STEP, LIMIT)["truth"], strict=True
    ):
        np.testing.assert_allclose(p.states[:, 3:], motion[w_.start : w_.stop, 3:], atol=1e-12)
    assert np.abs(log["phi"]).max() > 0.01


def test_windows_run_together_as_they_run_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Long windows, short ones and little memory: batches differ, predictions do not."""
    random = np.random.default_rng(4)
    theta = np.concatenate((-np.eye(3), 0.1 * random.normal(size=(3, 3))), axis=1)
    ready = [
        made(random_states(300, np.random.default_rng(i)), STEP, name=str(i)) for i in range(2)
    ]
    lengths = (2, 3, 290, 40, 12, 11, 150, 60)
    windows = [window(i % 2, i, i + length) for i, length in enumerate(lengths)]
    model = hybrid(theta)
    candidate = Candidate("m", "baseline", model)

    def states(together: list[Window]) -> list[np.ndarray]:
        found = free_run([candidate], together, ready, STEP, LIMIT)["m"]
        return [prediction.states for prediction in found]

    alone = [states([one])[0] for one in windows]
    for largest in (30_000_000, 1_000):
        monkeypatch.setattr(freerun, "_LARGEST", largest)
        for one, other, length in zip(states(windows), alone, lengths, strict=True):
            assert one.shape == (length, 6)
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
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
