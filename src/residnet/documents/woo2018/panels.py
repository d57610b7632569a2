"""The panels that the figures of document 003 (Woo et al. 2018) are put together from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.report.figures.style import MEASURED, collect, legend_above, new_figure
from residnet.report.format import DEG
from residnet.report.run_reader import RunFiles, StoredWindow

PROTOCOL = "manoeuvre"
# a colour of Okabe and Ito's palette and a dash pattern for each model of the study
LOOK: dict[str, dict[str, Any]] = {
    "nomoto": {"color": "#CC79A7", "linestyle": ":"},
    "nomoto_side_slip": {"color": "#56B4E9", "linestyle": (0, (2, 1))},
    "baseline": {"color": "#E69F00", "linestyle": "--"},
    "lstm_printed": {"color": "#7F7F7F", "linestyle": (0, (4, 1, 1, 1))},
    "lstm_rate": {"color": "#D55E00", "linestyle": (0, (6, 1.5))},
    "lstm": {"color": "#0072B2", "linestyle": "-"},
}
MODEL_NAMES = {
    "nomoto": "Nomoto",
    "nomoto_side_slip": "Nomoto with side slip",
    "baseline": "linear",
    "lstm_printed": "LSTM as printed, rate 1e-5",
    "lstm_rate": "LSTM as printed, rate 1e-3",
    "lstm": "LSTM, free-run training",
}
"""Models of the study by their key in the config, as they are named in figures and tables."""
CHANNELS: Mapping[str, tuple[int, str, str, float]] = {
    "u": (0, "surge velocity u", "m/s", 1.0),
    "v": (1, "sway velocity v", "m/s", 1.0),
    "r": (2, "yaw rate r", "deg/s", DEG),
}
"""Column, name, shown unit and factor to it from SI of each velocity."""


def histories(panels: Sequence[tuple[StoredWindow, str]], models: Sequence[str]) -> Any:
    """Draw measured and predicted velocities, and below each the errors of the models."""
    figure = new_figure(0.7 + 2.9 * len(panels))
    heights = [height for _ in panels for height in (1.9, 1.0)]
    axes = figure.subplots(len(heights), 1, height_ratios=heights)
    handles: dict[str, Any] = {}
    for place, (window, channel) in enumerate(panels):
        above, below = axes[2 * place : 2 * place + 2]
        plot_history(above, window, channel, models)
        plot_errors(below, window, channel, models)
        above.set_title(window.log, loc="left")
        collect(handles, above)
    axes[-1].set_xlabel("time since the start of the free run [s]")
    legend_above(figure, handles)
    return figure


def plot_history(axes: Any, window: StoredWindow, channel: str, models: Sequence[str]) -> None:
    """Draw a velocity as measured and as the models predict it over time."""
    column, name, unit, factor = CHANNELS[channel]
    time = window.t - window.t[0]
    axes.plot(time, factor * window.measured[:, column], **MEASURED)
    for model in models:
        axes.plot(time, factor * window.predicted[model][:, column], **_line(model))
    axes.set_ylabel(f"{name} [{unit}]")
    axes.set_xlim(0, time[-1])


def plot_errors(axes: Any, window: StoredWindow, channel: str, models: Sequence[str]) -> None:
    """Draw predicted minus measured velocity of each model over time."""
    column, _, unit, factor = CHANNELS[channel]
    time = window.t - window.t[0]
    for model in models:
        error = window.predicted[model][:, column] - window.measured[:, column]
        axes.plot(time, factor * error, **_line(model))
    axes.axhline(0.0, color="black", linewidth=0.5)
    axes.set_ylabel(f"error of {channel}\n[{unit}]")
    axes.set_xlim(0, time[-1])


def _line(model: str) -> dict[str, Any]:
    return LOOK[model] | {"label": MODEL_NAMES[model], "linewidth": 1.3, "zorder": 3}


def bars(
    files: RunFiles,
    windows: Sequence[StoredWindow],
    channels: Sequence[str],
    group: str,
    models: Sequence[str],
) -> Any:
    """Draw RMSE by model, and beside it the error of each unseen run over the linear model's.

    Args:
        files: the run.
        windows: unseen runs of the group's manoeuvres.
        channels: velocities, one row of panels each.
        group: of manoeuvres, as metrics.json names it.
        models: in the order of the bars.
    """
    figure = new_figure(3.0 * len(channels) + 0.5)
    panels = figure.subplots(len(channels), 2, squeeze=False, width_ratios=(1.25, 1.0))
    handles: dict[str, Any] = {}
    names = [MODEL_NAMES[model].replace(", ", ",\n").replace(" with", "\nwith") for model in models]
    for row, channel in zip(panels, channels, strict=True):
        plot_rmse(row[0], files, channel, group, models)
        plot_ratios(row[1], windows, channel, models)
        for axes in row:
            axes.set_xticks(range(len(models)), names, rotation=35, ha="right", fontsize=7)
            axes.grid(axis="x", visible=False)
        collect(handles, row[0])
    legend_above(figure, handles)
    return figure


def plot_rmse(axes: Any, files: RunFiles, channel: str, group: str, models: Sequence[str]) -> None:
    """Draw RMSE by model on training and unseen data, with 95 % intervals over manoeuvres.

    A line shows the error of the simulator itself, which is the noise of the sensors.
    """
    _, name, unit, factor = CHANNELS[channel]
    at = np.arange(len(models))
    for offset, split, fill in ((-0.2, "train", "0.75"), (0.2, "test", "#0072B2")):
        rows = [files.row(model, split, PROTOCOL, group) for model in models]
        value = np.array([factor * row["rmse"][channel] if row else np.nan for row in rows])
        # too few manoeuvres have no interval
        spans = [(row["rmse_ci95"][channel] if row else None) or [np.nan, np.nan] for row in rows]
        low, high = factor * np.array(spans).T
        label = {"train": "training data", "test": "unseen manoeuvres"}[split]
        look = {"color": fill, "edgecolor": "black", "linewidth": 0.5, "label": label}
        axes.bar(at + offset, value, 0.38, **look)
        error = np.abs(np.stack((value - low, high - value)))
        whisker = {"fmt": "none", "ecolor": "black", "elinewidth": 0.8, "capsize": 2}
        axes.errorbar(at + offset, value, yerr=error, **whisker)
    noise = files.row("truth", "test", PROTOCOL, group)
    if noise:
        level = factor * noise["rmse"][channel]
        axes.axhline(level, color="black", linestyle=":", label="simulator itself (sensor noise)")
    axes.set_ylabel(f"RMSE, {name} [{unit}]")


def plot_ratios(
    axes: Any, windows: Sequence[StoredWindow], channel: str, models: Sequence[str]
) -> None:
    """Draw the error of every unseen run over that of the linear model, and their medians."""
    column = CHANNELS[channel][0]
    reference = np.array([window.rmse("baseline")[column] for window in windows])
    for place, model in enumerate(models):
        ratio = np.array([window.rmse(model)[column] for window in windows]) / reference
        spread = 0.25 * np.linspace(-1, 1, len(ratio))
        axes.plot(place + spread, ratio, "o", markersize=2.5, color=LOOK[model]["color"])
        axes.hlines(np.median(ratio), place - 0.35, place + 0.35, color="black", linewidth=1.2)
    axes.axhline(1.0, color="black", linewidth=0.5)
    axes.set_yscale("log")
    axes.set_ylabel(f"error of {channel} over the linear model's")


def track(window: StoredWindow, models: Sequence[str]) -> Any:
    """Draw the north-up track beside yaw rate, sway velocity and their errors."""
    figure = new_figure(6.2)
    grid = figure.add_gridspec(4, 2, height_ratios=(1.6, 1.0, 1.6, 1.0))
    handles: dict[str, Any] = {}
    axes = figure.add_subplot(grid[:, 0])
    start = window.measured[0, 4:6]
    for model, path in [("", window.measured)] + [
        (model, window.predicted[model]) for model in models
    ]:
        look = _line(model) if model else MEASURED
        axes.plot(path[:, 5] - start[1], path[:, 4] - start[0], **look)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    axes.set_title(window.log, loc="left")
    collect(handles, axes)
    for row, channel in enumerate(("r", "v")):
        plot_history(figure.add_subplot(grid[2 * row, 1]), window, channel, models)
        panel = figure.add_subplot(grid[2 * row + 1, 1])
        plot_errors(panel, window, channel, models)
    panel.set_xlabel("time since the start of the free run [s]")
    legend_above(figure, handles)
    return figure
