"""Figures of an autopilot run: step responses, and distributions over random vessels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import collect, legend_above, new_figure, styled
from residnet.report.format import DEG

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#7F7F7F")
_BAND: dict[str, Any] = {"color": "0.4", "linewidth": 0.8, "linestyle": ":"}
_LINES: tuple[Any, ...] = ("-", (0, (6, 1.5)), "-.", (0, (2, 1)), (0, (4, 1, 1, 1)), "--", ":")


def looks(kinds: Mapping[str, str]) -> dict[str, dict[str, Any]]:
    """Return colour and line of each controller, which differ without colour too.

    Policies have the widest lines and lie on top.
    """
    out: dict[str, dict[str, Any]] = {}
    for place, (name, kind) in enumerate(kinds.items()):
        learned = kind == "policy"
        line = _LINES[(place + place // len(_LINES)) % len(_LINES)]
        out[name] = {
            "color": _COLOURS[place % len(_COLOURS)],
            "linestyle": line,
            "linewidth": 1.8 if learned else 1.2,
            "zorder": 4 if learned else 3,
            "label": name,
        }
    return out


@styled
def responses(
    series: pd.DataFrame, kinds: Mapping[str, str], heading: float, band: float, name: str
) -> Drawing:
    """Draw heading, its error about the band, yaw rate and rudder over time.

    The nominal vessel is drawn as lines; of policies, the corners of the spread as shades.

    Args:
        series: the contents of flights.parquet.
        kinds: of each controller by name, in the order of the legend.
        heading: step in rad.
        band: within which a change has settled, in rad.
        name: of the run.
    """
    series = series.assign(error=heading - series["psi"])
    quantities = (
        ("psi", "heading\n[deg]"),
        ("error", "heading error\n[deg]"),
        ("r", "yaw rate\n[deg/s]"),
        ("rudder", "rudder\n[deg]"),
    )
    figure = new_figure(6.6)
    axes = figure.subplots(4, 1, sharex=True, height_ratios=(1.3, 1.0, 1.0, 1.0))
    handles: dict[str, Any] = {}
    for controller, look in looks(kinds).items():
        flights = series[series["controller"] == controller]
        for axis, (quantity, text) in zip(axes, quantities, strict=True):
            wide: Any = DEG * flights.pivot_table(
                index="t", columns=["effect", "time"], values=quantity
            )
            axis.plot(wide.index, wide[(1.0, 1.0)], **look)
            if kinds[controller] == "policy" and quantity in ("psi", "error"):
                low, high = wide.min(axis=1), wide.max(axis=1)
                shade = {"color": look["color"], "gid": str(look["label"])}
                axis.fill_between(wide.index, low, high, alpha=0.25, linewidth=0, **shade)
            axis.set(ylabel=text)
    for sign in (-1.0, 1.0):
        for axis, middle in ((axes[0], heading), (axes[1], 0.0)):
            axis.axhline(DEG * (middle + sign * band), **_BAND)
    axes[0].lines[-1].set_label("band of settling")
    axes[1].set(ylim=(-2.5 * DEG * band, 2.5 * DEG * band))
    axes[-1].set(xlabel="time [s]")
    figure.align_ylabels(axes)
    collect(handles, axes[0])
    legend_above(figure, handles)
    caption = (
        f"Step of {DEG * heading:.0f} deg. Lines show the nominal vessel, shades the corners of the"
        f" spread under the learned policies. The dotted band of {DEG * band:.1f} deg, enlarged in"
        " the second panel, is the one in which a change has settled."
    )
    return Drawing("responses", f"Step responses of {name}", caption, figure)


@styled
def distributions(plants: pd.DataFrame, kinds: Mapping[str, str], name: str) -> Drawing:
    """Draw settling time, overshoot, error, rudder travel and energy over random vessels.

    Each panel shows the share of vessels that stay below a value.

    Args:
        plants: the contents of plants.parquet.
        kinds: of each controller by name, in the order of the legend.
        name: of the run.
    """
    quantities = (
        ("settling", 1.0, "settling time [s]"),
        ("overshoot", DEG, "overshoot [deg]"),
        ("iae", DEG, "integral of the absolute error [deg s]"),
        ("travel", DEG, "rudder travel [deg]"),
        ("energy", DEG**2, "control energy [deg$^2$ s]"),
    )
    middle = plants.groupby("controller")["settling"].median()
    settling = list(middle.index[middle < plants["settling"].max()])
    figure = new_figure(6.2)
    axes = figure.subplots(3, 2, sharey=True).flatten()
    handles: dict[str, Any] = {}
    for axis, (quantity, scale, text) in zip(axes, quantities, strict=False):
        for controller, look in looks(kinds).items():
            of_controller = plants.loc[plants["controller"] == controller, quantity]
            found = scale * of_controller.sort_values().to_numpy()
            share = np.arange(len(found) + 1) / len(found)
            axis.step(np.concatenate((found[:1], found)), share, where="post", **look)
        axis.set(xlabel=text, ylim=(0.0, 1.02))
        shown = plants.loc[plants["controller"].isin(settling), quantity]
        _fit_limits(axis, scale * shown.to_numpy())
    axes[-1].set_visible(False)
    for axis in axes[::2]:
        axis.set(ylabel="share of vessels")
    collect(handles, axes[0])
    legend_above(figure, handles)
    caption = (
        f"Share of {len(plants) // len(kinds)} random vessels of the spread that stay below a"
        " value. A change that had not settled at the end of its flight counts with the flight's"
        " length. Controllers that seldom settle may lie beyond the axes."
    )
    return Drawing("distributions", f"Random vessels of {name}", caption, figure)


def _fit_limits(axis: Any, shown: np.ndarray) -> None:
    """Set axis limits that hold some values; without values they stay as they are."""
    if len(shown):
        low, high = float(shown.min()), float(shown.max())
        room = 0.05 * (high - low) or 0.05 * abs(high) or 1.0
        axis.set_xlim(low - room, high + room)
