"""Figures of closed loops by model of the feed-forward (document 002 Figures 4.31-4.39)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from residnet.report.figures.style import DASHED, FAMILY, RC, SOLID, legend_above, new_figure, save

_DEG = 180.0 / math.pi
_FORCES = ("surge [N]", "sway [N]", "yaw [N m]")


def draw_errors(
    t: Tensor, position: Mapping[str, Tensor], heading: Mapping[str, Tensor], path: Path
) -> None:
    """Write a figure of position and heading errors over time, a line for each model.

    The scales are logarithmic, since models differ by orders of magnitude.

    Args:
        t: [N] in s.
        position: by model, [N] in m, at least zero.
        heading: by model, [N] in rad, at least zero.
        path: PNG file.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure = new_figure(4.2)
        panels = figure.subplots(2, 1, sharex=True)
        handles: dict[str, Any] = {}
        for axes, series, factor, name, least in (
            (panels[0], position, 1.0, "position error [m]", 1e-5),
            (panels[1], heading, _DEG, "heading error [deg]", 1e-4),
        ):
            for place, (model, error) in enumerate(series.items()):
                look = FAMILY[place % len(FAMILY)]
                handles[model] = axes.semilogy(
                    t, (factor * error).clamp(min=least), **look, linewidth=1.1, label=model
                )[0]
            axes.set_ylabel(name)
        panels[-1].set_xlabel("time [s]")
        panels[-1].set_xlim(float(t[0]), float(t[-1]))
        legend_above(figure, handles)
        save(
            figure,
            path,
            "Errors in closed loop",
            "Distance to the desired position and magnitude of the heading error over time, by"
            " model of the feed-forward.",
        )


def draw_force_parts(
    t: Tensor, total: Mapping[str, Tensor], feedback: Mapping[str, Tensor], path: Path
) -> None:
    """Write a figure of the commanded force and its feedback part, a column for each model.

    Args:
        t: [N] in s.
        total: tau by model, [N, 3] in N and N m.
        feedback: tau_FB by model, [N, 3] in N and N m.
        path: PNG file.
    """
    from matplotlib import rc_context

    with rc_context(RC):
        figure = new_figure(4.8)
        panels = figure.subplots(3, len(total), sharex=True, sharey="row", squeeze=False)
        handles: dict[str, Any] = {}
        for column, name in enumerate(total):
            panels[0, column].set_title(name, loc="left")
            panels[2, column].set_xlabel("time [s]")
            for axis in range(3):
                axes = panels[axis, column]
                handles["commanded force"] = axes.plot(
                    t, total[name][:, axis], **{**SOLID, "linewidth": 1.0, "zorder": 3}
                )[0]
                handles["feedback part"] = axes.plot(
                    t, feedback[name][:, axis], **{**DASHED, "linewidth": 1.0, "zorder": 4}
                )[0]
        for axis in range(3):
            panels[axis, 0].set_ylabel(_FORCES[axis])
        panels[-1, 0].set_xlim(float(t[0]), float(t[-1]))
        legend_above(figure, handles)
        save(
            figure,
            path,
            "Forces in closed loop",
            "Commanded force and the part of it that is feedback, by model of the feed-forward.",
        )
