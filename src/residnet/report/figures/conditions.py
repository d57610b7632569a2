"""Figures of heading controllers under stated conditions: distributions, and learning curves."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from residnet.report.figures.autopilot import looks
from residnet.report.figures.files import Drawing
from residnet.report.figures.style import collect, legend_above, new_figure, styled
from residnet.report.format import DEG
from residnet.report.run_reader import Content


@styled
def costs(flights: pd.DataFrame, kinds: Mapping[str, str], name: str) -> Drawing:
    """Draw the shares of flights under the stated conditions that stay below a value.

    Args:
        flights: the contents of conditions.parquet.
        kinds: of each controller by name, in the order of the legend.
        name: of the run.
    """
    stated = flights[flights["protocol"] == "conditions"]
    quantities = (
        ("cost", 1.0, "cost [s]"),
        ("time_outside", 1.0, "time outside the band [s]"),
        ("overshoot", DEG, "overshoot [deg]"),
        ("travel", DEG, "rudder travel [deg]"),
    )
    figure = new_figure(5.4)
    axes = figure.subplots(2, 2, sharey=True).flatten()
    handles: dict[str, Any] = {}
    for axis, (quantity, scale, text) in zip(axes, quantities, strict=True):
        for controller, look in looks(kinds).items():
            values = stated.loc[stated["controller"] == controller, quantity].dropna()
            found = scale * values.sort_values().to_numpy()
            share = np.arange(1, len(found) + 1) / max(len(found), 1)
            axis.step(found, share, where="post", **look)
        shown = scale * stated.loc[stated["controller"].isin(kinds), quantity].dropna()
        if len(shown):
            axis.set_xlim(0.0, float(np.quantile(shown, 0.98)) * 1.05 or 1.0)
        axis.set(xlabel=text, ylim=(0.0, 1.02))
    for axis in axes[::2]:
        axis.set(ylabel="share of flights")
    collect(handles, axes[0])
    legend_above(figure, handles)
    count = stated["flight"].nunique()
    caption = (
        f"Share of {count} flights under the stated conditions that stay below a value. The two"
        " per cent of all flights with the largest values may lie beyond an axis."
    )
    return Drawing("conditions", f"Flights of {name} under the stated conditions", caption, figure)


@styled
def learning(fits: Mapping[str, Content], name: str) -> Drawing:
    """Draw the cost over the flights that epochs are chosen on, from the start of training on.

    Args:
        fits: the contents of fit.json of each policy by name.
        name: of the run.
    """
    figure = new_figure(3.2)
    axis = figure.subplots()
    look = looks(dict.fromkeys(fits, "policy"))
    for policy, fit in fits.items():
        curve = [point for point in fit["curve"] if "validation" in point]
        epochs = [0.0, *(point["epoch"] + 1.0 for point in curve)]
        scores = [fit["start_validation"], *(point["validation"] for point in curve)]
        axis.plot(epochs, scores, marker=".", **look[policy])
        start = {"color": "0.6", "linewidth": 0.8, "linestyle": ":", "gid": "start"}
        axis.axhline(fit["start_validation"], **start)
    axis.set(xlabel="epoch", ylabel="mean cost [s]")
    axis.legend(loc="best")
    caption = (
        "Mean cost over the flights that epochs are chosen on; epoch 0 is the start, the law as"
        " tuned, and the dotted line goes on from it. The epoch of least cost is kept."
    )
    return Drawing("learning", f"Training of {name}", caption, figure)
