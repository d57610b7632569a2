"""Bands of free runs: coverage where errors are known, few logs, horizons beyond, JSON."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from residnet.core.layout import ROLL_LAYOUT, DegreesOfFreedom
from residnet.evaluation.band import (
    Band,
    compute_run_weights,
    conformal_level,
    effective_sample_size,
    is_covered,
    largest_error_ratios,
    weighted_quantile,
)
from residnet.evaluation.bands import RunErrors, band_limits, calibrate_band

STEP = 0.5
LENGTH = 60
LIVELY = 4.0
"""By how much errors of a run that reverses its rudder exceed those of one that does not."""


def runs(logs: int, per_log: int, seed: int) -> list[RunErrors]:
    """Runs whose errors grow with the root of time, and are larger where the run is lively."""
    random = np.random.default_rng(seed)
    t = np.arange(LENGTH + 1) * STEP
    out = []
    for number in range(logs):
        # every fifth log zigzags, and is as short as such logs are
        lively = number % 5 == 0
        own = random.lognormal(0.0, 0.15)
        for _ in range(max(per_log // 4, 1) if lively else per_log):
            states = np.zeros((LENGTH + 1, 6))
            rate = 0.02 * (10.0 if lively else 1.0) * random.lognormal(0.0, 0.1)
            states[:, 3] = 1.0
            states[:, 5] = rate * np.sin(0.5 * t + random.uniform(0, 6))
            size = own * (LIVELY if lively else 1.0) * np.sqrt(t[1:, None])
            error = np.abs(size * random.normal(size=(1, 5)) * [1, 2, 3, 4, 5])
            kind = "zigzag" if lively else "turning"
            out.append(RunErrors(f"log{number}", kind, error, states))
    return out


@pytest.fixture(scope="module")
def band() -> Band:
    """A band from 40 logs."""
    return calibrate_band(runs(40, 12, 0), 0.9, STEP, np.ones(5))


def coverage(band: Band, given: list[RunErrors]) -> tuple[float, float]:
    """Shares of samples and of whole runs that a band holds."""
    widths = [band.half_widths(run.states) for run in given]
    held = [is_covered(run.error, width) for run, width in zip(given, widths, strict=True)]
    largest = largest_error_ratios([run.error for run in given], widths)
    return float(np.mean(held)), float((largest <= band.simultaneous_factor).mean())


def test_new_runs_are_held_at_the_level_whatever_their_kind(band: Band) -> None:
    fresh = runs(300, 8, 1)
    samples, whole = coverage(band, fresh)
    assert 0.87 < samples < 0.94
    assert 0.87 < whole < 0.95
    for kind in ("zigzag", "turning"):
        assert 0.84 < coverage(band, [run for run in fresh if run.manoeuvre == kind])[0] < 0.96


def test_a_lively_run_has_the_wider_band(band: Band) -> None:
    of_kind = {run.manoeuvre: run for run in runs(5, 1, 2)}
    lively, calm = (band.half_widths(of_kind[kind].states)[-1] for kind in ("zigzag", "turning"))
    assert (lively > 2.0 * calm).all()


def test_half_widths_grow_in_proportion_to_time_beyond_the_horizon(band: Band) -> None:
    table = band.interpolate(band.half_width, 3 * LENGTH)
    np.testing.assert_allclose(table[-1], 3.0 * band.half_width[-1])


def test_unscored_samples_and_runs_of_other_lengths_are_left_out() -> None:
    given = runs(12, 4, 4)
    for run in given[::3]:
        run.error[: LENGTH // 2, [0, 1, 4]] = np.nan
    given = [
        RunErrors(run.log, run.manoeuvre, run.error[:cut], run.states[: cut + 1])
        for run, cut in zip(given, [LENGTH, 20, 35] * len(given), strict=False)
    ]
    found = calibrate_band(given, 0.9, STEP, np.ones(5))
    assert np.isfinite(found.half_width).all()
    assert (found.half_width > 0).all()
    assert found.horizon == LENGTH * STEP
    assert found.cautions == ()
    told = calibrate_band(given[:13], 0.9, STEP, np.ones(5)).cautions
    assert "4 logs calibrate this band; with fewer than 9" in told[0]


def test_a_roll_has_bands_of_its_own(band: Band) -> None:
    live = DegreesOfFreedom(ROLL_LAYOUT.velocities)
    random = np.random.default_rng(6)

    def rolling(given: list[RunErrors]) -> list[RunErrors]:
        out = []
        for run in given:
            # rate and angle, which move alike in every run
            more = 0.1 * np.sin(0.5 * np.arange(LENGTH + 1.0))[:, None] * [0.5, 1.0]
            error = np.abs(random.normal(size=(LENGTH, 2)) * [0.02, 0.1])
            states = np.column_stack((run.states, more))
            out.append(replace(run, error=np.c_[run.error, error], states=states, dof=live))
        return out

    found = calibrate_band(rolling(runs(40, 12, 0)), 0.9, STEP, np.ones(7))
    assert found.channels == ("u", "v", "r", "heading", "position", "p", "phi")
    assert tuple(found.to_table().columns[-1]) == tuple(found.unconditional_width[:, -1])
    # of normal errors nine tenths lie within 1.645 deviations
    np.testing.assert_allclose(found.unconditional_width[5:, 5:] / [0.02, 0.1], 1.645, rtol=0.15)
    # what has no roll is held as without
    np.testing.assert_allclose(
        found.unconditional_width[:, :5], band.unconditional_width, rtol=0.05
    )
    run = rolling(runs(1, 1, 5))[0]
    again = Band.from_record(found.to_record())
    np.testing.assert_allclose(again.half_widths(run.states), found.half_widths(run.states))
    np.testing.assert_allclose(again.simultaneous_factor, found.simultaneous_factor)
    low, high = band_limits(run.states, run.half_widths(found))
    assert ((high - low)[1:] > 0.0).all()
    np.testing.assert_allclose(0.5 * (high - low)[1:, 6:], run.half_widths(found)[:, 5:])


def test_runs_of_a_log_count_as_one_where_they_agree() -> None:
    names = [f"log{i // 10}" for i in range(100)]
    weight = compute_run_weights(names)
    alike = np.array([float(i // 10 != 3) for i in range(100)])
    apart = np.array([float(i % 10 != 3) for i in range(100)])
    assert effective_sample_size(alike, weight, names, 0.9) == pytest.approx(9.0, rel=0.2)
    assert effective_sample_size(apart, weight, names, 0.9) == 50.0
    assert conformal_level(0.9, 9.0) == 1.0


def test_a_weighted_quantile_is_the_smallest_score_that_suffices() -> None:
    scores = np.array([3.0, np.nan, 1.0, 2.0])
    weight = np.array([0.2, 0.4, 0.3, 0.1])
    assert weighted_quantile(scores, weight, 0.5) == 1.0
    assert weighted_quantile(scores, weight, 0.6) == 2.0
    assert weighted_quantile(scores, weight, 1.0) == 3.0


def of_unlike_models(logs: int, off: float, seed: int) -> list[RunErrors]:
    """Runs of the first of four models, whose errors beside the noise are of one size."""
    random = np.random.default_rng(seed)
    out = []
    grown = np.sqrt(STEP * np.arange(1, LENGTH + 1))[:, None, None]
    for number in range(logs):
        apart = grown * (0.1 * random.normal(size=(1, 5, 1)) + off * random.normal(size=(1, 5, 4)))
        states = np.zeros((LENGTH + 1, 6))
        states[:, 3] = 1.0
        spread = apart.std(axis=2, ddof=1)
        out.append(RunErrors(f"log{number}", "", np.abs(apart[:, :, 0]), states, spread))
    return out


def test_a_band_widens_where_unlike_models_lie_farther_apart_than_usual() -> None:
    """Off the data that calibrate, a model errs three times as much, and the models disagree."""
    band = calibrate_band(of_unlike_models(400, 0.02, 0), 0.9, STEP, np.ones(5))
    plain = replace(band, typical_spread=None)

    def share(band: Band, given: list[RunErrors]) -> float:
        return float(np.mean([is_covered(run.error, run.half_widths(band)) for run in given]))

    beyond = of_unlike_models(400, 0.3, 1)
    assert share(plain, beyond) < 0.5
    assert 0.86 < share(band, beyond) < 0.94
    assert 0.89 < share(band, of_unlike_models(400, 0.02, 2)) < 0.92
    again = Band.from_record(band.to_record())
    np.testing.assert_allclose(beyond[0].half_widths(again), beyond[0].half_widths(band))


def draw_distant_runs(n_logs: int, farthest: float, slope: float, seed: int) -> list[RunErrors]:
    """Return runs at log distances of up to `farthest`, whose errors grow with exp(slope d)."""
    random = np.random.default_rng(seed)
    drawn = []
    for number in range(n_logs):
        distance = np.full(LENGTH, random.uniform(-1.0, farthest))
        size = np.exp(slope * np.maximum(distance, 0.0))[:, None] * [1, 2, 3, 4, 5]
        states = np.zeros((LENGTH + 1, 6))
        states[:, 3] = 1.0
        error = np.abs(size * random.normal(size=(1, 5)))
        drawn.append(RunErrors(f"log{number}", "", error, states, distance=distance))
    return drawn


def test_widths_grow_with_the_distance_to_the_training_data() -> None:
    """The calibration runs lie within the domain, and runs of another kind far outside."""
    near = draw_distant_runs(100, 0.0, 0.8, 0)
    plain = calibrate_band(near, 0.9, STEP, np.ones(5))
    band = calibrate_band(near, 0.9, STEP, np.ones(5), draw_distant_runs(100, 3.0, 0.8, 1))
    assert plain.distance_slope is None
    assert band.distance_slope is not None
    np.testing.assert_allclose(band.distance_slope, 0.8, atol=0.25)

    def share(band: Band, drawn: list[RunErrors]) -> float:
        return float(np.mean([is_covered(run.error, run.half_widths(band)) for run in drawn]))

    far = draw_distant_runs(400, 3.0, 0.8, 2)
    assert share(plain, far) < 0.65
    assert 0.85 < share(band, far) < 0.95
    assert share(band, near) == pytest.approx(share(plain, near), abs=0.01)
    again = Band.from_record(band.to_record())
    np.testing.assert_allclose(far[0].half_widths(again), far[0].half_widths(band))


def test_errors_that_do_not_grow_with_the_distance_leave_the_widths() -> None:
    near = draw_distant_runs(100, 0.0, 0.0, 0)
    band = calibrate_band(near, 0.9, STEP, np.ones(5), draw_distant_runs(400, 3.0, 0.0, 1))
    assert band.distance_slope is not None
    np.testing.assert_allclose(band.distance_slope, 0.0, atol=0.06)
