"""Commands of another kind, and the variance of predictions under them."""

from __future__ import annotations

import copy
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from made_system import LINEAR, STEP, model_of, trials

from residnet.baselines.base import ParametricBaseline
from residnet.baselines.regressors_config import RegressorsConfig
from residnet.core.layout import SURGE_SWAY_YAW
from residnet.evaluation.band import Band, MotionIntensity
from residnet.evaluation.protocol import WindowProtocol
from residnet.identification.command_variance import (
    CommandFlights,
    draw_command_flights,
    widen_for_other_commands,
)
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import compute_training_ranges
from residnet.preprocessing.samples import make_samples

SIGNALS = SignalsConfig(inputs=("tau_x", "tau_n"))
LENGTH = 8.0


def flights_of(logs: Any) -> Any:
    protocol = WindowProtocol(length=LENGTH, first=0.0)
    windows = [
        window
        for index, log in enumerate(logs)
        for window in protocol.make_overlapping_windows(log, index, STEP, 2.0)
    ]
    return draw_command_flights(windows, logs, SIGNALS)


def flat_band(width: float) -> Band:
    n_channels = len(SURGE_SWAY_YAW.layout.band_channels)
    steps = np.array([1, round(LENGTH / STEP)])
    widths = np.full((2, n_channels), width)
    ones = np.ones(n_channels)
    intensity = MotionIntensity(np.ones(6), np.zeros(6), np.ones(6))
    slope = np.zeros((6, n_channels))
    return Band(
        0.95,
        STEP,
        steps,
        widths,
        widths,
        ones,
        ones,
        ones,
        intensity,
        slope,
        n_logs=4,
        n_scores=4.0,
    )


def test_commands_lie_within_the_logged_quantiles_and_leave_the_past_as_logged() -> None:
    logs = trials()
    flights = flights_of(logs)
    assert len(flights.windows) == len(flights.logged) == len(flights.commanded) >= 40
    lowest, highest = np.quantile(np.concatenate([log.w for log in logs]), (0.01, 0.99), axis=0)
    fastest = np.max([np.abs(np.diff(log.w, axis=0)).max(axis=0) for log in logs], axis=0)
    means = []
    for window, logged, commanded in zip(
        flights.windows, flights.logged, flights.commanded, strict=True
    ):
        np.testing.assert_array_equal(
            commanded.w[: window.start], logged.w[: window.start], strict=True
        )
        np.testing.assert_array_equal(commanded.y, logged.y)
        w = commanded.w[window.start : window.stop]
        assert np.all(np.abs(np.diff(w, axis=0)) <= fastest + 1e-12)
        # after the transient from the logged value
        assert np.all((w[-1] >= lowest - 1e-9) & (w[-1] <= highest + 1e-9))
        means.append(w.mean(axis=0))
    assert np.all(np.std(means, axis=0) > 0.1 * (highest - lowest))


def test_widths_grow_where_commands_of_another_kind_reveal_a_difference_of_models() -> None:
    """Logs without commands hide a difference of the effects of the commands."""
    logs = trials()
    model = model_of(LINEAR)
    samples = make_samples(logs, model.signals)
    RegressorsConfig(terms=tuple(LINEAR)).fit_preferred(model.baseline, samples)
    low, high = compute_training_ranges(logs)
    spec = SimpleNamespace(
        role="baseline",
        low=tuple(low),
        high=tuple(high),
        domain=None,
        signals=SIGNALS,
        ranges=("u", "v", "r", "tau_x", "tau_n"),
        members=(),
    )

    def scaled_model(name: str, factor: float) -> Any:
        scaled = copy.deepcopy(model)
        assert isinstance(scaled.baseline, ParametricBaseline)
        scaled.baseline.set_free(factor * scaled.baseline.get_free().detach())
        return SimpleNamespace(name=name, model=scaled, spec=spec)

    best = scaled_model("best", 1.0)
    rival = scaled_model("rival", 1.1)
    poor = scaled_model("poor", 1.5)
    flights = flights_of(logs)
    flights = replace(
        flights, logged=[replace(log, w=np.zeros_like(log.w)) for log in flights.logged]
    )
    limits = np.full(3, 100.0)
    band = flat_band(0.001)
    bands = {"best": band, "rival": flat_band(0.0014), "poor": flat_band(0.0016)}

    def widen(flights: CommandFlights, *models: Any) -> Band:
        by_name = {entry.name: entry for entry in models}
        bands_of_models = {name: bands[name] for name in by_name}
        widened_bands = widen_for_other_commands(bands_of_models, by_name, flights, STEP, limits)
        return widened_bands["best"]

    widened = widen(flights, best, rival, poor)
    # a model that describes the logs worse is no evidence against a better one
    np.testing.assert_array_equal(
        widened.unconditional_width, widen(flights, best, rival).unconditional_width
    )
    assert np.all(widened.unconditional_width >= band.unconditional_width)
    assert widened.unconditional_width[-1, band.channels.index("heading")] > 0.01
    np.testing.assert_array_equal(widened.half_width, band.half_width)
    assert widen(flights, best).unconditional_width == pytest.approx(band.unconditional_width)
    # the commands of the logs add nothing
    as_logged = replace(flights, commanded=flights.logged)
    unchanged = widen(as_logged, best, rival)
    np.testing.assert_allclose(unchanged.unconditional_width, band.unconditional_width)
    # no flight is inside the domain: nothing is known about other commands
    spec.low = tuple(high)
    assert widen(flights, best, rival) is band
