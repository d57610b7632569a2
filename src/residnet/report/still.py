"""Figures drawn by matplotlib, for print and for whoever lists a run folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from residnet.core.files import whole
from residnet.core.format import powers
from residnet.report.figure import INK, Case, Figure, Look, parts

DPI = 140
"""Dots per inch: pictures are 980 dots wide, nearly as wide as the page."""
WIDTH = 7.0
"""Width of every picture in inches: the text block of an A4 page, so that 9 pt stay 9 pt."""
_MAP = 4.2
"""Height of a line of maps in inches."""
_DASHES: dict[str, Any] = {
    "solid": "-",
    "dashed": "--",
    "dotted": ":",
    "dashdot": "-.",
    "long": (0, (6, 1.5)),
    "short": (0, (2, 1)),
    "dense": (0, (4, 1, 1, 1)),
}
# Any: matplotlib types the keys as a closed set of literals
RC: Any = {
    # names of logs may hold a dollar sign
    "text.parse_math": False,
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 9,
    "legend.frameon": False,
    "legend.handlelength": 2.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "grid.color": "0.9",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "figure.facecolor": "white",
    "path.simplify": True,
}


def still(figure: Figure, case: Case | None = None, only: Sequence[int] = ()) -> Any:
    """Return a matplotlib figure of a case: maps beside each other, other panels below.

    Args:
        case: one of the figure's, its first where None.
        only: numbers of the panels that are drawn, all where empty.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    case = case or figure.cases[0]
    shown = list(only) or [i for i, curves in enumerate(case.curves) if curves]
    maps = [i for i in shown if figure.panels[i].kind == "map"]
    rest = [i for i in shown if figure.panels[i].kind != "map"]
    columns = min(figure.columns, max(len(rest), 1))
    lines = -(-len(rest) // columns)
    heights = [
        max(figure.panels[i].height for i in rest[columns * k : columns * (k + 1)]) / 110
        for k in range(lines)
    ]
    across = max(len(maps), 1)
    map_lines = [_MAP if len(maps) < 3 else 3.0] if maps else []
    with rc_context(RC):
        canvas = Canvas(
            figsize=(WIDTH, 0.5 + sum([*map_lines, *heights])), dpi=DPI, layout="constrained"
        )
        FigureCanvasAgg(canvas)
        grid = canvas.add_gridspec(
            len(map_lines) + lines, across * columns, height_ratios=[*map_lines, *heights]
        )
        handles: dict[str, Any] = {}
        for place, number in enumerate(maps):
            cell = grid[0, columns * place : columns * (place + 1)]
            _draw(canvas.add_subplot(cell), figure, case, number, handles)
        shared: dict[str, Any] = {}
        for place, number in enumerate(rest):
            line, column = divmod(place, columns)
            cell = grid[len(map_lines) + line, across * column : across * (column + 1)]
            panel, below = figure.panels[number], rest[place + columns : place + columns + 1]
            group = f"{panel.group}{column if panel.x_limits else ''}"
            axes = canvas.add_subplot(cell, sharex=shared.get(group))
            shared.setdefault(group, axes)
            _draw(axes, figure, case, number, handles)
            if below and figure.panels[below[0]].group == panel.group:
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
        canvas.align_ylabels()
        labels = dict.fromkeys(look.label for look in figure.looks.values())
        _legend_above(canvas, {label: handles[label] for label in labels if label in handles})
        canvas.canvas.draw()
    return canvas


def _draw(axes: Any, figure: Figure, case: Case, number: int, handles: dict[str, Any]) -> None:
    from matplotlib.ticker import LogFormatter

    panel = figure.panels[number]
    for name in figure.names(number):
        look = figure.looks[name]
        if name in case.curves[number] and look.shown:
            x, y = (np.asarray(values, dtype=float) for values in case.curves[number][name])
            handle = _mark(axes, look, x, y)
            if look.label and handle is not None and np.isfinite(x).any():
                handles.setdefault(look.label, handle)
    axes.set_title(panel.title)
    axes.set(xlabel=powers(panel.x_label), ylabel=powers(panel.y_label))
    if panel.kind == "map":
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.locator_params(axis="x", nbins=6)
    for direction, log, limits, names in (
        ("x", panel.x_log, panel.x_limits, panel.x_names),
        ("y", panel.y_log, panel.y_limits, panel.y_names),
    ):
        if log:
            getattr(axes, f"set_{direction}scale")("log")
            axis = axes.xaxis if direction == "x" else axes.yaxis
            axis.set_major_formatter(LogFormatter())
            axis.set_minor_formatter(LogFormatter(minor_thresholds=(2, 0.6)))
        if names:
            ticks = (
                {"rotation": 60, "ha": "right", "fontsize": 7}
                if direction == "x" and sum(map(len, names.values())) > 40
                else {}
            )
            getattr(axes, f"set_{direction}ticks")(
                [float(one) for one in names], list(names.values()), **ticks
            )
            axes.grid(visible=False, axis=direction)
        if limits:
            getattr(axes, f"set_{direction}lim")(*limits)
    if not panel.x_names and not panel.x_log and figure.counts(number):
        axes.xaxis.get_major_locator().set_params(integer=True)
    for place, at, level, words in case.texts:
        if place == number:
            high = not np.isfinite(level)
            axes.annotate(
                words, (at, 1.0 if high else level), (0 if high else 3, 2),
                fontsize=7.5, color="0.25",
                xycoords=("data", "axes fraction") if high else "data", textcoords="offset points",
                ha="center" if high else "left",
            )  # fmt: skip


def _mark(axes: Any, look: Look, x: np.ndarray, y: np.ndarray) -> Any:
    """Draw what bears one name, and return what stands for it in the legend."""
    color = "black" if look.color == INK else look.color
    line = {"color": color, "alpha": look.alpha, "zorder": look.order}
    stroke = {**line, "linestyle": _DASHES[look.dash], "linewidth": look.width}
    if look.kind == "points":
        face = "white" if look.hollow and look.order > 5 else "none" if look.hollow else color
        return axes.plot(x, y, look.marker, **line, markersize=look.size, markerfacecolor=face)[0]
    if look.kind == "line":
        return axes.plot(x, y, **stroke)[0]
    drawn = None
    if look.kind == "fill":
        for piece in parts(x, y):
            drawn = axes.fill(*piece, **line, linewidth=0)[0]
        return drawn
    low: float
    high: float
    for low, high in zip(x, y, strict=True):
        if look.kind == "strip" and np.isfinite(low):
            drawn = axes.axvspan(low, high, **line, linewidth=0)
        elif look.kind != "strip" and np.isfinite(low) and np.isfinite(high):
            drawn = (
                axes.axhline(high, **stroke)
                if look.kind == "across"
                else axes.axvline(low, **stroke)
            )
    return drawn


def _legend_above(canvas: Any, handles: dict[str, Any]) -> None:
    """Put one legend above the panels, in as many columns as the width holds."""
    # in points: the sample and its spaces, then the text at 9 pt
    widths = [46.0 + 4.9 * len(text) for text in handles]
    columns = max(len(widths), 1)
    # matplotlib fills a legend column by column
    while (
        columns > 1
        and sum(max(part) for part in np.array_split(np.array(widths), columns)) > 72.0 * WIDTH
    ):
        columns -= 1
    if handles:
        canvas.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=columns)


def save(canvas: Any, path: Path, title: str, caption: str) -> None:
    """Write a PNG that carries its title and caption as text.

    Its palette of 128 colours takes a third of the bytes; chosen by coverage, it keeps the thin
    lines' own colours, which a palette chosen by frequency would mix.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    picture = (
        Image.fromarray(np.asarray(canvas.canvas.buffer_rgba()))
        .convert("RGB")
        .quantize(128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    )
    words = PngInfo()
    words.add_itxt("Title", title)
    words.add_itxt("Description", caption)
    with whole(path) as file:
        # the highest level takes seven times as long for a tenth of the bytes
        picture.save(file, format="PNG", compress_level=6, dpi=(DPI, DPI), pnginfo=words)
