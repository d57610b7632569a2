"""Figures of an autopilot run: responses at the corners of the spread, rudder, yaw rate, and the distributions over random vessels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from residnet.evaluation.figures_style import RC, collect, legend_above, new_figure, save

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")


def draw_responses(path: Path, series: pd.DataFrame, names: Sequence[str], heading: float, band: float, name: str) -> None:
    """Heading, yaw rate and rudder over time: nominal vessel as lines, the corners of the spread as shades."""
    import matplotlib

    quantities = (("psi", "heading [deg]"), ("r", "yaw rate [deg/s]"), ("rudder", "rudder [deg]"))
    with matplotlib.rc_context(RC):
        figure = new_figure(5.2)
        axes = figure.subplots(3, 1, sharex=True)
        handles: dict[str, Any] = {}
        for place, controller in enumerate(names):
            own = series[series["controller"] == controller]
            colour = _COLOURS[place % len(_COLOURS)]
            for axis, (quantity, text) in zip(axes, quantities, strict=True):
                wide: Any = own.pivot_table(index="t", columns=["effect", "time"], values=quantity) * (180.0 / math.pi)
                axis.plot(wide.index, wide[(1.0, 1.0)], color=colour, linewidth=1.2, label=controller)
                if quantity == "psi":
                    axis.fill_between(wide.index, wide.min(axis=1), wide.max(axis=1), color=colour, alpha=0.12, linewidth=0)
                axis.set(ylabel=text)
        for offset in (-band, band):
            axes[0].axhline(math.degrees(heading + offset), color="0.5", linewidth=0.6, linestyle=":")
        axes[2].set(xlabel="time [s]")
        collect(handles, axes[0])
        legend_above(figure, handles)
        caption = (
            f"Step of {math.degrees(heading):.0f} deg: nominal vessel (lines) and the corners of the spread (shades); "
            f"dotted: the band of {math.degrees(band):.1f} deg that a change has settled in."
        )
        save(figure, path, f"Step responses of {name}", caption)


def draw_distributions(path: Path, rows: Sequence[dict[str, Any]], names: Sequence[str], name: str) -> None:
    """Settling time and overshoot over random vessels: mean, 95th percentile and largest."""
    import matplotlib

    random = {row["model"]: row for row in rows if row["protocol"] == "random"}
    with matplotlib.rc_context(RC):
        figure = new_figure(0.9 + 0.32 * len(names))
        left, right = figure.subplots(1, 2, sharey=True)
        for axis, quantity, scale, text in ((left, "settling", 1.0, "settling time [s]"), (right, "overshoot", 180.0 / math.pi, "overshoot [deg]")):
            for place, controller in enumerate(names):
                found = {key: scale * value for key, value in random[controller][quantity].items()}
                colour = _COLOURS[place % len(_COLOURS)]
                axis.plot([found["mean"], found["max"]], [place, place], color=colour, linewidth=1.0)
                axis.plot(found["mean"], place, "o", color=colour, markersize=5)
                axis.plot(found["p95"], place, "|", color=colour, markersize=9)
            axis.set(xlabel=text, yticks=range(len(names)), yticklabels=names)
        left.invert_yaxis()
        save(
            figure,
            path,
            f"Random vessels of {name}",
            "Over random vessels of the spread: mean (dot), 95th percentile (bar), largest (end of the line).",
        )
