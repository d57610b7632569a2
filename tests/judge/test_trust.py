"""How far models can be trusted, on free runs whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest

from residnet.baselines.given import StillConfig
from residnet.core.log import Log
from residnet.data.prepare import PrepareConfig, Prepared, prepare
from residnet.dynamics.hybrid import HybridDynamics
from residnet.heads.base import ZeroHead
from residnet.judge.freerun import Candidate, FreeRun, Prediction
from residnet.judge.metrics import Judged
from residnet.judge.protocol import Windows
from residnet.judge.selection import blocks_of, shares
from residnet.physics.signals import SignalsConfig

STEP, SCALES = 0.5, {"u": 0.5, "v": 0.2, "r": 0.1}
RANGES = {"u": (0.5, 2.0), "v": (-1.0, 1.0), "r": (-1.0, 1.0), "n": (0.0, 8.0)}


def log(number: int) -> Prepared:
    """A log of 41 s at a speed of its own."""
    t = np.arange(0.0, 41.0, STEP)
    speed = 0.6 + 0.3 * number
    channels = {name: np.zeros(t.size) for name in ("y", "psi", "v", "r")}
    channels |= {"x": speed * t, "u": np.full(t.size, speed), "n": np.full(t.size, 5.0)}
    derivative = {"kind": "savitzky_golay", "window": 5 * STEP, "order": 2}
    config = PrepareConfig.model_validate({"grid": {"step": STEP}, "derivative": derivative})
    return prepare(Log(f"log_{number}", t, channels), "test", ("n",), config)


def candidate(name: str, kind: str) -> Candidate:
    signals = SignalsConfig(inputs=("n",)).build()
    baseline = StillConfig().build(signals.names)
    model = HybridDynamics(signals, baseline, ZeroHead(), STEP)
    return Candidate(name, kind, model, ranges=RANGES)


CANDIDATES = [
    candidate("zero", "zero"),
    candidate("baseline", "baseline"),
    candidate("mlp", "head"),
]


@pytest.fixture(scope="module")
def logs() -> list[Prepared]:
    return [log(number) for number in range(6)]


@pytest.fixture(scope="module")
def run(logs: list[Prepared]) -> FreeRun:
    """The error of zero is 0.1 throughout; the model's grows with time and passes it at 12 s."""
    protocol = Windows(length=20.0, first=0.0, history=0.0)
    windows = [w for i, prepared in enumerate(logs) for w in protocol.windows(prepared, i, STEP)]
    out = FreeRun("T20", "test", windows)
    for name in ("zero", "baseline", "mlp"):
        out.predictions[name] = []
        for window in windows:
            states = logs[window.log].y[window.start : window.stop].copy()
            age = STEP * np.arange(len(states))
            error = {"zero": 0.1 + 0 * age, "baseline": 0.09 + 0 * age, "mlp": 0.1 * age / 12.0}
            # a little of its own for each log, so that there is a spread
            states[:, 3] += (1.0 + 0.01 * window.log) * error[name]
            out.predictions[name].append(Prediction(states, False))
    return out


def test_errors_of_the_pose_are_told_after_the_times_that_matter(
    run: FreeRun, logs: list[Prepared]
) -> None:
    """Windows of 20 s; the model's position is put 3 m and its heading 200 deg off after 10 s."""
    for prediction in run.predictions["mlp"]:
        prediction.states[20, :2] += np.array([3.0, 4.0])
        prediction.states[20, 2] += np.radians(200.0)
    entries = Judged(run, CANDIDATES, logs, SCALES).horizons(STEP)
    for prediction in run.predictions["mlp"]:
        prediction.states[20, :2] -= np.array([3.0, 4.0])
        prediction.states[20, 2] -= np.radians(200.0)
    assert [entry["seconds"] for entry in entries] == [10.0, 20.0]
    first = entries[0]
    assert (first["windows"], first["logs"]) == (12, 6)
    assert first["slowest"] == pytest.approx(0.6)
    assert first["sailed"] == pytest.approx(1.35 * 10.5)
    own = first["models"]["mlp"]
    assert own["position"] == pytest.approx(5.0)
    # a turn too many is no error
    assert np.degrees(own["heading"]) == pytest.approx(160.0)
    low, high = own["intervals"]["position"]
    assert low <= 5.0 <= high
    # velocities were made from the positions
    assert first["floor"]["position"] == pytest.approx(0.0, abs=1e-9)
    assert first["models"]["zero"]["position"] == pytest.approx(0.0, abs=1e-9)


