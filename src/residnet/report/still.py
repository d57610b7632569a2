"""Static images of figures, drawn with matplotlib, for print and for the run folder."""

from __future__ import annotations

import io
import math
import re
import textwrap
from collections.abc import Mapping, Sequence
from html import escape
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from residnet.core.files import atomic_write
from residnet.core.format import format_exponents
from residnet.report.figure import TEXT_COLOR, Case, Figure, GlyphStyle, split_at_gaps

DPI = 120
"""Dots per inch: images are 840 pixels wide, nearly as wide as the page."""
FIGURE_WIDTH = 7.0
"""Width of every image in inches: the text width of an A4 page, so that 9 pt text prints at 9
pt.
"""
INLINE_WIDTH = 3.7
"""Width in inches of a drawing at the top of a page: that of a phone, where text has 11 px."""
_INLINE_MAP_HEIGHT = 1.5
"""Height in inches of a map in a drawing of the first screen."""
_MAX_INLINE_WIDTH = 5.0
"""Width in inches to which a drawing grows on a large screen."""
_MAP_HEIGHT = 4.2
"""Height of a row of maps in inches."""
_LEGEND_LINE_HEIGHT = 0.17
"""Height of a line of the legend in inches."""
_MAX_LABELLED_RATIO = 30.0
"""Ratio of the limits of a logarithmic axis up to which ticks between powers of ten have labels:
more would overlap in a panel of two centimetres.
"""
if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Canvas

