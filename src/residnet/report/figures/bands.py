"""Figures of bands: half widths against the horizon beside the errors that they are to hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import DASHED, SOLID, collect, legend_above, new_figure, styled
from residnet.report.figures.tracks import leading
from residnet.report.format import DEG
from residnet.report.run_reader import Content, RunFiles, StoredWindow

_PANELS = (
    ("u", "u [m/s]", 1.0),
    ("v", "v [m/s]", 1.0),
    ("r", "r [deg/s]", DEG),
    ("heading", "heading [deg]", DEG),
    ("position", "position [m]", 1.0),
)


def of_bands(run: RunFiles) -> Iterator[Drawing]:
    """Draw the band of the leading model under each protocol."""
    model = leading(run)
    known: Content = (run.json("bands.json").get("models") or {}).get(model) or {}
    windows = run.windows(run.focus) if known else []
    for protocol, band in known.items():
        given = [w for w in windows if w.protocol == protocol and model in w.low]
        if given:
            yield Drawing(
                f"bands_{protocol}",
                f"Band against horizon: {protocol}",
                (
                    f"Half widths of the bands of {model} in the {run.focus} data, mean over the"
                    f" runs, and the errors that {100 * band['level']:.0f} % of these runs do not"
                    " exceed. A curve of errors well above the band means that these logs are"
                    " unlike those that calibrated it; one well below, that they are easier."
                ),
                _widths(given, model, float(band["level"])),
            )


@styled
def _widths(windows: Sequence[StoredWindow], model: str, level: float) -> Any:
    figure = new_figure(5.0)
    grid = figure.subplots(3, 2, sharex=True)
    panels = [grid[0, 0], grid[1, 0], grid[2, 0], grid[1, 1], grid[2, 1]]
    longest = max(window.t.size for window in windows)
    error = np.full((len(windows), longest, 5), np.nan)
    width = np.full((len(windows), longest, 5), np.nan)
    for i, window in enumerate(windows):
        size = window.t.size
        apart = window.predicted[model] - window.measured
        error[i, :size, :4] = np.abs(apart[:, :4])
        error[i, :size, 4] = np.hypot(apart[:, 4], apart[:, 5])
        for column in (0, 1, 4):
            error[i, :size][~window.usable, column] = np.nan
        width[i, :size] = 0.5 * (window.high[model] - window.low[model])[:, :5]
    time = np.arange(longest) * float(np.median(np.diff(windows[0].t)))
    rows = slice(1, None, max(longest // 200, 1))
    seen = np.isfinite(error).any(axis=0)
    handles: dict[str, Any] = {}
    for column, (axes, (_, text, factor)) in enumerate(zip(panels, _PANELS, strict=True)):
        held = np.full(longest, np.nan)
        good = seen[:, column]
        held[good] = np.nanquantile(error[:, good, column], level, axis=0)
        mean = np.nanmean(width[:, :, column], axis=0)
        axes.plot(time[rows], factor * mean[rows], **SOLID, label="half width of the band, mean")
        axes.plot(
            time[rows], factor * held[rows], **DASHED, label=f"{100 * level:.0f} % of the errors"
        )
        axes.set_ylabel(text)
        axes.set_ylim(bottom=0)
        collect(handles, axes)
    grid[0, 1].set_axis_off()
    for axes in grid[2]:
        axes.set_xlabel("time since the start [s]")
    legend_above(figure, handles)
    return figure
