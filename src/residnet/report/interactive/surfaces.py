"""The interactive figure of a drawn surface: its coloured cells, and sections through any of them.

A surface is an image over two axes whose colour bar tells what the colours mean.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.report.interactive.explorer import (
    CELLS,
    INK,
    Case,
    Curve,
    Explorer,
    Look,
    Panel,
    Surface,
)
from residnet.report.interactive.packing import packed, unpacked

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_CELLS = 10_000
_CELLS, _SECTION = "surface", "section and its cell"

Drawn = Callable[["Axes"], list[tuple[str, Look, Curve]]]
"""Gives name, look and values of all lines and points that are drawn in some axes."""


def surface_content(figure: Figure, drawn: Drawn, words: Callable[[str], str]) -> Any:
    """Return the surfaces of a figure as they are stored; None where it shows anything else.

    Args:
        figure: as drawn.
        drawn: gives the marks that lie upon a surface.
        words: gives a label as plain text.
    """
    from matplotlib.colors import LogNorm

    bars = {one.images[0].colorbar for one in figure.axes if one.images} - {None}
    axes = [one for one in figure.axes if one not in {bar.ax for bar in bars if bar}]
    if len(bars) != 1 or not all(_is_surface(one) for one in axes):
        return None
    (bar,) = bars
    first = axes[0].images[0]
    if any(one.images[0].get_clim() != first.get_clim() for one in axes):
        return None
    return {
        "height": words(bar.ax.get_ylabel()) if bar else "",
        "labels": [words(one) for one in _labels(axes)],
        "limits": [float(limit) for limit in first.get_clim()],
        "logarithmic": isinstance(first.norm, LogNorm),
        "size": _size(first),
        "cases": [_stored(one, drawn(one), words) for one in axes],
    }


def surface_explorer(name: str, title: str, caption: str, content: Mapping[str, Any]) -> Explorer:
    """Return the interactive figure of stored surfaces.

    Raises:
        ValueError, TypeError, KeyError: where the content is not what `surface_content` gave.
    """
    x_label, y_label = (str(one) for one in content["labels"])
    low, high = (float(one) for one in content["limits"])
    width, height = (float(one) for one in content["size"])
    logarithmic, tells = bool(content["logarithmic"]), str(content["height"])
    looks = {_CELLS: Look(_CELLS, INK, CELLS), _SECTION: Look(_SECTION, "#D55E00")}
    cases = []
    for stored in content["cases"]:
        marks = {}
        for label, (color, x, y) in stored["marks"].items():
            looks[label] = Look(label, color, points=True)
            marks[label] = (np.array([x]), np.array([y]))
        cells = unpacked(stored["cells"], "x"), unpacked(stored["cells"], "y")
        heights = unpacked(stored["cells"], "height")
        chosen = next(((float(x[0]), float(y[0])) for x, y in marks.values()), (np.nan, np.nan))
        # the page's own script fills in the sections
        empty: Curve = (np.empty(0), np.empty(0))
        curves = [{_CELLS: cells, _SECTION: empty, **marks}, {_SECTION: empty}, {_SECTION: empty}]
        heights = 10.0**heights if logarithmic else heights
        cases.append(Case(str(stored["title"]), curves, heights=heights, chosen=chosen))
    marked = Surface(
        _CELLS, _SECTION, x_label, y_label, tells, (low, high), (width, height), logarithmic
    )
    x, y = (np.concatenate([case.curves[0][_CELLS][i] for case in cases]) for i in (0, 1))
    panels = [
        Panel(
            tells,
            x_label,
            kind="surface",
            height=320,
            x_limits=(float(x.min() - width / 2), float(x.max() + width / 2)),
            y_limits=(float(y.min() - height / 2), float(y.max() + height / 2)),
        ),
        Panel(f"along {x_label}", x_label, group="x", height=200, logarithmic=logarithmic),
        Panel(f"along {y_label}", y_label, group="y", height=200, logarithmic=logarithmic),
    ]
    return Explorer(name, title, caption, "Surface of", looks, panels, cases, marked)


def _is_surface(axes: Axes) -> bool:
    """Return whether axes show one image of numbers over linear axes."""
    if axes.name != "rectilinear" or len(axes.images) != 1:
        return False
    values = axes.images[0].get_array()
    linear = {axes.get_xscale(), axes.get_yscale()} == {"linear"}
    return linear and values is not None and values.ndim == 2 and values.size <= _MOST_CELLS


def _labels(axes: list[Axes]) -> list[str]:
    """Return what stands on the horizontal and on the vertical axes."""
    return [
        next((text for one in axes if (text := getattr(one, get)())), "")
        for get in ("get_xlabel", "get_ylabel")
    ]


def _size(image: Any) -> list[float]:
    """Return width and height of a cell of an image."""
    left, right, bottom, top = image.get_extent()
    rows, columns = image.get_array().shape
    return [abs(right - left) / columns, abs(top - bottom) / rows]


def _stored(
    axes: Axes, drawn: list[tuple[str, Look, Curve]], words: Callable[[str], str]
) -> dict[str, Any]:
    """Return the cells of one surface and the marks upon it."""
    from matplotlib.colors import LogNorm

    image = axes.images[0]
    values: np.ndarray = np.ma.filled(np.ma.asarray(image.get_array(), dtype=float), np.nan)
    left, right, bottom, top = image.get_extent()
    rows, columns = values.shape
    x = left + (np.arange(columns) + 0.5) * (right - left) / columns
    y = bottom + (np.arange(rows) + 0.5) * (top - bottom) / rows
    y = y if image.origin == "lower" else y[::-1]
    x, y = (one.ravel() for one in np.meshgrid(x, y))
    if isinstance(image.norm, LogNorm):
        # a factor takes as many steps of what is stored at every height
        values = np.log10(np.where(values > 0, values, np.nan))
    # a cell without a height is not drawn
    known = np.isfinite(values.ravel())
    cells = {"x": x[known], "y": y[known], "height": values.ravel()[known]}
    titles = [axes.get_title(side) for side in ("left", "center", "right")]
    marks = {
        look.label: [look.color, float(curve[0][0]), float(curve[1][0])]
        for _, look, curve in drawn
        if look.points and len(curve[0]) == 1
    }
    return {
        "title": " ".join(words(one) for one in titles if one),
        "cells": packed(cells),
        "marks": marks,
    }