_DASHES: dict[str, Any] = {
    "solid": "-",
    "dashed": "--",
    "dotted": ":",
    "dashdot": "-.",
    "long": (0, (6, 1.5)),
    "short": (0, (2, 1)),
    "dense": (0, (4, 1, 1, 1)),
}
"""Line styles of matplotlib by the names of the line styles of `GlyphStyle`."""
# Any: matplotlib types the keys as a closed set of literals
RC_PARAMS: Any = {
    # names of logs may hold a dollar sign
    "text.parse_math": False,
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
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


def render_matplotlib(
    figure: Figure,
    case: Case | None = None,
    panel_numbers: Sequence[int] = (),
    width: float = FIGURE_WIDTH,
    map_height: float = 0.0,
    *,
    is_rasterized: bool = True,
) -> Canvas:
    """Return a matplotlib figure of a case: maps in one row, other panels below.

    Args:
        figure: the figure.
        case: a case of the figure; the first one if None.
        panel_numbers: numbers of the panels to draw; all if empty.
        width: width in inches.
        map_height: height of a row of maps in inches; 0 for a height in proportion to the width.
        is_rasterized: whether to draw the pixels, too; a vector graphic needs the layout only.
    """
    from matplotlib import rc_context
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Canvas

    case = case or figure.cases[0]
    shown_panels = list(panel_numbers) or [
        i for i, panel_curves in enumerate(case.curves) if panel_curves
    ]
    maps = [i for i in shown_panels if figure.panels[i].kind == "map"]
    other_panels = [i for i in shown_panels if figure.panels[i].kind != "map"]
    columns = min(figure.columns, max(len(other_panels), 1))
    n_lines = -(-len(other_panels) // columns)
    heights = [
        max(figure.panels[i].height for i in other_panels[columns * k : columns * (k + 1)]) / 110
        for k in range(n_lines)
    ]
    n_map_columns = max(len(maps), 1)
    map_height = map_height or width / FIGURE_WIDTH * (_MAP_HEIGHT if len(maps) < 3 else 3.0)
    map_lines = [map_height] if maps else []
    with rc_context(RC_PARAMS):
        canvas = Canvas(
            figsize=(width, 0.5 + sum([*map_lines, *heights])), dpi=DPI, layout="constrained"
        )
        FigureCanvasAgg(canvas)
        grid = canvas.add_gridspec(
            len(map_lines) + n_lines, n_map_columns * columns, height_ratios=[*map_lines, *heights]
        )
        handles: dict[str, Artist] = {}
        for position, number in enumerate(maps):
            cell = grid[0, columns * position : columns * (position + 1)]
            _draw_panel(canvas.add_subplot(cell), figure, case, number, handles)
        shared: dict[str, Axes] = {}
        for position, number in enumerate(other_panels):
            line, column = divmod(position, columns)
            cell = grid[
                len(map_lines) + line, n_map_columns * column : n_map_columns * (column + 1)
            ]
            panel = figure.panels[number]
            panel_below = other_panels[position + columns : position + columns + 1]
            group = f"{panel.group}{column if panel.x_limits else ''}"
            axes = canvas.add_subplot(cell, sharex=shared.get(group))
            shared.setdefault(group, axes)
            _draw_panel(axes, figure, case, number, handles)
            if panel_below and figure.panels[panel_below[0]].group == panel.group:
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
        canvas.align_ylabels()
        labels = dict.fromkeys(style.label for style in figure.styles.values())
        shown_handles = {label: handles[label] for label in labels if label in handles}
        n_legend_lines = _legend_above(canvas, shown_handles, width)
        # the height includes a legend of two lines; more of them would cover the panels
        extra_height = _LEGEND_LINE_HEIGHT * max(n_legend_lines - 2, 0)
        canvas.set_figheight(canvas.get_figheight() + extra_height)
        draw = canvas.canvas.draw if is_rasterized else canvas.draw_without_rendering
        draw()
        is_changed = _wrap_axis_labels(canvas)
        if _remove_overlapping_ticks(canvas) or is_changed:
            draw()
    return canvas


def _remove_overlapping_ticks(canvas: Canvas) -> bool:
    """Remove every second tick of vertical axes whose tick labels overlap; return if any does.

    The automatic ticks of a low panel are at least two intervals apart, for which the height of
    their labels may be too large. Ticks with given names are not changed.
    """
    from matplotlib.ticker import MaxNLocator

    is_changed = False
    for axes in canvas.axes:
        if not isinstance(axes.yaxis.get_major_locator(), MaxNLocator):
            continue
        lower, upper = sorted(axes.get_ylim())
        labels = axes.yaxis.get_ticklabels()
        ticks = [
            (float(tick), label.get_window_extent())
            for tick, label in zip(axes.yaxis.get_majorticklocs(), labels, strict=False)
            if lower <= tick <= upper and label.get_text()
        ]
        extents = sorted((extent.y0, extent.y1) for _, extent in ticks)
        # a browser may have a slightly larger font
        has_overlap = any(
            above[0] - below[1] < 0.2 * (below[1] - below[0]) for below, above in pairwise(extents)
        )
        if has_overlap and len(ticks) > 2:
            axes.set_yticks([tick for tick, _ in ticks[::2]])
            is_changed = True
    return is_changed


def _wrap_axis_labels(canvas: Canvas) -> bool:
    """Break labels of axes that are longer than the space of their panel; return if any is.

    Only a drawn label has a length. The label of a horizontal axis may be wider than the axis,
    because it is centred below it; the label of a vertical axis must not reach the next panel.
    """
    is_wrapped = False
    for axes in canvas.axes:
        x_extent = axes.xaxis.label.get_window_extent()
        y_extent = axes.yaxis.label.get_window_extent()
        grid_spec = axes.get_subplotspec()
        assert grid_spec is not None
        column_width = canvas.bbox.width / grid_spec.get_gridspec().ncols
        center = (x_extent.x0 + x_extent.x1) / 2
        half_space = min(
            center - column_width * grid_spec.colspan.start,
            column_width * grid_spec.colspan.stop - center,
        )
        for label, length, space in (
            (axes.xaxis.label, x_extent.width, 2 * half_space),
            (axes.yaxis.label, y_extent.height, axes.bbox.height),
        ):
            text = label.get_text()
            if text and 0 < space < length:
                # words differ in width, and a broken label of the other axis moves this one
                n_characters = max(int(0.85 * len(text) * space / length), 1)
                lines = textwrap.wrap(text, n_characters, break_long_words=False)
                label.set_text("\n".join(lines))
                is_wrapped = is_wrapped or len(lines) > 1
    return is_wrapped


def draw_on_axes(figure: Figure, axes: Sequence[Axes], panel_numbers: Sequence[int]) -> None:
    """Draw panels of the first case on axes of the caller, in the style of the caller.

    Curves have labels, so that `legend()` of the axes lists them.

    Args:
        figure: the figure.
        axes: matplotlib axes, one for each panel.
        panel_numbers: numbers of the panels.
    """
    for panel_axes, number in zip(axes, panel_numbers, strict=True):
        handles: dict[str, Artist] = {}
        _draw_panel(panel_axes, figure, figure.cases[0], number, handles)
        for label, handle in handles.items():
            handle.set_label(label)


def _draw_panel(
    axes: Axes, figure: Figure, case: Case, number: int, handles: dict[str, Artist]
) -> None:
    """Draw one panel of a case.

    Args:
        axes: Matplotlib axes.
        figure: figure with the panel.
        case: case whose curves are drawn.
        number: index of the panel.
        handles: receives the legend handle of each label.
    """
    from matplotlib.ticker import MaxNLocator

    panel = figure.panels[number]
    for name in figure.curve_names(number):
        style = figure.styles[name]
        if name in case.curves[number] and style.is_visible:
            x, y = (np.asarray(values, dtype=float) for values in case.curves[number][name])
            handle = _draw_curve(axes, style, x, y)
            if style.label and handle is not None and np.isfinite(x).any():
                handles.setdefault(style.label, handle)
    axes.set_title(panel.title)
    axes.set(xlabel=format_exponents(panel.x_label), ylabel=format_exponents(panel.y_label))
    if panel.kind == "map":
        axes.set_aspect("equal", adjustable="datalim")
        axes.margins(0.08)
        axes.locator_params(axis="x", nbins=6)
    _format_axis(axes, "x", panel.x_log, panel.x_limits, panel.x_names)
    _format_axis(axes, "y", panel.y_log, panel.y_limits, panel.y_names)
    if not panel.x_names and not panel.x_log and figure.has_integer_axis(number):
        locator = axes.xaxis.get_major_locator()
        if isinstance(locator, MaxNLocator):
            locator.set_params(integer=True)
    for panel_number, x_position, y_position, text in case.texts:
        if panel_number == number:
            # a text without a height is placed at the top of the panel
            is_at_top = not np.isfinite(y_position)
            axes.annotate(
                text,
                (x_position, 1.0 if is_at_top else y_position),
                (0 if is_at_top else 3, 2),
                fontsize=7.5,
                color="0.25",
                xycoords=("data", "axes fraction") if is_at_top else "data",
                textcoords="offset points",
                ha="center" if is_at_top else "left",
            )


def _format_axis(
    axes: Axes,
    direction: Literal["x", "y"],
    is_logarithmic: bool,
    limits: Sequence[float],
    tick_names: Mapping[str, str],
) -> None:
    """Set the scale, the named ticks and the limits of one axis of a panel."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    if is_logarithmic:
        getattr(axes, f"set_{direction}scale")("log")
        axis = axes.xaxis if direction == "x" else axes.yaxis

        def format_minor_tick(value: float, _: int) -> str:
            lower, upper = sorted(axis.get_view_interval())
            n_powers = math.floor(math.log10(upper)) - math.ceil(math.log10(lower)) + 1
            # a single label has no scale
            is_labelled = upper < _MAX_LABELLED_RATIO * lower or n_powers < 2
            return f"{value:g}" if is_labelled else ""

        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(LogLocator(subs=(2.0, 5.0)))
        axis.set_minor_formatter(FuncFormatter(format_minor_tick))
    if tick_names:
        # long names overlap side by side
        tick_style = (
            {"rotation": 60, "ha": "right", "fontsize": 7}
            if direction == "x" and sum(map(len, tick_names.values())) > 40
            else {}
        )
        getattr(axes, f"set_{direction}ticks")(
            [float(tick) for tick in tick_names], list(tick_names.values()), **tick_style
        )
        axes.grid(visible=False, axis=direction)
    if limits:
        getattr(axes, f"set_{direction}lim")(*limits)


def _draw_curve(axes: Axes, style: GlyphStyle, x: np.ndarray, y: np.ndarray) -> Artist | None:
    """Draw one named curve and return its legend handle."""
    color = "black" if style.color == TEXT_COLOR else style.color
    line: dict[str, Any] = {"color": color, "alpha": style.alpha, "zorder": style.z_order}
    stroke = {**line, "linestyle": _DASHES[style.dash], "linewidth": style.width}
    if style.kind == "points":
        face_color = (
            "white"
            if style.is_hollow and style.z_order > 5
            else "none"
            if style.is_hollow
            else color
        )
        return axes.plot(
            x, y, style.marker, **line, markersize=style.size, markerfacecolor=face_color
        )[0]
    if style.kind == "line":
        return axes.plot(x, y, **stroke)[0]
    artist: Artist | None = None
    if style.kind == "fill":
        for curve_part in split_at_gaps(x, y):
            artist = axes.fill(*curve_part, **line, linewidth=0)[0]
        return artist
    lower: float
    upper: float
    for lower, upper in zip(x, y, strict=True):
        if style.kind == "vspan" and np.isfinite(lower):
            artist = axes.axvspan(lower, upper, **line, linewidth=0)
        elif style.kind != "vspan" and np.isfinite(lower) and np.isfinite(upper):
            artist = (
                axes.axhline(upper, **stroke)
                if style.kind == "hline"
                else axes.axvline(lower, **stroke)
            )
    return artist


def _legend_above(canvas: Canvas, handles: Mapping[str, Artist], width: float) -> int:
    """Place a legend above the panels, with the largest number of columns that fit.

    A legend that would be a long column has a smaller font. Returns the number of lines.
    """
    if not handles:
        return 0
    n_columns = _count_legend_columns(list(handles), width, sample_width=46.0, character_width=4.9)
    font: dict[str, Any] = {}
    if n_columns == 1 and len(handles) > 4:
        font = {"fontsize": 8, "handlelength": 2.0, "columnspacing": 1.0}
        n_columns = _count_legend_columns(
            list(handles), width, sample_width=34.0, character_width=4.4
        )
    canvas.legend(
        handles.values(), handles.keys(), loc="outside upper center", ncols=n_columns, **font
    )
    return -(-len(handles) // n_columns)


def _count_legend_columns(
    labels: Sequence[str], width: float, sample_width: float, character_width: float
) -> int:
    """Return the largest number of columns of a legend that fit into a width in inches.

    Args:
        labels: the texts.
        width: width of the figure in inches.
        sample_width: width of the sample and its spaces in points.
        character_width: mean width of a character in points.
    """
    widths = [sample_width + character_width * len(text) for text in labels]
    n_columns = len(widths)
    # matplotlib fills a legend column by column
    while (
        n_columns > 1
        and sum(max(part) for part in np.array_split(np.array(widths), n_columns)) > 72.0 * width
    ):
        n_columns -= 1
    return n_columns


def draw_svg(figure: Figure) -> str:
    """Draw the first case of a figure as an SVG element, for the first screen of a page.

    The element has no fixed size: it is as wide as its container, up to a limit. Texts
    are text, so that a reader can search and enlarge them.
    """
    from matplotlib import rc_context

    canvas = render_matplotlib(
        figure, width=INLINE_WIDTH, map_height=_INLINE_MAP_HEIGHT, is_rasterized=False
    )
    stream = io.StringIO()
    with rc_context({"svg.fonttype": "none"}):
        canvas.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    body = text[text.index(">", text.index("<svg")) + 1 :]
    body = re.sub(r"<metadata>.*?</metadata>", "", body, flags=re.DOTALL)
    # identifiers of groups repeat in every drawing and are not referred to
    body = re.sub(r'<g id="[^"]*"', "<g", body).replace("xlink:href", "href")
    # identifiers of clip paths and markers are random; numbers make the page reproducible
    for number, identifier in enumerate(dict.fromkeys(re.findall(r' id="([^"]+)"', body))):
        body = re.sub(
            rf'(["#]){re.escape(identifier)}(["\)])', rf"\1{figure.html_id}-{number}\2", body
        )
    width, height = (72.0 * size for size in canvas.get_size_inches())
    return (
        f'<svg viewBox="0 0 {width:g} {height:g}" style="max-width: {_MAX_INLINE_WIDTH:g}in"'
        f' role="img" aria-label="{escape(figure.title)}">{body.strip()}'
    )


def save_png(canvas: Canvas, path: Path, title: str, caption: str) -> None:
    """Write a PNG with title and caption as text metadata.

    A palette of 128 colours needs a third of the bytes. It is chosen by coverage of the colour
    space: a palette chosen by frequency would change the colours of thin lines.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    assert isinstance(canvas.canvas, FigureCanvasAgg)
    # Any: matplotlib does not type the method
    pixels: Any = canvas.canvas.buffer_rgba()  # type: ignore[no-untyped-call]
    picture = (
        Image.fromarray(np.asarray(pixels))
        .convert("RGB")
        .quantize(128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    )
    metadata = PngInfo()
    metadata.add_itxt("Title", title)
    metadata.add_itxt("Description", caption)
    with atomic_write(path) as file:
        # the highest level takes seven times as long for a tenth of the bytes
        picture.save(file, format="PNG", compress_level=6, dpi=(DPI, DPI), pnginfo=metadata)
