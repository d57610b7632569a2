"""Prediction intervals for commands of another kind than those of the logs.

Prediction intervals are calibrated on logs. Their errors hold only that part of the error of a
model that the commands of these logs excite: a zigzag, whose turns cancel, hides an error of the
steady turn. Flights with other commands inside the operating domain are simulated with all models
that describe the logs about equally well. Their differences estimate the variance due to the choice
of the model, for which no measurement is needed. Source: D. Draper, Assessment and Propagation of
Model Uncertainty, Journal of the Royal Statistical Society B 57 (1995), 45-97.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
import torch

from residnet.core.layout import POSITION
from residnet.core.model_names import CONSTANT_VELOCITY
from residnet.core.names import WIND_INPUTS
from residnet.dynamics.domain import DomainCheck
from residnet.evaluation.band import Band, band_channels, excess_disagreement
from residnet.evaluation.freerun import Candidate, Prediction, run_free_runs
from residnet.evaluation.protocol import Window
from residnet.identification.fitter import FittedModel
from residnet.identification.identified import trajectory_member_names
from residnet.physics.signals_config import SignalsConfig
from residnet.preprocessing.prepare import PreparedLog

_MAX_FLIGHTS: Final = 80
"""Number of simulated flights; their root mean square then has a relative standard error of 8 %."""
_MIN_FLIGHTS: Final = 10
"""Smallest number of flights inside the domain; fewer cannot estimate a variance."""
_MAX_OUTSIDE_SHARE: Final = 0.1
"""Largest share of the steps of a flight outside the domain."""
_LEVEL_QUANTILES: Final = (0.01, 0.99)
"""Quantiles of the logged inputs between which levels are drawn."""
_SHORTEST_HOLD_SHARE: Final = 0.1
"""Shortest duration of a level, as a share of the flight; the longest is the complete flight. Slow
and fast commands are equally frequent, since the logs do not tell which will follow."""
_MAX_RATIO: Final = 1.5
"""Largest ratio of the errors of a competing model to the smallest ones, as for a good model in the
verdict."""
_MIN_STATED_RATIO: Final = 1.1
"""Ratio of the widths with and without other commands from which a caution states it."""
_CAUTION: Final = (
    "Models that describe the logs about equally well differ under commands of another kind: widths"
    " that do not depend on the motion, as on the card, are up to {:.2g} times larger for this"
    " reason."
)
_MAX_SAMPLES: Final = 100_000
"""Samples of the inputs from which quantiles are estimated, about; they bound the memory."""
_SEED: Final = 5
"""Seed of the commands."""


@dataclass(frozen=True)
class CommandFlights:
    """Windows of training logs with logged and with simulated commands.

    Attributes:
        windows: the windows; `log_index` refers to both lists of logs.
        logged: one log for each window.
        commanded: the same logs with simulated commands within their windows.
    """

    windows: Sequence[Window]
    logged: Sequence[PreparedLog]
    commanded: Sequence[PreparedLog]


def draw_command_flights(
    windows: Sequence[Window], logs: Sequence[PreparedLog], signals: SignalsConfig
) -> CommandFlights:
    """Draw random steps of every input for some windows of training logs.

    Every input steps by itself between levels within the quantiles of its logs, at most as quickly
    as in the logs. Wind, other exogenous channels and unexcited inputs remain as logged, and so
    does the measured past.

    Args:
        windows: windows of the training logs.
        logs: the training logs.
        signals: inputs of the models.
    """
    if not windows:
        return CommandFlights((), (), ())
    generator = np.random.default_rng(_SEED)
    chosen = np.unique(np.linspace(0, len(windows) - 1, _MAX_FLIGHTS).round().astype(int))
    stride = max(sum(map(len, logs)) // _MAX_SAMPLES, 1)
    inputs = np.concatenate([log.w[::stride][log.usable[::stride]] for log in logs])
    lowest, highest = np.quantile(inputs, _LEVEL_QUANTILES, axis=0)
    largest_changes = np.max(
        [np.abs(np.diff(log.w, axis=0)).max(axis=0, initial=0.0) for log in logs], axis=0
    )
    largest_changes = np.where(np.isfinite(largest_changes), largest_changes, np.inf)
    commanded = [
        column
        for column, name in enumerate(signals.input_columns)
        if name in signals.inputs and name not in WIND_INPUTS
    ]
    new_windows = []
    logged_copies = []
    commanded_copies = []
    for number, k in enumerate(chosen):
        window = windows[k]
        log = _cut_log(logs[window.log_index], window)
        offset = window.history_start
        window = replace(
            window,
            log_index=number,
            start=window.start - offset,
            stop=window.stop - offset,
            history_start=0,
        )
        w = log.w.copy()
        for column in commanded:
            w[window.start : window.stop, column] = _draw_steps(
                generator,
                window.stop - window.start,
                float(w[window.start, column]),
                (float(lowest[column]), float(highest[column])),
                float(largest_changes[column]),
            )
        new_windows.append(window)
        logged_copies.append(log)
        commanded_copies.append(replace(log, w=w))
    return CommandFlights(new_windows, logged_copies, commanded_copies)


def _cut_log(log: PreparedLog, window: Window) -> PreparedLog:
    """Return a window of a log with its measured past; copies of long logs would need memory."""
    rows = slice(window.history_start, window.stop)
    arrays = {
        entry.name: getattr(log, entry.name)[rows]
        for entry in fields(log)
        if isinstance(getattr(log, entry.name), np.ndarray)
    }
    return replace(log, log=log.log.select_rows(rows), **arrays)


def _draw_steps(
    generator: np.random.Generator,
    n_steps: int,
    start: float,
    limits: tuple[float, float],
    largest_change: float,
) -> np.ndarray:
    """Return random steps [n_steps] of one input whose change per step is limited."""
    targets = np.empty(n_steps)
    position = 0
    while position < n_steps:
        # log-uniform durations
        duration = n_steps * _SHORTEST_HOLD_SHARE ** generator.uniform()
        stop = position + max(round(duration), 1)
        targets[position:stop] = generator.uniform(*limits)
        position = stop
    values = np.empty(n_steps)
    value = start
    for k, target in enumerate(targets):
        value += float(np.clip(target - value, -largest_change, largest_change))
        values[k] = value
    return values


def widen_for_other_commands(
    bands: Mapping[str, Band],
    models: Mapping[str, FittedModel],
    flights: CommandFlights,
    dt: float,
    velocity_limits: np.ndarray,
) -> dict[str, Band]:
    """Return bands whose widths for any run also hold for commands of another kind.

    The square of the differences to the competing model that differs most, in excess of that under
    the logged commands, adds to the variance of the errors.

    Args:
        bands: calibrated bands by model.
        models: fitted models by name.
        flights: the flights.
        dt: time step in s.
        velocity_limits: see `run_free_runs`.
    """
    if not flights.windows or not bands:
        return dict(bands)
    members = {member for name in bands for member in trajectory_member_names(models[name])}
    candidates = [
        Candidate(name, model.spec.role, model.model, members=trajectory_member_names(model))
        for name, model in models.items()
        if name in bands or name in members
    ]
    commanded = run_free_runs(candidates, flights.windows, flights.commanded, dt, velocity_limits)
    # over the same initial states, so that only the commands differ
    logged = run_free_runs(candidates, flights.windows, flights.logged, dt, velocity_limits)
    widened_bands = dict(bands)
    for name, band in bands.items():
        if models[name].spec.role == CONSTANT_VELOCITY:
            continue
        is_inside = np.array(
            [
                not prediction.has_diverged
                and _outside_share(models[name], prediction, window, log) <= _MAX_OUTSIDE_SHARE
                for prediction, window, log in zip(
                    commanded[name], flights.windows, flights.commanded, strict=True
                )
            ]
        )
        if is_inside.sum() < _MIN_FLIGHTS:
            continue
        excess = np.zeros_like(band.unconditional_width)
        for competitor, is_competing in find_competing_models(bands, models, band.steps).items():
            difference, logged_difference = (
                _root_mean_square_difference(runs[name], runs[competitor], is_inside, band.steps)
                for runs in (commanded, logged)
            )
            excess_of_pair = excess_disagreement(
                difference, logged_difference, band.level, band.channels
            )
            excess = np.maximum(excess, np.where(is_competing[:, None], excess_of_pair, 0.0))
        # a variance does not fall with the horizon where a model no longer competes
        excess = np.maximum.accumulate(excess, axis=0)
        widened_bands[name] = _widen(band, excess)
    return widened_bands


def _widen(band: Band, excess: np.ndarray) -> Band:
    """Return a band with squared half widths [G, c] added to its widths for any run."""
    widths = np.sqrt(band.unconditional_width**2 + excess)
    is_known = band.unconditional_width > 0.0
    ratio = float(np.max(widths[is_known] / band.unconditional_width[is_known], initial=1.0))
    cautions = band.cautions
    if ratio >= _MIN_STATED_RATIO:
        cautions = (*cautions, _CAUTION.format(ratio))
    return replace(band, unconditional_width=widths, cautions=cautions)


def find_competing_models(
    bands: Mapping[str, Band], models: Mapping[str, FittedModel], steps: np.ndarray
) -> dict[str, np.ndarray]:
    """Return at which of some steps [G] the errors of a model on new logs are near the smallest.

    Such models describe the logs about equally well, so that each may be true where the others
    differ. The errors are compared by the widths of the bands of heading and position, and by those
    of the velocities for vessels without a known pose. Models that never compete are omitted.
    """
    widths = {
        name: np.stack(
            [np.interp(steps, band.steps, column) for column in band.unconditional_width.T], axis=1
        )
        for name, band in bands.items()
        if models[name].spec.role != CONSTANT_VELOCITY
    }
    if not widths:
        return {}
    channels = next(iter(bands.values())).channels
    is_known = np.all([table.min(axis=0) > 0.0 for table in widths.values()], axis=0)
    is_pose = is_known & np.isin(channels, ("heading", "position"))
    is_compared = is_pose if is_pose.any() else is_known
    smallest = np.min(list(widths.values()), axis=0)
    is_competing = {
        name: (table <= _MAX_RATIO * smallest)[:, is_compared].all(axis=1)
        for name, table in widths.items()
    }
    return {name: competes for name, competes in is_competing.items() if competes.any()}


def _root_mean_square_difference(
    runs: Sequence[Prediction],
    other_runs: Sequence[Prediction],
    is_counted: np.ndarray,
    steps: np.ndarray,
) -> np.ndarray:
    """Return root mean square differences [G, c] of two models' flights at some steps.

    That of the position is per axis, averaged over both.
    """
    differences = []
    for run, other_run, counted in zip(runs, other_runs, is_counted, strict=True):
        if counted:
            reached = np.minimum(steps, len(run.states) - 1)
            differences.append(run.states[reached] - other_run.states[reached])
    root_mean_squares = np.sqrt(np.mean(np.square(differences), axis=0))
    radius = np.sqrt(0.5 * (root_mean_squares[:, POSITION] ** 2).sum(axis=1))
    return band_channels(root_mean_squares, radius)


def _outside_share(
    fitted_model: FittedModel, prediction: Prediction, window: Window, log: PreparedLog
) -> float:
    """Return the share of the steps of a flight outside the ranges or the operating domain."""
    spec = fitted_model.spec
    states = prediction.states[:-1]
    inputs = log.w[window.start : window.stop - 1]
    values = np.concatenate((states, inputs), axis=1)[:, -len(spec.low) :]
    margins = np.zeros(len(spec.low))
    is_inside = np.ones(len(states), dtype=bool)
    if spec.domain is not None:
        margins = np.array([spec.domain.range_margins.get(name, 0.0) for name in spec.ranges])
        check = DomainCheck(
            spec.domain, spec.signals.dof.state_names, spec.signals.input_columns, torch.float64
        )
        is_inside = check(torch.from_numpy(states), torch.from_numpy(inputs)).numpy()
    is_inside &= (
        (values >= np.array(spec.low) - margins) & (values <= np.array(spec.high) + margins)
    ).all(axis=1)
    return float(1.0 - is_inside.mean())
