"""Figures of one free run that is held in memory: its track, and its velocities against time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.report.figures.style import FAMILY, MEASURED, RC, WIDTH, legend_above, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DEG = math.degrees(1.0)
_PANELS = (
    (3, "surge velocity\nu [m/s]", 1.0),
    (4, "sway velocity\nv [m/s]", 1.0),
    (5, "yaw rate\nr [deg/s]", _DEG),
    (2, "heading\n[deg]", _DEG),
)


@dataclass(frozen=True)
class DrawnRun:
    """One window of a log under some models.

    Attributes:
        title: of the figure.
        t: [T] in s, the log's clock.
        usable: [T], whether u, v and the position are to be trusted.
        measured: states [T, 6] x, y, psi, u, v, r in SI and rad.
        predicted: the same by model.
    """

    title: str
    t: np.ndarray
    usable: np.ndarray
    measured: np.ndarray
    predicted: Mapping[str, np.ndarray]

    def styles(self) -> dict[str, dict[str, Any]]:
        """Return the line properties of each model, in the order that they are given in."""
        return {
            model: {**FAMILY[i % len(FAMILY)], "linewidth": 1.4, "label": model}
            for i, model in enumerate(self.predicted)
        }


def draw_track(run: DrawnRun) -> Figure:
    """Draw the measured track and those of the models from a common start; north up, equal scales.

    Args:
        run: what to draw.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure: Figure = new_figure(0.8 * WIDTH)
        axes = figure.subplots()
        start = run.measured[0, :2]
        north, east = (np.where(run.usable, run.measured[:, i], np.nan) - start[i] for i in (0, 1))
        axes.plot(east, north, **(MEASURED | {"zorder": 5.5, "linewidth": 1.2}))
        for model, look in run.styles().items():
            path = run.predicted[model][:, :2] - start
            axes.plot(path[:, 1], path[:, 0], **look)
        axes.plot(0, 0, "o", color="black", markerfacecolor="white", label="start", zorder=6)
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.set(title=run.title, xlabel="east [m]", ylabel="north [m]")
        _legend(figure, axes)
        figure.canvas.draw()
    return figure


def draw_history(run: DrawnRun) -> Figure:
    """Draw velocities and heading against time, measured and predicted.

    Args:
        run: what to draw.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure: Figure = new_figure(6.6)
        panels = figure.subplots(len(_PANELS), 1, sharex=True)
        time = run.t - run.t[0]
        for axes, (column, text, factor) in zip(panels, _PANELS, strict=True):
            shown = run.usable | (column in (2, 5))
            axes.plot(time, factor * np.where(shown, run.measured[:, column], np.nan), **MEASURED)
            for model, look in run.styles().items():
                axes.plot(time, factor * run.predicted[model][:, column], **look)
            axes.set_ylabel(text)
        panels[0].set_title(run.title)
        panels[-1].set_xlabel("time since the start of the free run [s]")
        panels[-1].set_xlim(0, time[-1])
        figure.align_ylabels(panels)
        _legend(figure, panels[0])
        figure.canvas.draw()
    return figure


def _legend(figure: Figure, axes: Any) -> None:
    handles, names = axes.get_legend_handles_labels()
    legend_above(figure, dict(zip(names, handles, strict=True)))
