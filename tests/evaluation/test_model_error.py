"""Intervals of a booklet contain the deviation of repeated trials from the measured ones."""

from __future__ import annotations

import math

import numpy as np
import pytest

from residnet.evaluation.booklet import ModelError, add_model_error


def relative_errors(values: list[float]) -> list[ModelError]:
    return [ModelError(value, 0.0, 0.0, 0.0) for value in values]


def test_without_two_repeated_trials_the_draws_are_those_of_the_parameters() -> None:
    draws = np.array([1.0, 1.1])
    assert add_model_error(draws, relative_errors([0.2])) is draws


def test_relative_deviations_widen_an_interval_by_students_t() -> None:
    errors = relative_errors([0.1, -0.1, 0.1, -0.1])
    low, high = np.quantile(add_model_error(np.array([2.0]), errors), (0.025, 0.975))
    # 2.776 is the quantile of Student's t distribution with 4 degrees of freedom
    assert high == pytest.approx(2.0 * math.exp(0.1 * 2.776), rel=0.02)
    assert low == pytest.approx(2.0 * math.exp(-0.1 * 2.776), rel=0.02)


def test_what_the_parameters_explain_is_no_model_error() -> None:
    errors = [ModelError(value, 0.0, 0.01, 0.0) for value in (0.1, -0.1)]
    assert np.ptp(add_model_error(np.array([2.0]), errors)) == pytest.approx(0.0, abs=1e-6)


def test_indices_of_either_sign_have_absolute_deviations() -> None:
    errors = [ModelError(None, value, 0.0, 0.0) for value in (0.3, -0.3)]
    widened = add_model_error(np.array([0.0]), errors)
    assert np.median(widened) == pytest.approx(0.0, abs=1e-6)
    assert widened.max() > 0.3


def test_intervals_cover_models_of_wrong_form_at_their_level() -> None:
    """The form's error is drawn for the repeated trials and the prediction alike."""
    generator = np.random.default_rng(5)
    n_covered = 0
    n_draws = 2000
    for _ in range(n_draws):
        form_errors = 0.15 * generator.standard_normal(6)
        widened = add_model_error(
            np.exp(form_errors[:1]), relative_errors(form_errors[1:].tolist())
        )
        low, high = np.quantile(widened, (0.025, 0.975))
        n_covered += low <= 1.0 <= high
    # binomial: 0.95 with a standard deviation of 0.005
    assert 0.93 <= n_covered / n_draws <= 0.97
