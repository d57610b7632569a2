"""Interactive figures with Bokeh: panels of a page, and the data of their cases as JSON.

The script of the page (`templates/explorer.js`) fills in the data of the selected case.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.format import format_exponents
from residnet.report.figure import TEXT_COLOR, Case, Figure, GlyphStyle
from residnet.report.figure_files import pack_columns

if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource, DataRange1d, Range1d
    from bokeh.models.renderers.renderer import DataRenderer
    from bokeh.plotting import figure as Canvas

_FONT = "12px"
_LETTER_WIDTH = 6.5
"""Width in pixels of a letter in this font."""
_MIN_PANEL_WIDTH = 260.0
"""Smallest width in pixels of the area between the axes of a panel, on a phone."""
_DASHES: dict[str, Any] = {"long": [10, 4], "short": [4, 3], "dense": [8, 3, 2, 3, 2, 3]}
"""Lengths in pixels of dashes and gaps by the names of the line styles of `GlyphStyle`."""
_MARKERS = {"o": "circle", "s": "square", "x": "x", "^": "triangle"}


@dataclass(frozen=True)
class InteractiveFigures:
    """The interactive figures of a page.

    Attributes:
        figures: panels and cases of each figure as JSON, with curves in base 64, by `html_id`.
        library: code of BokehJS, so that the page loads no other files.
    """

    figures: dict[str, str]
    library: str


def render_bokeh(figures: Sequence[Figure]) -> InteractiveFigures | None:
    """Render interactive figures; the script of the page lays them out when they become visible.

    Returns None if there are no figures.
    """
    if not figures:
        return None
    from bokeh.resources import Resources

    library = Resources(mode="inline", components=["bokeh"], minified=True).js_raw
    return InteractiveFigures(
        {figure.html_id: _figure_json(figure) for figure in figures}, "\n".join(library)
    )


def _build_canvases(figure: Figure) -> list[Canvas]:
    """Return the Bokeh panels; panels of kind `curves` share a horizontal axis and a cursor."""
    from bokeh import models
    from bokeh.models.annotations import Span

    groups: dict[str, DataRange1d | Range1d] = {}
    cursor = Span(dimension="height", line_dash="dotted", line_width=1)
    canvases = []
    for number, panel in enumerate(figure.panels):
        # the script of the page fills in the first case, so that its values are stored only once
        columns: dict[str, Any] = {
            name: [] for name in _panel_columns(figure, figure.cases[0], number)
        }
        group = panel.group if panel.kind == "curves" else f"{number} alone"
        shared_range = groups.setdefault(group, _axis_range(panel.x_limits))
        canvas = _build_canvas(figure, number, shared_range, models.ColumnDataSource(columns))
        if panel.kind == "curves":
            canvas.add_tools(models.CrosshairTool(dimensions="height", overlay=cursor))
        canvases.append(canvas)
    return canvases


def _axis_range(limits: Sequence[float]) -> DataRange1d | Range1d:
    """Return the range of an axis: the given limits, or the limits of all visible curves."""
    from bokeh.models import DataRange1d, Range1d

    return Range1d(start=limits[0], end=limits[1]) if limits else DataRange1d(only_visible=True)


def _build_canvas(
    figure: Figure, number: int, x_range: DataRange1d | Range1d, source: ColumnDataSource
) -> Canvas:
    """Return the Bokeh canvas of one panel of a figure.

    Args:
        figure: figure with the panel.
        number: index of the panel.
        x_range: Bokeh range of the x axis, shared by panels with a common axis.
        source: data source of all curves.
    """
    from bokeh import models
    from bokeh.models.annotations import Title
    from bokeh.plotting import figure as new_canvas

    panel = figure.panels[number]
    canvas = new_canvas(
        name=f"{figure.html_id}-{number}",
        title=Title(text=panel.heading, text_font_size=_FONT),
        height=panel.height,
        sizing_mode="stretch_width",
        toolbar_location=None,
        tools=[],
        # so that time axes are aligned
        min_border_left=68,
        min_border_right=12,
        output_backend="canvas",
        x_range=x_range,
        y_range=_axis_range(panel.y_limits),
        match_aspect=panel.kind == "map",
        x_axis_type="log" if panel.x_log else "linear",
        y_axis_type="log" if panel.y_log else "linear",
    )
    # the page scrolls under a finger; dragging zooms only after a button was pressed
    canvas.stylesheets = [":host .bk-events { touch-action: pan-y pinch-zoom; }"]
    renderers = {
        name: _build_renderer(name, figure.styles[name], source)
        for name in figure.curve_names(number)
    }
    canvas.renderers.extend(renderers.values())
    # with named positions on an axis the name of a point identifies it
    shows_values = panel.kind == "curves" and not panel.y_names
    tooltips: Any = [("$name", "@$name{0.000 a}")] if shows_values else [("", "$name")]
    hover = models.HoverTool(
        renderers=[
            renderer
            for name, renderer in renderers.items()
            if figure.styles[name].kind in ("line", "points")
        ],
        mode="vline" if shows_values else "mouse",
        tooltips=tooltips,
        point_policy="follow_mouse",
    )
    if shows_values and panel.si_unit:
        unit, factor = panel.si_unit
        unit_formatter = models.CustomJSHover(
            args={"unit": unit, "factor": factor},
            code="return `${+value.toPrecision(4)} (${+(value / factor).toPrecision(4)} ${unit})`",
        )
        hover.tooltips = [("$name", "@$name{custom}")]
        hover.formatters = {f"@{{{name}}}": unit_formatter for name in figure.curve_names(number)}
    canvas.add_tools(hover, models.BoxZoomTool(match_aspect=panel.kind == "map"))
    canvas.toolbar.active_drag = None
    canvas.xaxis.axis_label = format_exponents(panel.x_label) or None
    for axis, names, log, count in (
        (canvas.yaxis[0], panel.y_names, panel.y_log, 4),
        (canvas.xaxis[0], panel.x_names, panel.x_log, 5),
    ):
        axis.update(
            major_label_text_font_size=_FONT,
            axis_label_text_font_size=_FONT,
            axis_label_text_font_style="normal",
        )
        if names:
            axis.ticker = models.FixedTicker(ticks=[float(tick) for tick in names])
            axis.major_label_overrides = {float(tick): text for tick, text in names.items()}
            continue
        # in a low panel, and between powers of ten, labels would lie on each other
        axis.major_label_policy = models.NoOverlap(min_distance=2)
        if not log:
            step = 1.0 if count == 5 and figure.has_integer_axis(number) else 0.0
            axis.ticker = models.BasicTicker(desired_num_ticks=count, min_interval=step)
    lines = [line for name in panel.x_names.values() for line in name.splitlines() or [""]]
    if _LETTER_WIDTH * max(map(len, lines), default=0) * len(panel.x_names) > _MIN_PANEL_WIDTH:
        # long names are vertical, on a phone only those with enough room
        policy = models.NoOverlap(min_distance=2)
        canvas.xaxis[0].update(major_label_orientation="vertical", major_label_policy=policy)
    return canvas


def _build_renderer(name: str, style: GlyphStyle, source: ColumnDataSource) -> DataRenderer:
    """Return the Bokeh renderer of a named curve; the caller adds it to a panel."""
    from bokeh import models
    from bokeh.models.renderers import GlyphRenderer

    color = "#808080" if style.color == TEXT_COLOR else style.color
    x = f"x of {name}"
    # a faint colour that prints well needs more opacity on a screen
    alpha = max(style.alpha, 0.25)
    fill: dict[str, Any] = {"fill_color": color, "fill_alpha": alpha, "line_color": None}
    line: dict[str, Any] = {
        "line_color": color,
        "line_alpha": alpha,
        "line_dash": _DASHES.get(style.dash, style.dash),
        "line_width": min(max(1.2 * style.width, 0.8), 2.4),
    }
    glyph: Any
    if style.kind == "points":
        marker: dict[str, Any] = {"marker": _MARKERS[style.marker], "size": max(style.size, 4)}
        if style.is_hollow or style.marker == "x":
            marker |= {"fill_color": None, "line_color": color}
        else:
            marker |= {"fill_color": color, "line_color": None, "fill_alpha": alpha}
        glyph = models.Scatter(x=x, y=name, **marker)
    elif style.kind == "fill":
        glyph = models.Patch(x=x, y=name, **fill)
    elif style.kind == "vspan":
        glyph = models.VStrip(x0=x, x1=name, **fill)
    elif style.kind == "hline":
        glyph = models.HSpan(y=name, **line)
    elif style.kind == "vline":
        glyph = models.VSpan(x=x, **line)
    else:
        glyph = models.Line(x=x, y=name, **line)
    return GlyphRenderer(data_source=source, glyph=glyph, name=name, visible=style.is_visible)


def _panel_columns(figure: Figure, case: Case, panel: int) -> dict[str, np.ndarray]:
    """Return the columns of the data source of a panel; shorter curves are padded with gaps."""
    traces = case.curves[panel]
    max_length = max((len(x) for x, _ in traces.values()), default=0)
    columns: dict[str, np.ndarray] = {}
    for name in figure.curve_names(panel):
        x, y = traces.get(name, (np.empty(0), np.empty(0)))
        columns |= {f"x of {name}": x, name: y}
    for name, values in columns.items():
        columns[name] = np.full(max_length, np.nan)
        columns[name][: len(values)] = values
    return columns


def _figure_json(figure: Figure) -> str:
    """Return a figure as JSON for the script of the page."""
    from bokeh.document import Document

    # models are numbered in their order, so that the same run has the same page
    document = Document()
    panels = _build_canvases(figure)
    for panel in panels:
        document.add_root(panel)
    names: dict[str, str] = {}
    text = json.dumps(document.to_json(deferred=False))
    for number, panel in enumerate(panels):
        names[panel.id] = f"{figure.html_id}-root-{number}"
    text = re.sub(
        r"(?<=\")p\d{4,}(?=\")",
        lambda match: names.setdefault(match[0], f"{figure.html_id}-{len(names)}"),
        text,
    )
    root_elements = {
        f"{figure.html_id}-root-{i}": f"{figure.html_id}-{i}-panel" for i in range(len(panels))
    }
    item = {"docid": figure.html_id, "roots": root_elements, "root_ids": list(root_elements)}
    content = {
        **{"documents": {figure.html_id: json.loads(text)}, "items": [item]},
        "looks": {
            name: {"color": style.color, "shown": style.is_visible}
            for name, style in figure.styles.items()
        },
        "panels": len(figure.panels),
        "cases": [
            {
                "title": case.title,
                "note": case.note,
                "panels": [
                    pack_columns(_panel_columns(figure, case, number))
                    for number in range(len(figure.panels))
                ],
            }
            for case in figure.cases
        ],
    }
    return json.dumps(content, separators=(",", ":"))
