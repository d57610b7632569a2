"""Figures of an autopilot run: responses at the corners of the spread, rudder, yaw rate, and the distributions over random vessels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
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


def draw_distributions(path: Path, plants: pd.DataFrame, names: Sequence[str], name: str) -> None:
    """Settling time, overshoot, rudder travel and energy over random vessels, as the share of them that stays below a value."""
    import matplotlib

    quantities = (
        ("settling", 1.0, "settling time [s]"),
        ("overshoot", 180.0 / math.pi, "overshoot [deg]"),
        ("travel", 180.0 / math.pi, "rudder travel [deg]"),
        ("energy", (180.0 / math.pi) ** 2, "control energy [deg$^2$ s]"),
    )
    with matplotlib.rc_context(RC):
        figure = new_figure(4.6)
        axes = figure.subplots(2, 2, sharey=True).flatten()
        handles: dict[str, Any] = {}
        for axis, (quantity, scale, text) in zip(axes, quantities, strict=True):
            for place, controller in enumerate(names):
                found = plants.loc[plants["controller"] == controller, quantity].sort_values().to_numpy() * scale
                share = np.arange(len(found) + 1) / len(found)
                axis.step(
                    np.concatenate((found[:1], found)), share, where="post", color=_COLOURS[place % len(_COLOURS)], linewidth=1.2, label=controller
                )
            axis.set(xlabel=text, ylim=(0.0, 1.02))
        for axis in (axes[0], axes[2]):
            axis.set(ylabel="share of vessels")
        collect(handles, axes[0])
        legend_above(figure, handles)
        save(figure, path, f"Random vessels of {name}", f"Share of {len(plants) // len(names)} random vessels of the spread that stay below a value.")
