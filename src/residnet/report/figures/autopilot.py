"""Figures of an autopilot run: responses at the corners of the spread, rudder, yaw rate, and the
distributions over random vessels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.figures.style import RC, collect, legend_above, new_figure, save

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
_LINES: tuple[Any, ...] = ("-", (0, (6, 1.5)), "-.", (0, (2, 1)), (0, (4, 1, 1, 1)), "--", ":")


def _looks(kinds: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Colour and line of each controller, told apart without colour too; policies are the widest
    and lie on top.
    """
    out: dict[str, dict[str, Any]] = {}
    for place, (name, kind) in enumerate(kinds.items()):
        own = kind == "policy"
        line = _LINES[(place + place // len(_LINES)) % len(_LINES)]
        out[name] = {
            "color": _COLOURS[place % len(_COLOURS)],
            "linestyle": line,
            "linewidth": 1.8 if own else 1.2,
            "zorder": 4 if own else 3,
            "label": name,
        }
    return out


def draw_responses(
    path: Path,
    series: pd.DataFrame,
    kinds: Mapping[str, str],
    heading: float,
    band: float,
    name: str,
) -> None:
    """Heading, its error about the band, yaw rate and rudder over time: nominal vessel as lines,
    the corners of the spread as shades.

    Args:
        path: of the PNG.
        series: `flights.parquet`.
        kinds: of each controller, by name, in the order of the legend.
        heading: step [rad].
        band: settled within [rad].
        name: of the run.
    """
    import matplotlib

    series = series.assign(error=heading - series["psi"])
    quantities = (
        ("psi", "heading [deg]"),
        ("error", "heading error [deg]"),
        ("r", "yaw rate [deg/s]"),
        ("rudder", "rudder [deg]"),
    )
    shaded = [controller for controller, kind in kinds.items() if kind == "policy"]
    with matplotlib.rc_context(RC):
        figure = new_figure(6.6)
        axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0, 1.0))
        handles: dict[str, Any] = {}
        for controller, look in _looks(kinds).items():
            own = series[series["controller"] == controller]
            for axis, (quantity, text) in zip(axes, quantities, strict=True):
                wide: Any = own.pivot_table(
                    index="t", columns=["effect", "time"], values=quantity
                ) * (180.0 / math.pi)
                axis.plot(wide.index, wide[(1.0, 1.0)], **look)
                if controller in shaded and quantity in ("psi", "error"):
                    axis.fill_between(
                        wide.index,
                        wide.min(axis=1),
                        wide.max(axis=1),
                        color=look["color"],
                        alpha=0.25,
                        linewidth=0,
                    )
                axis.set(ylabel=text)
        for sign in (-1.0, 1.0):
            axes[0].axhline(
                math.degrees(heading + sign * band), color="0.4", linewidth=0.8, linestyle=":"
            )
            axes[1].axhline(math.degrees(sign * band), color="0.4", linewidth=0.8, linestyle=":")
        axes[1].set(ylim=(-2.5 * math.degrees(band), 2.5 * math.degrees(band)))
        axes[-1].set(xlabel="time [s]")
        collect(handles, axes[0])
        legend_above(figure, handles)
        caption = (
            f"Step of {math.degrees(heading):.0f} deg: nominal vessel (lines) and, of policies, the"
            f" corners of the spread (shades); dotted: the band of {math.degrees(band):.1f} deg"
            " that a change has settled in, enlarged in the second panel."
        )
        save(figure, path, f"Step responses of {name}", caption)


def draw_distributions(
    path: Path, plants: pd.DataFrame, kinds: Mapping[str, str], name: str
) -> None:
    """Settling time, overshoot, integral of the error, rudder travel and energy over random
    vessels, as the share that stays below a value.
    """
    import matplotlib

    degree = 180.0 / math.pi
    quantities = (
        ("settling", 1.0, "settling time [s]"),
        ("overshoot", degree, "overshoot [deg]"),
        ("iae", degree, "integral of the absolute error [deg s]"),
        ("travel", degree, "rudder travel [deg]"),
        ("energy", degree**2, "control energy [deg$^2$ s]"),
    )
    middle = plants.groupby("controller")["settling"].median()
    settling = list(middle.index[middle < plants["settling"].max()])
    with matplotlib.rc_context(RC):
        figure = new_figure(6.2)
        axes = figure.subplots(3, 2, sharey=True).flatten()
        handles: dict[str, Any] = {}
        for axis, (quantity, scale, text) in zip(axes, quantities, strict=False):
            for controller, look in _looks(kinds).items():
                found = (
                    plants.loc[plants["controller"] == controller, quantity]
                    .sort_values()
                    .to_numpy()
                    * scale
                )
                share = np.arange(len(found) + 1) / len(found)
                axis.step(np.concatenate((found[:1], found)), share, where="post", **look)
            axis.set(xlabel=text, ylim=(0.0, 1.02))
            _fit(axis, plants.loc[plants["controller"].isin(settling), quantity].to_numpy() * scale)
        axes[-1].set_visible(False)
        for axis in axes[::2]:
            axis.set(ylabel="share of vessels")
        collect(handles, axes[0])
        legend_above(figure, handles)
        caption = (
            f"Share of {len(plants) // len(kinds)} random vessels of the spread that stay below a"
            " value. A change that had not settled at the end of its flight counts with the"
            " flight's length; controllers that seldom settle may lie beyond the axes."
        )
        save(figure, path, f"Random vessels of {name}", caption)


def _fit(axis: Any, shown: np.ndarray) -> None:
    """Axis limits that hold some values, and do not shrink where there are none."""
    if len(shown):
        low, high = float(shown.min()), float(shown.max())
        room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
        axis.set_xlim(low - room, high + room)
