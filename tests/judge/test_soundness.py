"""What makes a model unsound where its logs have been, on models and logs made by hand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from kinds import of_kind

from residnet.baselines.regressors import RegressorBaseline
from residnet.core.log import Log
from residnet.data.prepare import PrepareConfig, Prepared, prepare
from residnet.dynamics.hybrid import HybridDynamics
from residnet.dynamics.store import ModelSpec
from residnet.judge.verdict.course_stability import contradiction, steady_runs
from residnet.judge.verdict.soundness import runaway, training_points, wrong_damping
from residnet.physics.signals import SignalsConfig

STEP = 0.5
# u_dot, v_dot, r_dot by term: a vessel that behaves
TERMS = {
    "u": (-0.1, 0, 0),
    "v": (0, -0.3, 0.05),
    "r": (0, -0.2, -0.5),
    "n": (0.02, 0, 0),
    "delta": (0, 0.01, 0.1),
}


def made(change: Mapping[str, tuple[float, float, float]]) -> tuple[ModelSpec, HybridDynamics]:
    terms = {**TERMS, **change}
    content: dict[str, Any] = {
        "schema": "residnet.model/1",
        "name": "made",
        "role": "baseline",
        "signals": SignalsConfig(inputs=("n", "delta")).model_dump(),
        "baseline": {"kind": "regressors", "terms": list(terms)},
        "dt": STEP,
        "integrator": "rk4",
        "low": (0.0, -0.3, -0.15, 0.0, -0.6),
        "high": (2.0, 0.3, 0.15, 10.0, 0.6),
    }
    spec = ModelSpec.model_validate(content)
    model = spec.build()
    theta = of_kind(model.baseline, RegressorBaseline).theta
    theta.data.copy_(torch.tensor(list(terms.values()), dtype=torch.float64).T)
    return spec, model


def log(seconds: float = 200.0, *, settles: bool = True) -> Prepared:
    """A log at constant drive: its rudder is put over once and it turns steadily, or it is held and
    it turns ever faster.
    """
    t = np.arange(0.0, seconds, STEP)
    random = np.random.default_rng(0)
    u = 2.0 * (1.0 - np.exp(-t / 10.0))
    over = t > (40.0 if settles else -1.0)
    turning = 0.1 * (1.0 - np.exp(-np.maximum(t - 40.0, 0.0) / 3.0))
    r = turning if settles else 0.001 * np.exp(t / 40.0)
    r, v = r + 0.001 * random.standard_normal(t.size), -0.5 * r
    channels = {
        "x": np.cumsum(u) * STEP,
        "y": np.zeros(t.size),
        "psi": np.cumsum(r) * STEP,
        "u": u,
        "v": v + 0.001 * random.standard_normal(t.size),
        "r": r,
        "n": np.full(t.size, 8.0),
        "delta": np.where(over, 0.5, 0.0),
    }
    derivative = {"kind": "savitzky_golay", "window": 5 * STEP, "order": 2}
    config = PrepareConfig.model_validate({"grid": {"step": STEP}, "derivative": derivative})
    return prepare(Log("made", t, channels), "train", ("n", "delta"), config)


def test_a_model_that_behaves_is_sound() -> None:
    spec, model = made({})
    points = training_points([log()])
    assert wrong_damping(model, points) == ""
    assert runaway(spec, model, points, 3.0) == ""
    assert contradiction(model, steady_runs([log()], STEP)) == ""


def test_points_of_several_logs_are_recorded_ones_with_the_extreme_inputs() -> None:
    logs = [replace(log(), usable=np.arange(400) % 3 > 0), log(150.0, settles=False), log(300.0)]
    logs[2].w[77, 1], logs[0].w[1, 0] = -0.9, 55.0
    points = training_points(logs)
    recorded = {
        (*state[3:], *inputs)
        for one in logs
        for state, inputs in zip(one.smooth[one.usable], one.w[one.usable], strict=True)
    }
    found = list(map(tuple, np.hstack((points.x[:, 3:], points.w)).tolist()))
    assert set(found) <= recorded
    assert 90 <= len(found) <= 94
    assert points.w[:, 1].min() == -0.9
    assert points.w[:, 0].max() == 55.0
    speeds = [np.hypot(state[0], state[1]) for state in recorded]
    assert np.hypot(*points.x[:, 3:5].numpy().T).max() == max(speeds)
    assert points.longest == 299.5


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"u": (0.02, 0, 0)}, "du′/du +0.02 1/s, positive at 100% of it"),
        ({"r": (0, -0.2, 0.1)}, "dr′/dr +0.1 1/s"),
        ({"v": (0, 0.1, 0.05)}, "dv′/dv +0.1 1/s"),
    ],
)
def test_damping_of_the_wrong_sign(
    change: Mapping[str, tuple[float, float, float]], said: str
) -> None:
    _, model = made(change)
    assert said in wrong_damping(model, training_points([log()]))


def test_damping_of_the_wrong_sign_outside_the_logs_is_no_fault() -> None:
    # d u_dot/du = -0.1 + 0.01 u^2 is positive only beyond 3.2 m/s; the logs reach 2 m/s
    _, model = made({"u^3": (0.01 / 3.0, 0, 0)})
    assert wrong_damping(model, training_points([log()])) == ""


def test_no_damping_at_all_is_no_wrong_sign() -> None:
    _, model = made({"v": (0, 0, 0.05)})
    assert wrong_damping(model, training_points([log()])) == ""


def test_running_away_with_recorded_inputs() -> None:
    spec, model = made({"u": (0.02, 0, 0)})
    said = runaway(spec, model, training_points([log()]), 3.0)
    assert "runs away within" in said
    assert "(n 8, delta" in said


def test_an_unstable_model_is_contradicted_by_a_vessel_that_turns_steadily_only() -> None:
    # the faster mode of sway and yaw grows by about 0.1 1/s
    _, model = made({"v": (0, -0.3, -0.6), "r": (0, -0.4, -0.3)})
    said = contradiction(model, steady_runs([log()], STEP))
    assert "unstable where the logs are not" in said
    assert contradiction(model, steady_runs([log(settles=False)], STEP)) == ""
    # a straight run that nothing disturbs proves nothing
    straight = [run for run in steady_runs([log()], STEP) if run.w[1] == 0.0]
    assert contradiction(model, straight) == ""
    # one that grows too slowly for the logs to tell
    _, slow = made({"v": (0, -0.3, -0.38), "r": (0, -0.4, -0.5)})
    assert contradiction(slow, steady_runs([log()], STEP)) == ""


def test_steady_runs_are_stretches_of_held_inputs() -> None:
    runs = steady_runs([log()], STEP)
    assert [round(run.seconds) for run in runs] == [30, 120]
    assert runs[1].w.tolist() == pytest.approx([8.0, 0.5])
    assert runs[1].x[5] == pytest.approx(0.1, abs=0.002)
    assert runs[1].growth < 2.0
    assert runs[0].decay < 3.0 < runs[1].decay


def test_a_small_swing_in_a_turn_is_no_fault_where_the_vessel_swings_as_much() -> None:
    """Nobody measured the wind, and a model swings a little where it blew the vessel about: its
    linearised growth says nothing of how far it goes.
    """
    change = {"v": (0, -0.3, -0.6), "r": (0, -0.4, -0.3)}
    _, runs_off = made(change)
    _, swings = made({**change, "v^3": (0, -30.0, 0)})
    steady = steady_runs([log()], STEP)
    blown = [replace(run, scatter=np.array([0.2, 0.2])) for run in steady]
    assert "unstable where the logs are not" in contradiction(runs_off, blown)
    assert "unstable where the logs are not" in contradiction(swings, steady)
    assert contradiction(swings, blown) == ""
