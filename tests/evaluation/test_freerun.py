"""Free runs: which windows, what each starts from and is given, what stands where it diverges."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from made_logs import made, prepared, random_runs, random_states

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.dynamics.base import Dynamics
from residnet.dynamics.ensemble import MeanOfTrajectories
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.simulated import PlantDynamics
from residnet.evaluation import freerun
from residnet.evaluation.freerun import Candidate, Prediction, integrate_pose, run_free_runs
from residnet.evaluation.protocol import ManoeuvreProtocol, Window, WindowProtocol, make_windows
from residnet.heads.base import ResidualHead, ZeroHead
from residnet.heads.lstm_config import LstmConfig
from residnet.physics.signals_config import SignalsConfig
from residnet.physics.vessel import load_vessel
from residnet.preprocessing.prepare import PreparedLog

STEP = 0.1


def test_windows_are_the_first_that_fit_back_to_back() -> None:
    """The protocol of the data README, sample by sample: usable at its start, without a break."""
    rng = np.random.default_rng(1)
    found = 0
    for _ in range(200):
        count = int(rng.integers(1, 300))
        breaks = np.cumsum(rng.random(count) < 0.02)
        hole = random_runs(count, rng, mean=40.0) & (rng.random() < 0.5)
        piece = np.where(hole, -1, breaks + 1000 * np.cumsum(np.diff(hole, prepend=False)))
        usable = ~(random_runs(count, rng, mean=15.0) & (rng.random(count) < 0.7))
        log = made(random_states(count, rng), STEP, usable=usable, piece=piece)
        windows = WindowProtocol(length=2.0, first=0.5, history=1.0).make_windows(log, 7, STEP)
        expected = []
        start = 5
        while start + 20 < count:
            inside = piece[start : start + 21]
            if log.usable[start] and (inside == inside[0]).all():
                expected.append(start)
                start += 19
            start += 1
        assert [w.start for w in windows] == expected
        for w in windows:
            assert (w.log_index, w.stop) == (7, w.start + 21)
            np.testing.assert_array_equal(w.initial_velocities, log.y[w.start, 3:])
        found += len(windows)
    assert found > 200


def test_history_does_not_reach_across_a_break() -> None:
    """What warms up a memory must be an uninterrupted past."""
    piece = np.repeat([0, -1, 1], 100)
    log = made(np.zeros((300, 6)), STEP, piece=piece)
    windows = WindowProtocol(length=4.0, first=5.0, history=6.0).make_windows(log, 0, STEP)
    assert [(w.history_start, w.start) for w in windows] == [(0, 50), (200, 200), (200, 240)]
    touching = made(np.zeros((200, 6)), STEP, piece=np.repeat([0, 1], 100))
    windows = WindowProtocol(length=4.0, first=9.0, history=6.0).make_windows(touching, 0, STEP)
    assert [(w.history_start, w.start) for w in windows] == [(100, 100), (100, 140)]


def test_whole_manoeuvres() -> None:
    rng = np.random.default_rng(2)
    for _ in range(50):
        count = int(rng.integers(1, 400))
        piece = np.where(
            random_runs(count, rng, mean=60.0), np.cumsum(rng.random(count) < 0.01), -1
        )
        piece = np.where(piece >= 0, np.cumsum(np.diff(piece, prepend=-2) != 0), -1)
        log = made(random_states(count, rng), STEP, piece=piece)
        expected = []
        for number in np.unique(piece[piece >= 0]):
            rows = np.flatnonzero(piece == number)
            assert (np.diff(rows) == 1).all()
            if len(rows) > 30:
                expected.append((int(rows[0]) + 4, int(rows[-1]) + 1, int(rows[0])))
        windows = ManoeuvreProtocol(initial=0.4, shortest=3.0).make_windows(log, 3, STEP)
        assert [(w.start, w.stop, w.history_start) for w in windows] == expected
        for w in windows:
            np.testing.assert_allclose(
                w.initial_velocities, log.y[w.history_start : w.start, 3:].mean(0)
            )


def test_a_stretch_without_a_sample_to_score_is_no_window() -> None:
    """Its error would be the mean of nothing, and metrics.json holds no NaN."""
    usable = np.ones(200, dtype=bool)
    piece = np.repeat([0, 1], 100)
    usable[4:100] = False
    windows = ManoeuvreProtocol(initial=0.4, shortest=3.0).make_windows(
        made(np.zeros((200, 6)), STEP, usable=usable, piece=piece), 0, STEP
    )
    assert [w.start for w in windows] == [104]


def test_no_window_at_all_says_how_long_the_logs_are() -> None:
    logs = [made(np.zeros((n, 6)), STEP, name=f"of {n}") for n in (50, 80)]
    told = r"protocol T30: none of 2 'test' logs.*of 80, lasts 8\.0 s"
    with pytest.raises(DataError, match=told):
        make_windows(WindowProtocol(length=30.0), logs, STEP, "T30")
    found = make_windows(WindowProtocol(length=2.0, first=0.0), logs, STEP, "T2")
    assert [w.log_index for w in found] == [0, 0, 1, 1, 1]


SIGNALS = SignalsConfig(inputs=("tau_x", "tau_n"))


def window(
    log: int, start: int, stop: int, past: int | None = None, nu: Any = (1.0, 0, 0)
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
    logs: list[PreparedLog],
    limit: float = 1e6,
    dtype: torch.dtype = torch.float64,
) -> list[Prediction]:
    limits = np.full(3, limit)
    return run_free_runs([Candidate("m", "head", model)], windows, logs, STEP, limits, dtype)["m"]


def test_integrate_gives_a_circle() -> None:
    """Constant u, v, r: a circle of radius U / |r|; the trapezoidal rule on the chord is off by (r
    dt)^2 / 12 of the arc only.
    """
    count = 400
    u = 2.0
    v = 0.3
    rate = -0.2
    nu = np.tile([u, v, rate], (count, 1))
    pose = integrate_pose(np.array([5.0, -3.0, 0.4]), nu, STEP)
    t = STEP * np.arange(count)
    psi = 0.4 + rate * t
    north = 5 + (u * (np.sin(psi) - np.sin(0.4)) + v * (np.cos(psi) - np.cos(0.4))) / rate
    east = -3 + (-u * (np.cos(psi) - np.cos(0.4)) + v * (np.sin(psi) - np.sin(0.4))) / rate
    np.testing.assert_allclose(pose[:, 2], psi, atol=1e-12)
    allowed = (rate * STEP) ** 2 / 12 * np.hypot(u, v) * t[-1] + 1e-12
    assert np.hypot(pose[:, 0] - north, pose[:, 1] - east).max() <= allowed
    # rates between samples are their means
    faster = integrate_pose(np.zeros(3), np.stack((0.5 * t, 0 * t, 0 * t), axis=1), STEP)
    np.testing.assert_allclose(faster[:, 0], 0.25 * t**2, atol=1e-9)


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
        assert not p.has_diverged
        np.testing.assert_allclose(
            p.states[:, 3], 2 + (w.initial_velocities[0] - 2) * np.exp(-t), atol=near
        )
        np.testing.assert_allclose(
            p.states[:, 4:], np.tile(w.initial_velocities[1:], (len(t), 1)), atol=near
        )
        np.testing.assert_array_equal(p.states[0, :3], logs[w.log_index].y[w.start, :3])
        np.testing.assert_allclose(
            p.states[:, :3], integrate_pose(logs[w.log_index].y[w.start, :3], p.states[:, 3:], STEP)
        )


@pytest.mark.parametrize(("growth", "limit"), [(1.0, 50.0), (800.0, 1e300)])
def test_a_diverged_window_holds_the_prediction_of_zero(growth: float, limit: float) -> None:
    theta = np.zeros((3, 6))
    theta[0, 0] = growth
    logs = [made(random_states(80, np.random.default_rng(3)), STEP)]
    windows = [window(0, 0, 80, nu=(1.0, 0.2, -0.05)), window(0, 10, 40, nu=(0.0, 0.3, 0.1))]
    runs, zero = (ran(hybrid(one), windows, logs, limit) for one in (theta, 0.0 * theta))
    assert [p.has_diverged for p in runs] == [True, False]
    assert [p.has_diverged for p in zero] == [False, False]
    for p, z in zip(runs, zero, strict=True):
        # the second starts at rest, where growth has nothing to work on: it equals zero without
        # diverging
        np.testing.assert_allclose(p.states, z.states, atol=1e-12)
        assert np.isfinite(p.states).all()


def test_a_mean_is_that_of_the_trajectories_of_its_members() -> None:
    """Run by itself and beside them; where one ran away, the mean of what it really did."""
    theta = np.zeros((2, 3, 6))
    theta[0, 0, 0], theta[1, 0, 0], theta[1, 0, 5] = -1.0, 0.9, 0.2
    models = [hybrid(one).double() for one in theta]
    mean = MeanOfTrajectories(models, (-1e6,) * 3, (1e6,) * 3)
    logs = [made(random_states(40, np.random.default_rng(3)), STEP)]
    windows = [window(0, 0, 40, nu=(5.0, 0.2, 0.1)), window(0, 10, 20, nu=(1.0, 0.3, 0.1))]
    candidates = [Candidate(name, "head", model) for name, model in zip("ab", models, strict=True)]
    candidates.append(Candidate("mean", "ensemble", mean, members=("a", "b")))
    found = run_free_runs(candidates, windows, logs, STEP, np.full(3, 100.0))
    assert [[p.has_diverged for p in found[name]] for name in ("a", "b", "mean")] == [
        [False, False],
        [True, False],
        [False, False],
    ]
    both = np.mean([found[name][1].states[:, 3:] for name in "ab"], axis=0)
    np.testing.assert_allclose(found["mean"][1].states[:, 3:], both, atol=1e-9)
    for one, other in zip(found["mean"], ran(mean, windows, logs, 100.0), strict=True):
        np.testing.assert_allclose(one.states, other.states, atol=1e-9)


def test_members_start_from_a_measured_state_that_equals_the_prediction() -> None:
    """The state after a warm-up is measured, even if the innovation is zero by chance."""
    theta = np.zeros((2, 3, 6))
    theta[0, 1, 0] = 0.5
    theta[1, 1, 0] = -0.5
    models = [hybrid(coefficients).double() for coefficients in theta]
    mean = MeanOfTrajectories(models, (-1.0,) * 3, (1.0,) * 3)
    past = torch.tensor([[[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]]] * 2, dtype=torch.float64)
    inputs = torch.zeros(2, 1, mean.signals.n_inputs, dtype=torch.float64)
    predicted, memory = mean.step(past[:, 0], inputs[:, 0], mean.initial_state(2).double())
    warmed_up = mean.warmup(past, inputs)
    torch.testing.assert_close(warmed_up[:, 1:], memory[:, 1:])
    # the members deviate from each other after the step, and no longer after the measurement
    for s, deviates in ((memory, True), (warmed_up, False)):
        next_memory = mean.step(predicted, inputs[:, 0], s)[1]
        deviation = next_memory[:, 4:7] - mean.step(predicted, inputs[:, 0], 0.0 * s)[1][:, 4:7]
        assert (float(deviation.abs().max()) > 1e-3) == deviates


def test_a_window_beyond_short_training_logs_is_no_divergence() -> None:
    """A vessel that does more than it did in training exceeds the limit itself, and so does
    `constant_velocity` that holds its velocities.
    """
    log = made(random_states(80, np.random.default_rng(3)), STEP)
    fast = float(np.abs(log.y[:, 3]).max())
    theta = np.zeros((3, 6))
    windows = [window(0, 0, 80, nu=(fast, 0.0, 0.0)), window(0, 0, 80, nu=(2.1 * fast, 0.0, 0.0))]
    found = ran(hybrid(theta), windows, [log], 0.1 * fast)
    assert [p.has_diverged for p in found] == [False, True]


def test_divergence_is_judged_within_the_window_only() -> None:
    """A short window shares its batch with a long one; what happens after its own end is not its
    business.
    """
    theta = np.zeros((3, 6))
    theta[0, 0] = 1.0
    log = made(random_states(80, np.random.default_rng(4)), STEP)
    short, long = ran(hybrid(theta), [window(0, 0, 20), window(0, 0, 80)], [log], 10.0)
    assert (short.has_diverged, long.has_diverged) == (False, True)
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
            torch.from_numpy(log.y[None, w.history_start : w.start]),
            torch.from_numpy(log.w[None, w.history_start : w.start]),
        )
        x = torch.from_numpy(np.concatenate((log.y[w.start, :3], w.initial_velocities)))[None]
        with torch.no_grad():
            for k in range(w.start, w.stop):
                np.testing.assert_allclose(
                    p.states[k - w.start, 3:], x[0, 3:], rtol=1e-9, atol=1e-12
                )
                x, s = model.step(x, torch.from_numpy(log.w[None, k]), s)


def test_the_plant_itself_predicts_its_own_noise_free_trial() -> None:
    """The candidate `plant`: what the measured state lacks (actuators, phi and p of a vessel that
    rolls) from the log, commands as inputs, no more known.
    """
    plant = load_vessel("patrol_p06").build()
    count = 200
    model = PlantDynamics(plant, STEP, 2)
    w = torch.zeros(1, count, len(plant.input_names), dtype=torch.float64)
    w[0, :, 0] = 0.1 * torch.sign(torch.sin(torch.arange(count) * 0.1))
    w[0, :, 1] = 1e5
    x = plant.make_initial_state(1)
    states = []
    with torch.no_grad():
        for k in range(count):
            states.append(x[0])
            x, _ = model.step(x, w[:, k], x[:, :0])
    channels = dict(zip(plant.state_names, torch.stack(states).numpy().T, strict=True))
    channels |= {name: w[0, :, i].numpy() for i, name in enumerate(plant.input_names[:2])}
    log = Log("trial", STEP * np.arange(count), channels)
    motion = log.stack(("x", "y", "psi", "u", "v", "r"))
    whole = np.ones(count, dtype=bool)
    trial = prepared(log, motion, np.zeros((count, 2)), whole, np.zeros(count, dtype=int))
    truth = Candidate(
        "plant",
        "plant",
        model,
        plant.state_names,
        plant.input_names[:2],
        len(plant.input_names) - 2,
    )
    windows = [window(0, s, s + 60, nu=motion[s, 3:]) for s in (0, 70, 130)]
    found = run_free_runs([truth], windows, [trial], STEP, np.full(3, 1e6))["plant"]
    for one, p in zip(windows, found, strict=True):
        seen = motion[one.start : one.stop]
        np.testing.assert_allclose(p.states[:, 3:], seen[:, 3:], atol=1e-12)
        np.testing.assert_allclose(p.states[:, :3], seen[:, :3], atol=2e-2)
    assert np.abs(log["phi"]).max() > 0.01


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
        monkeypatch.setattr(freerun, "_MAX_BATCH_VALUES", largest)
        for one, other, length in zip(ran(model, windows, ready), alone, lengths, strict=True):
            assert one.states.shape == (length, 6)
            np.testing.assert_allclose(one.states, other, rtol=1e-9, atol=1e-9)
    assert model.has_position, "the judged model itself is left as it is"
