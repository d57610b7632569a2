"""Equations term by term along a log (document 000 section 6.4.2), and how they were bred."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from residnet.report.figures.files import Drawing
from residnet.report.figures.style import new_figure, styled
from residnet.report.run_reader import RunFiles

_AXES = (
    ("u_dot", "surge [m/s²]", 1.0),
    ("v_dot", "sway [m/s²]", 1.0),
    ("r_dot", "yaw [deg/s²]", 180.0 / math.pi),
)
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
_SHOWN = 6
"""Most terms drawn for themselves in a panel, the largest ones; the others are drawn as their sum.
"""


def of_terms(run: RunFiles) -> Iterator[Drawing]:
    """Draw the equations of every model that the folder holds along a log."""
    frame = run.frame("terms.parquet")
    if frame is None:
        return
    for model, rows in frame.groupby("model", sort=False):
        log = str(rows["log"].iloc[0])
        yield Drawing(
            f"terms_{model}",
            f"Equation of {model}, term by term",
            (
                f"What each term adds to the acceleration along {log}, and their sum (black)"
                " against the target (grey), which is what the baseline leaves. Two large terms"
                " that mirror each other mean that the data can hardly tell them apart. A flat term"
                " could be left out."
            ),
            parts(rows),
        )


def of_breeding(run: RunFiles) -> Iterator[Drawing]:
    """Draw the best error of each generation, of every model that was bred (Figures 6.2, 6.3)."""
    for model in run.heads:
        equations = run.fit(model).get("equations", {})
        histories = {axis: row["history"] for axis, row in equations.items() if "history" in row}
        if histories:
            yield Drawing(
                f"breeding_{model}",
                f"Search of {model}, generation by generation",
                (
                    "Mean square error of the best individual over the target's mean square, on"
                    " the samples that breed and on those that validate. A ring marks the"
                    " generation whose equation was kept, the least validation error. A curve that"
                    " still falls at its end asks for more generations."
                ),
                breeding(histories, {axis: row["generation"] for axis, row in equations.items()}),
            )


@styled
def breeding(histories: Mapping[str, Sequence[Mapping[str, Any]]], kept: Mapping[str, int]) -> Any:
    """Draw the error over the generations, a panel for each axis.

    Args:
        histories: `train` and `validation` of each generation, by axis.
        kept: generation of the equation that was kept, by axis.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(2.6)
    panels = figure.subplots(1, len(histories), squeeze=False)[0]
    names = {axis: text.split(" ")[0] for axis, text, _ in _AXES}
    for axes, (axis, history) in zip(panels, histories.items(), strict=True):
        for part, colour in (("train", _COLOURS[0]), ("validation", _COLOURS[1])):
            axes.plot([row[part] for row in history], color=colour, label=part)
        best = kept[axis]
        ring = {"color": "black", "markerfacecolor": "none", "markersize": 7, "label": "kept"}
        axes.plot(best, history[best]["validation"], "o", **ring)
        axes.set_yscale("log")
        axes.set_title(names.get(axis, axis), loc="left")
        axes.set_xlabel("generation")
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0].set_ylabel("share of the mean square [-]")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    return figure


@styled
def parts(frame: Any) -> Any:
    """Draw the terms of each axis along a log, their sum, and the target.

    Args:
        frame: rows of one model with columns axis, term, t, value.
    """
    figure = new_figure(6.6)
    panels = figure.subplots(3, 1, sharex=True)
    for axes, (axis, text, factor) in zip(panels, _AXES, strict=True):
        of_axis = frame[frame["axis"] == axis]
        curves = {
            str(term): factor * np.asarray(rows["value"])
            for term, rows in of_axis.groupby("term", sort=False)
        }
        time = np.asarray(of_axis["t"])[: len(curves["target"])]
        axes.plot(time, curves.pop("target"), color="0.75", linewidth=2.2, label="target")
        ordered = sorted(curves, key=lambda term: -float(np.square(curves[term]).mean()))
        for term, colour in zip(ordered[:_SHOWN], _COLOURS, strict=False):
            axes.plot(time, curves[term], color=colour, linewidth=1.0, label=_short(term))
        if ordered[_SHOWN:]:
            axes.plot(
                time,
                sum(curves[term] for term in ordered[_SHOWN:]),
                color="0.5",
                linestyle=":",
                label=f"{len(ordered) - _SHOWN} more",
            )
        axes.plot(
            time,
            sum(curves.values(), np.zeros_like(time)),
            color="black",
            linewidth=0.8,
            label="sum",
        )
        axes.set_ylabel(text)
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, handlelength=1.4)
    panels[-1].set_xlabel("time [s]")
    return figure


def _short(term: str) -> str:
    return term.replace("^2", "²").replace("^3", "³").replace("^4", "⁴")
