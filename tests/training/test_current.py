"""Unknown currents of logs: what a drifting frame does to a log, and how well currents and
coefficients come back.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch

from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.config import validate_config
from residnet.core.errors import FitError
from residnet.manoeuvres.trials import simulate_trial_logs
from residnet.manoeuvres.trials_config import SimulatedTrials
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PrepareConfig, PreparedLog, prepare_log
from residnet.preprocessing.samples import make_samples
from residnet.training import current as module
from residnet.training.current import (
    estimate_currents,
    is_explained_by_body_velocity,
    through_water,
)
from residnet.training.current_config import CurrentConfig
from residnet.training.records import CurrentRow

SIGNALS = SignalsConfig(inputs=("n_port", "n_stbd"), forces="wam_v_cal")
PREPARE = PrepareConfig.model_validate(
    {
        "grid": {"step": 0.1},
        "derivative": {"kind": "savitzky_golay", "window": 0.9, "order": 3},
        "hold": "mean",
    }
)
TRIALS = {
    "kind": "simulated",
    "vessel": "wam_v_cal",
    "duration": 40,
    "step": 0.1,
    "substeps": 2,
    "trials": [
        {"kind": "constant", "drive": [0.3, 0.8], "steer": [-0.5, -0.2, 0.2, 0.5]},
        {"kind": "zigzag", "count": 8, "heading": ["20 deg", "40 deg"], "steer": [0.3, 0.9]}
        | {"drive": [0.2, 0.9]},
        {"kind": "acceleration_deceleration", "count": 3},
        {"kind": "three_two_one_one", "count": 3},
    ],
    "identification": {"zigzag": 7},
    "validation": {},
}


@cache
def sailed(*, drifting: bool = False, exact: bool = False) -> tuple[list[PreparedLog], np.ndarray]:
    """Logs of the simulated catamaran and the current of each."""
    change: dict[str, object] = {"seed": 0}
    change |= {"disturbance": {"current_each": [0.1, 0.5]}} if drifting else {}
    change |= {"noise": {"u": 0, "v": 0, "r": 0}} if exact else {}
    config = validate_config({**TRIALS, **change}, SimulatedTrials, "here")
    logs = simulate_trial_logs(config.draw_manoeuvres(), config)
    return [
        prepare_log(log, "train", SIGNALS.input_columns, PREPARE) for log in logs
    ], config.disturbance.draw_currents(len(logs), config.seed)


def test_a_drifting_frame_is_calm_water() -> None:
    """The hull's own accelerations, which know nothing of currents, fit the moved log as well as a
    log in calm water.
    """
    fossen = RegressorsConfig(sets=("fossen",))
    signals = SIGNALS.build()
    calm, _ = sailed(exact=True)
    logs, currents = sailed(exact=True, drifting=True)
    model = fossen.build(signals.names)
    fossen.fit_preferred(model, make_samples(calm, signals))

    def left(logs: list[PreparedLog]) -> np.ndarray:
        known = make_samples(logs, signals)
        with torch.no_grad():
            return np.asarray((known.target - model(known.z)).square().mean(0).sqrt())

    moved = [
        through_water(log, current, signals) for log, current in zip(logs, currents, strict=True)
    ]
    assert (left(moved) < 1.5 * left(calm) + 2e-3).all()
    assert (left(logs)[:2] > 5 * left(moved)[:2]).all()
    for log in moved:
        # positions of the frame are the integral of its own velocities
        north = log.y[:, 3] * np.cos(log.y[:, 2]) - log.y[:, 4] * np.sin(log.y[:, 2])
        np.testing.assert_allclose(
            log.y[-1, 0] - log.y[0, 0], np.trapezoid(north, dx=0.1), atol=0.02
        )


def test_wind_is_that_of_the_frame() -> None:
    signals = SignalsConfig(inputs=("n", "delta"), exogenous=("wind_speed", "wind_dir")).build()
    log = sailed()[0][0]
    windy = np.concatenate((log.w, np.tile([5.0, 0.7], (len(log), 1))), axis=1)
    log = dataclasses.replace(log, w=windy, regression_inputs=windy)
    moved = through_water(log, np.array([0.8, -0.5]), signals)
    before, after = (
        signals(
            torch.from_numpy(p.smoothed), signals.prepare(torch.from_numpy(p.regression_inputs))
        )
        for p in (log, moved)
    )
    # the air that the vessel feels is the same, whatever frame it is told in
    torch.testing.assert_close(after[:, 4:], before[:, 4:])
    assert float((after[:, :2] - before[:, :2]).abs().max()) > 0.5


@pytest.mark.long
def test_currents_come_back() -> None:
    """Noise of 3 cm/s and 0.2 deg/s: currents to a centimetre per second, as their standard errors
    say.
    """
    logs, truth = sailed(drifting=True)
    signals = SIGNALS.build()
    fossen = RegressorsConfig(sets=("fossen",))
    found, table = estimate_currents(fossen.build(signals.names), signals, logs, CurrentConfig())
    error = found - truth
    assert np.abs(error).max() < 0.03
    assert np.sqrt((error**2).mean()) < 0.01 < 0.05 < np.sqrt((truth**2).mean())
    claimed = np.array([row.standard_error for row in table])
    assert 0.5 < np.sqrt((error**2).mean() / (claimed**2).mean()) < 2.0


def test_a_start_in_a_wrong_valley_is_left() -> None:
    """The cost has other minima, which the search over a grid leaves: from a current half a metre
    per second off the same ones come out.
    """
    logs, truth = sailed(drifting=True)
    signals = SIGNALS.build()
    problem = module._CurrentProblem(
        RegressorsConfig(sets=("fossen",)).build(signals.names), signals, logs, 4.0
    )
    right = torch.from_numpy(truth)
    _, state = problem.solve(right)
    # the differentiable regression is that of the transformed logs
    moved = make_samples(
        [through_water(log, c, signals) for log, c in zip(logs, truth, strict=True)], signals
    )
    torch.testing.assert_close(state.phi, problem.baseline.library(moved.z), rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(state.error + state.phi @ state.theta.T, moved.target)
    wrong = right.clone()
    wrong[3] += torch.tensor([0.3, -0.4], dtype=torch.float64)
    found = problem.search_grid(wrong, state, 0.5)
    assert float((found[3] - right[3]).norm()) < 0.1 < float((wrong[3] - right[3]).norm())


LINEAR = RegressorsConfig(sets=("linear",))


def test_a_log_without_samples_is_named() -> None:
    logs, _ = sailed()
    signals = SIGNALS.build()
    empty = dataclasses.replace(logs[0], trainable=np.zeros(len(logs[0]), dtype=bool))
    told = "log constant_01: no trainable sample to estimate its current from"
    with pytest.raises(FitError, match=told):
        estimate_currents(LINEAR.build(signals.names), signals, [empty, logs[1]], CurrentConfig())


def test_standard_errors_hold_where_the_regressors_are_not_the_true_ones() -> None:
    """Lines in every channel cannot be this hull; the halves of the logs disagree, and say so."""
    logs, truth = sailed(drifting=True)
    logs = logs[:12]
    truth = truth[:12]
    signals = SIGNALS.build()
    linear = LINEAR.build(signals.names)
    found, table = estimate_currents(linear, signals, logs[3:], CurrentConfig(), logs[:3])
    claimed = np.array([row.standard_error for row in table])
    off = ((found - np.concatenate((truth[3:], truth[:3]))) / claimed) ** 2
    assert 0.3 < np.sqrt(off.mean()) < 2.0
    problem = module._CurrentProblem(linear, signals, logs[3:], 4.0)
    alone = problem.gauss_newton_step(
        torch.from_numpy(found[:-3]), problem.solve(torch.from_numpy(found[:-3]))[1]
    )
    assert (claimed[:-3].ravel() > 2.0 * alone[1].diagonal().sqrt().numpy()).all()
    assert [row.fitted for row in table] == [True] * len(logs[3:]) + [False] * 3


def test_logs_kept_apart_change_nothing_and_a_narrow_prior_holds_currents_at_zero() -> None:
    logs, _ = sailed(drifting=True)
    signals = SIGNALS.build()
    linear = LINEAR.build(signals.names)
    alone, beside = (
        estimate_currents(linear, signals, logs[3:6], CurrentConfig(), apart)[0]
        for apart in ((), logs[:2])
    )
    np.testing.assert_array_equal(beside[:3], alone)
    held, table = estimate_currents(linear, signals, logs[3:5], CurrentConfig(spread=1e-6))
    assert np.abs(held).max() < 1e-4 < np.abs(alone).max()
    told = [[row.current_north, row.current_east] for row in table]
    np.testing.assert_array_equal(held, told)
    assert [row.log for row in table] == [log.log.name for log in logs[3:5]]


@pytest.mark.parametrize(
    ("mean_headings", "swing", "is_ambiguous"),
    [((0.0, 0.05, -0.1), 0.3, True), ((0.0, 2.0, 4.0), 0.3, False), ((0.0, 0.0, 0.0), 3.1, False)],
)
def test_a_current_along_one_course_may_be_an_error_of_the_model(
    mean_headings: tuple[float, ...], swing: float, is_ambiguous: bool
) -> None:
    headings = [mean + np.linspace(-swing, swing, 101) for mean in mean_headings]
    rows = [
        CurrentRow(
            log=str(number),
            fitted=True,
            current_north=0.5,
            current_east=0.1,
            standard_error=(0.05, 0.05),
            p_value=1e-8,
        )
        for number in range(len(headings))
    ]
    assert is_explained_by_body_velocity(rows, headings) is is_ambiguous