def test_no_interval_of_a_heading_passes_half_a_turn(run: FreeRun, logs: list[Prepared]) -> None:
    pairs = list(zip(run.windows, run.predictions["mlp"], strict=True))
    for window, prediction in pairs:
        prediction.states[20, 2] += 0.5 * (window.log + 1)
    entries = Judged(run, CANDIDATES, logs, SCALES).horizons(STEP)
    for window, prediction in pairs:
        prediction.states[20, 2] -= 0.5 * (window.log + 1)
    assert entries[0]["models"]["mlp"]["intervals"]["heading"][1] == pytest.approx(np.pi)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_intervals_hold_the_mean_over_as_many_new_logs(logs: list[Prepared], count: int) -> None:
    """Forty sets of logs are judged, and forty others fall into the intervals as often as told."""
    logs = logs[:count]
    random, hits = np.random.default_rng(0), 0
    protocol = Windows(length=20.0, first=0.0, history=0.0)
    windows = [w for i, prepared in enumerate(logs) for w in protocol.windows(prepared, i, STEP)]

    def drawn() -> FreeRun:
        out = FreeRun("T20", "test", windows)
        by_log = random.gamma(2.0, 1.0, len(logs))
        out.predictions["mlp"] = []
        for window in windows:
            states = logs[window.log].y[window.start : window.stop].copy()
            states[:, 0] += by_log[window.log] * random.gamma(4.0, 0.25)
            out.predictions["mlp"].append(Prediction(states, False))
        return out

    trials = 40
    for _ in range(trials):
        seen, new = (
            Judged(drawn(), [CANDIDATES[2]], logs, SCALES).horizons(STEP) for _ in range(2)
        )
        low, high = seen[-1]["models"]["mlp"]["intervals"]["position"]
        hits += low <= new[-1]["models"]["mlp"]["position"] <= high
    assert hits >= 0.85 * trials


def test_every_model_is_compared_with_zero_and_the_first_baseline(
    run: FreeRun, logs: list[Prepared]
) -> None:
    judged = Judged(run, CANDIDATES, logs, SCALES)
    found = judged.compared()
    assert set(found["mlp"]) == {"zero", "baseline"}
    assert set(found["baseline"]) == {"zero"}
    apart = found["baseline"]["zero"]["nrmse_mean"]
    # u alone is off, by 0.09 and 0.1 m/s, and the more the later the log
    expected = np.array([(1.0 + 0.01 * w.log) * -0.01 / 0.5 / 3 for w in run.windows])
    assert judged.nrmse["zero"][0] == pytest.approx(0.1 / 0.5 / 3)
    assert apart == pytest.approx(expected.mean())


def test_samples_outside_the_training_range_are_counted(run: FreeRun, logs: list[Prepared]) -> None:
    # one of six logs is faster than 2 m/s
    found = Judged(run, CANDIDATES, logs, SCALES).outside()
    assert found["share"] == pytest.approx(1 / 6)
    assert found["channels"] == {"u": pytest.approx(1 / 6)}


@pytest.mark.parametrize(("count", "of", "blocks"), [(6, "logs", 6), (2, "stretches", 8)])
def test_shares_of_blocks_sum_to_the_mean_error(
    run: FreeRun, logs: list[Prepared], count: int, of: str, blocks: int
) -> None:
    few = [i for i, window in enumerate(run.windows) if window.log < count]
    part = FreeRun("T20", "test", [run.windows[i] for i in few])
    part.predictions["mlp"] = [run.predictions["mlp"][i] for i in few]
    found, labels = blocks_of(part)
    assert (found.of, len(found.weights)) == (of, blocks)
    assert found.weights.sum() == pytest.approx(1.0)
    own = shares(part, "mlp", logs, SCALES, labels, blocks)
    expected = Judged(part, [CANDIDATES[2]], logs, SCALES).nrmse["mlp"].mean()
    assert own.sum() == pytest.approx(expected)
