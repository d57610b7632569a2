"""Figures 13 to 18 of Woo et al. 2018 (document 003), drawn from a finished run.

The document shows single runs: simplified steering models in a zigzag (13), surge in an
acceleration-deceleration test (14), sway and yaw rate in a zigzag and a 3-2-1-1 test (15), errors
of the speed models (16) and of the steering models (17) on training and unseen data, and a zigzag
with its track (18).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from residnet.core.errors import UsageError
from residnet.report.blocks import Figure
from residnet.report.figures.style import MEASURED, RC, collect, legend_above, new_figure, save
from residnet.report.format import DEG
from residnet.report.run_reader import RunFiles, StoredWindow

PROTOCOL = "manoeuvre"
_CAPTION = "Unseen manoeuvres unless it says otherwise; simulated WAM-V with sensor noise."
# a colour of Okabe and Ito's palette and a dash pattern for each model of the study
_LOOK: dict[str, dict[str, Any]] = {
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
_CHANNELS: Mapping[str, tuple[int, str, float]] = {
    "u": (0, "surge velocity u [m/s]", 1.0),
    "v": (1, "sway velocity v [m/s]", 1.0),
    "r": (2, "yaw rate r [deg/s]", DEG),
}
_SIMPLE = ("nomoto", "nomoto_side_slip", "baseline")
LEARNED = ("lstm_printed", "lstm_rate", "lstm")
_COMPARED = ("baseline", *LEARNED)


def draw(files: RunFiles) -> list[Figure]:
    """Draw the six figures into `figures/woo2018` of a run folder.

    Raises:
        UsageError: where the run lacks a kind of manoeuvre or a model of the study.
    """
    from matplotlib import rc_context

    missing = [model for model in _LOOK if model not in files.kinds]
    if missing:
        raise UsageError(
            f"{files.path}: study woo2018 needs the models {', '.join(_LOOK)}; '{missing[0]}' is"
            " absent"
        )
    zigzag, speed, steps = (
        _typical(files, kind)
        for kind in ("zigzag", "acceleration_deceleration", "three_two_one_one")
    )
    with rc_context(RC):
        drawings = {
            13: (
                "Simplified steering models in a zigzag",
                _histories([(zigzag, "v"), (zigzag, "r")], _SIMPLE),
            ),
            14: (
                "Surge in an acceleration-deceleration test",
                _histories([(speed, "u")], _COMPARED),
            ),
            15: (
                "Sway and yaw rate in a zigzag and a 3-2-1-1 test",
                _histories([(zigzag, "v"), (zigzag, "r"), (steps, "v"), (steps, "r")], _COMPARED),
            ),
            16: ("Errors of the speed models", _bars(files, ("u",), "speed", _COMPARED)),
            17: (
                "Errors of the steering models",
                _bars(files, ("v", "r"), "steering", (*_SIMPLE, *LEARNED)),
            ),
            18: ("A zigzag: track, yaw rate and sway velocity", _track(zigzag, (*_SIMPLE, "lstm"))),
        }
        figures = []
        for number, (words, drawing) in drawings.items():
            path = files.path / "figures" / "woo2018" / f"{number}.png"
            title = f"Figure {number} of document 003: {words}"
            save(drawing, path, title, _CAPTION)
            figures.append(Figure(path, title, _CAPTION))
    return figures


def _typical(files: RunFiles, kind: str) -> StoredWindow:
    """Return the unseen run of a kind with the median error of the LSTM trained in free run."""
    runs = [
        window
        for window in files.windows("test")
        if window.protocol == PROTOCOL and window.manoeuvre == kind
    ]
    if not runs:
        raise UsageError(f"{files.path}: study woo2018 needs a test manoeuvre of kind {kind}")
    ranked = sorted(runs, key=lambda window: (float(window.rmse("lstm").sum()), window.log))
    return ranked[(len(ranked) - 1) // 2]


def _line(model: str) -> dict[str, Any]:
    return _LOOK[model] | {"label": MODEL_NAMES[model], "linewidth": 1.3, "zorder": 3}


def _plot_history(axes: Any, window: StoredWindow, channel: str, models: Sequence[str]) -> None:
    column, text, factor = _CHANNELS[channel]
    time = window.t - window.t[0]
    axes.plot(time, factor * window.measured[:, column], **MEASURED)
    for model in models:
        axes.plot(time, factor * window.predicted[model][:, column], **_line(model))
    axes.set_ylabel(text)
    axes.set_xlim(0, time[-1])


def _histories(panels: Sequence[tuple[StoredWindow, str]], models: Sequence[str]) -> Any:
    """Draw measured and predicted velocities, one panel each."""
    figure = new_figure(0.7 + 1.9 * len(panels))
    handles: dict[str, Any] = {}
    for place, (window, channel) in enumerate(panels):
        axes = figure.add_subplot(len(panels), 1, place + 1)
        _plot_history(axes, window, channel, models)
        axes.set_title(window.log, loc="left")
        collect(handles, axes)
    axes.set_xlabel("time since the start of the free run [s]")
    legend_above(figure, handles)
    return figure


def _bars(files: RunFiles, channels: Sequence[str], group: str, models: Sequence[str]) -> Any:
    """Draw RMSE by model on training and unseen data, with 95 % intervals over manoeuvres."""
    figure = new_figure(2.6 * len(channels) + 0.5)
    handles: dict[str, Any] = {}
    for place, channel in enumerate(channels):
        axes = figure.add_subplot(len(channels), 1, place + 1)
        _, text, factor = _CHANNELS[channel]
        for offset, split, fill in ((-0.2, "train", "0.75"), (0.2, "test", "#0072B2")):
            rows = [files.row(model, split, PROTOCOL, group) for model in models]
            value = np.array([factor * row["rmse"][channel] if row else np.nan for row in rows])
            # too few manoeuvres have no interval
            spans = [
                (row["rmse_ci95"][channel] if row else None) or [np.nan, np.nan] for row in rows
            ]
            low, high = factor * np.array(spans).T
            name = {"train": "training data", "test": "unseen manoeuvres"}[split]
            error = np.abs(np.stack((value - low, high - value)))
            axes.bar(
                np.arange(len(models)) + offset,
                value,
                0.38,
                color=fill,
                edgecolor="black",
                linewidth=0.5,
                label=name,
            )
            axes.errorbar(
                np.arange(len(models)) + offset,
                value,
                yerr=error,
                fmt="none",
                ecolor="black",
                elinewidth=0.8,
                capsize=2,
            )
        axes.set_xticks(
            range(len(models)),
            [
                MODEL_NAMES[model].replace(", ", ",\n").replace(" with", "\nwith")
                for model in models
            ],
        )
        axes.set_ylabel(f"RMSE, {text}")
        axes.grid(axis="x", visible=False)
        collect(handles, axes)
    legend_above(figure, handles)
    return figure


def _track(window: StoredWindow, models: Sequence[str]) -> Any:
    """Draw the north-up track beside yaw rate and sway velocity."""
    figure = new_figure(4.2)
    grid = figure.add_gridspec(2, 2)
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
        panel = figure.add_subplot(grid[row, 1])
        _plot_history(panel, window, channel, models)
    panel.set_xlabel("time since the start of the free run [s]")
    legend_above(figure, handles)
    return figure
