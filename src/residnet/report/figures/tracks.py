"""Figures of single free runs: tracks and time histories of representative manoeuvres."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from residnet.core.stretches import stretches
from residnet.report.figures.style import (
    MASKED,
    MEASURED,
    WIDTH,
    collect,
    legend_above,
    new_figure,
    styled,
    styles,
)
from residnet.report.run_reader import RunFiles, StoredWindow

MOST_KINDS = 6
MASKED_LABEL = "masked"
_DEG = 180.0 / math.pi
_PANELS = (
    ("surge velocity\nu [m/s]", 1.0),
    ("sway velocity\nv [m/s]", 1.0),
    ("yaw rate\nr [deg/s]", _DEG),
    ("heading\n[deg]", _DEG),
)


def representative(
    run: RunFiles, windows: Sequence[StoredWindow], protocol: str
) -> list[StoredWindow]:
    """Return for each kind of manoeuvre the window in which the leading model has its median error.

    It is neither the best nor the worst case.
    """
    judge = leading(run)
    scales = run.metrics.get("scales") or {}
    divisor = np.array([float(scales.get(name, 1.0)) for name in ("u", "v", "r")])
    chosen: list[StoredWindow] = []
    of_protocol = [
        window for window in windows if window.protocol == protocol and judge in window.predicted
    ]
    for kind in sorted({window.manoeuvre for window in of_protocol}):
        ranked = sorted(
            (window for window in of_protocol if window.manoeuvre == kind),
            key=lambda window: (
                float((window.rmse(judge) / divisor).mean()),
                window.log,
                window.number,
            ),
        )
        chosen.append(ranked[(len(ranked) - 1) // 2])
    return chosen[:MOST_KINDS]


def leading(run: RunFiles) -> str:
    """Return the model that figures of single runs show.

    It is the selected one, else the first head, else the baseline.
    """
    names = [run.selected, *run.heads, run.baseline, *run.kinds]
    return next(name for name in names if name is not None and name in run.kinds)


def shown(run: RunFiles) -> list[str]:
    """Return the models in figures of single runs: baseline, plant, the leading head on top."""
    head = leading(run)
    if head == run.baseline and run.heads:
        head = run.heads[0]
    return list(dict.fromkeys(name for name in (run.baseline, run.truth, head) if name is not None))


@styled
def tracks(run: RunFiles, windows: Sequence[StoredWindow]) -> Any:
    """Draw measured and predicted tracks, a panel for each window.

    North is up, scales are equal, and the start is at the origin.
    """
    columns = min(2, len(windows))
    lines = math.ceil(len(windows) / columns)
    side = WIDTH / columns if columns > 1 else 0.7 * WIDTH
    figure = new_figure(0.5 + lines * (0.92 * side + 0.35))
    handles: dict[str, Any] = {}
    look = styles(run)
    for place, window in enumerate(windows):
        axes = figure.add_subplot(lines, columns, place + 1)
        start = window.measured[0, 4:6]
        north, east = (
            np.where(window.usable, window.measured[:, i], np.nan) - window.measured[0, i]
            for i in (4, 5)
        )
        # on top here, where there is no noise that would hide what lies beneath
        axes.plot(east, north, **(MEASURED | {"zorder": 5.5}))
        for model in shown(run):
            if model in window.predicted:
                path = window.predicted[model][:, 4:6] - start
                axes.plot(path[:, 1], path[:, 0], **look[model])
        axes.plot(
            0,
            0,
            "o",
            color="black",
            markerfacecolor="white",
            markersize=6,
            linestyle="none",
            label="start",
            zorder=6,
        )
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.locator_params(axis="x", nbins=5)
        axes.set_title(_title(window))
        axes.set_xlabel("east [m]")
        axes.set_ylabel("north [m]")
        collect(handles, axes)
    legend_above(figure, handles)
    return figure


@styled
def history(run: RunFiles, window: StoredWindow) -> Any:
    """Draw velocities and heading against time, measured and predicted.

    Masked samples are gaps on a grey ground; the band of the leading model is shaded.
    """
    figure = new_figure(6.6)
    panels = figure.subplots(4, 1, sharex=True)
    time = window.t - window.t[0]
    look, lead = styles(run), leading(run)
    handles: dict[str, Any] = {}
    offset = 2 * math.pi * math.floor((window.measured[0, 3] + math.pi) / (2 * math.pi))
    for i, (axes, (text, factor)) in enumerate(zip(panels, _PANELS, strict=True)):
        shift = offset if i == 3 else 0.0
        shade(axes, time, window.usable)
        measured = np.where(window.usable | (i >= 2), window.measured[:, i] - shift, np.nan)
        axes.plot(time, factor * measured, **MEASURED)
        if lead in window.low:
            axes.fill_between(
                time,
                factor * (window.low[lead][:, i] - shift),
                factor * (window.high[lead][:, i] - shift),
                color=look[lead]["color"],
                alpha=0.15,
                linewidth=0,
                label=f"band of {lead}",
            )
        for model in shown(run):
            if model in window.predicted:
                axes.plot(time, factor * (window.predicted[model][:, i] - shift), **look[model])
        axes.set_ylabel(text)
        collect(handles, axes)
    panels[-1].set_xlabel("time since the start of the free run [s]")
    panels[-1].set_xlim(0, time[-1])
    panels[0].set_title(_title(window).replace("\n", ": "))
    figure.align_ylabels(panels)
    # what was measured comes first
    legend_above(
        figure,
        {text: handles[text] for text in sorted(handles, key=lambda text: text == MASKED_LABEL)},
    )
    return figure


def shade(axes: Any, time: np.ndarray, usable: np.ndarray) -> None:
    """Draw a grey ground where samples are masked."""
    for i, (begin, end) in enumerate(zip(*stretches(~usable), strict=True)):
        extra = {"label": MASKED_LABEL} if i == 0 else {}
        axes.axvspan(time[begin], time[min(end, time.size - 1)], **MASKED, **extra)


def _title(window: StoredWindow) -> str:
    name = window.log if len(window.log) <= 36 else f"{window.log[:20]}…{window.log[-15:]}"
    return f"{window.manoeuvre.replace('_', ' ')}\n{name}" + (
        f", window {window.number + 1}" if window.number else ""
    )
