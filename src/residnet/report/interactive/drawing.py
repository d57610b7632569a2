"""Explorers drawn with Bokeh: the parts of a page and the data of their cases."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.report.interactive.explorer import CELLS, FILL, INK, Case, Explorer, Panel, Surface
from residnet.report.interactive.packing import packed

if TYPE_CHECKING:
    from bokeh.models import ColumnDataSource
    from bokeh.plotting import figure as Canvas

_FONT = "12px"
_RANDOM = re.compile(
    r"\b[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}\b|(?<=\")p\d{4,}(?=\")"
)
"""Names that Bokeh gives to the parts of a page and to its models."""
HEIGHT = "height of a cell"
"""Name of the column of a surface's heights; of their logarithms on a page where they are so."""
_MARGIN = 68
"""Pixels left of every panel, so that time axes stand under each other."""


@dataclass(frozen=True)
class Drawn:
    """What a page holds of its explorers.

    Attributes:
        parts: HTML of the panels of each explorer by its name.
        cases: the explorer's cases as JSON, curves in base 64, by its name.
        script: that draws all panels.
        library: BokehJS itself, so that the page loads nothing.
    """

    parts: dict[str, list[str]]
    cases: dict[str, str]
    script: str
    library: str


def draw(explorers: Sequence[Explorer]) -> Drawn | None:
    """Draw the explorers of a page; None where there are none."""
    if not explorers:
        return None
    from bokeh.embed import components
    from bokeh.model import Model
    from bokeh.resources import Resources

    canvases: dict[str, Model] = {
        f"{explorer.name}-{number}": canvas
        for explorer in explorers
        for number, canvas in enumerate(_panels(explorer))
    }
    script, given = components(canvases)
    script, *divisions = _numbered([script, *given.values()])
    parts = dict(zip(given, divisions, strict=True))
    library = Resources(mode="inline", components=["bokeh"], minified=True).render_js()
    return Drawn(
        {
            explorer.name: [
                parts[f"{explorer.name}-{number}"] for number in range(len(explorer.panels))
            ]
            for explorer in explorers
        },
        {explorer.name: _cases(explorer) for explorer in explorers},
        script,
        library,
    )


def _numbered(texts: Sequence[str]) -> list[str]:
    """Return texts whose random names are counted, so that the same run has the same page."""
    names: dict[str, str] = {}

    def counted(found: re.Match[str]) -> str:
        return names.setdefault(found[0], f"bokeh-{len(names)}")

    return [_RANDOM.sub(counted, text) for text in texts]


def _panels(explorer: Explorer) -> list[Canvas]:
    """Return the panels; those of curves share their horizontal axis and a cursor."""
    from bokeh.models import ColumnDataSource, CrosshairTool
    from bokeh.models.annotations import Span

    groups: dict[str, Any] = {}
    cursor = Span(dimension="height", line_dash="dotted", line_width=1)
    out = []
    for number, panel in enumerate(explorer.panels):
        # the page's own script fills in the first case: its values are there once
        columns: dict[str, Any] = {
            name: [] for name in _columns(explorer, explorer.cases[0], number)
        }
        shared = groups.setdefault(panel.group, _range(panel.x_limits))
        canvas = _canvas(explorer, panel, number, shared, ColumnDataSource(columns))
        if panel.kind == "curves":
            canvas.add_tools(CrosshairTool(dimensions="height", overlay=cursor))
        out.append(canvas)
    return out


def _range(limits: Sequence[float]) -> Any:
    """Return what an axis shows: given limits, else all curves that are switched on."""
    from bokeh.models import DataRange1d, Range1d

    if not limits:
        return DataRange1d(only_visible=True)
    return Range1d(start=limits[0], end=limits[1])


def _canvas(
    explorer: Explorer, panel: Panel, number: int, time_axis: Any, source: ColumnDataSource
) -> Canvas:
    from bokeh.models import (
        BasicTicker,
        BoxZoomTool,
        DataRange1d,
        FixedTicker,
        HoverTool,
        NoOverlap,
    )
    from bokeh.models.annotations import Title
    from bokeh.plotting import figure

    # what is switched off does not widen the axes
    options: dict[str, Any] = {
        "x_range": time_axis if panel.kind == "curves" else DataRange1d(only_visible=True),
        "y_range": _range(panel.y_limits),
    }
    if panel.kind == "map":
        options["match_aspect"] = True
    if panel.logarithmic:
        options["y_axis_type"] = "log"
    if panel.x_logarithmic:
        options["x_axis_type"] = "log"
    canvas = figure(
        name=f"{explorer.name}-{number}",
        title=Title(text=panel.title, text_font_size=_FONT),
        height=panel.height,
        sizing_mode="stretch_width",
        toolbar_location=None,
        tools=[],
        min_border_left=_MARGIN,
        min_border_right=12,
        output_backend="canvas",
        **options,
    )
    # the page scrolls under a finger; dragging zooms only after a button was pressed
    canvas.stylesheets = [":host .bk-events { touch-action: pan-y pinch-zoom; }"]
    over = [_curve(explorer, panel, name, source) for name in explorer.names(number)]
    canvas.renderers.extend(over)
    if panel.kind == "surface" and explorer.surface is not None:
        canvas.add_layout(_colours_told(explorer.surface, over), "right")
        canvas.yaxis.axis_label = explorer.surface.y_label or None
    # where a height stands for no number, the name alone says what a curve is
    told = panel.kind == "curves" and not panel.unnumbered
    hover = HoverTool(
        renderers=[curve for curve in over if explorer.looks[curve.name].dash != FILL],
        mode="vline" if told else "mouse",
        tooltips=_tips(explorer, panel, told),
        point_policy="follow_mouse",
    )
    canvas.add_tools(hover, BoxZoomTool(match_aspect=panel.kind == "map"))
    canvas.toolbar.active_drag = None
    canvas.xaxis.axis_label = panel.x_label or None
    for axis in canvas.axis:
        axis.major_label_text_font_size = _FONT
        axis.axis_label_text_font_size = _FONT
        axis.axis_label_text_font_style = "normal"
    ticks = (canvas.yaxis, panel.y_names, panel.logarithmic, 4)
    for axis, names, logarithmic, count in (
        ticks,
        (canvas.xaxis, panel.x_names, panel.x_logarithmic, 5),
    ):
        if names:
            axis.ticker = FixedTicker(ticks=[float(place) for place in names])
            axis.major_label_overrides = {float(place): text for place, text in names.items()}
        elif not logarithmic:
            axis.ticker = BasicTicker(desired_num_ticks=count)
    if panel.unnumbered:
        canvas.yaxis.visible = False
        canvas.ygrid.visible = False
        # long names of many axes stand upright, and on a phone those that have room
        canvas.xaxis.major_label_orientation = "vertical"
        canvas.xaxis.major_label_policy = NoOverlap(min_distance=2)
    if not panel.x_names and not panel.x_logarithmic and _counts(explorer, number):
        canvas.xaxis.ticker = BasicTicker(desired_num_ticks=5, min_interval=1.0)
    return canvas


def _tips(explorer: Explorer, panel: Panel, told: bool) -> Any:
    """Return what stands beside the pointer over a panel."""
    surface = explorer.surface
    if panel.kind == "surface" and surface is not None:
        height = f"@{{{HEIGHT}}}{{0.000 a}}"
        return [(surface.x_label, "$x{0}"), (surface.y_label, "$y{0}"), (surface.height, height)]
    return [("$name", "@$name{0.000 a}")] if told else [("", "$name")]


def _colours_told(surface: Surface, over: Sequence[Any]) -> Any:
    """Return the bar that tells what the colours of a surface mean."""
    from bokeh.models import BasicTicker, LogTicker
    from bokeh.models.annotations import ColorBar

    (cells,) = [one for one in over if one.name == surface.name]
    return ColorBar(
        color_mapper=cells.glyph.fill_color.transform,
        ticker=LogTicker(mantissas=[1, 3]) if surface.logarithmic else BasicTicker(),
        width=12,
        padding=4,
        background_fill_color=None,
        major_label_text_font_size=_FONT,
    )


def _cells(surface: Surface, name: str) -> Any:
    """Return the glyph of a surface's cells."""
    from bokeh.models import LinearColorMapper, LogColorMapper, Rect
    from bokeh.palettes import Viridis256

    mapper = LogColorMapper if surface.logarithmic else LinearColorMapper
    low, high = surface.limits
    shade: Any = {"field": HEIGHT, "transform": mapper(palette=Viridis256, low=low, high=high)}
    width, height = surface.size
    return Rect(
        x=f"x of {name}", y=name, width=width, height=height, fill_color=shade, line_color=None
    )


def _curve(explorer: Explorer, panel: Panel, name: str, source: ColumnDataSource) -> Any:
    """Return the renderer of a curve, added to nothing yet."""
    from bokeh.models import Line, Patch, Scatter
    from bokeh.models.renderers import GlyphRenderer

    look = explorer.looks[name]
    color = "#808080" if look.color == INK else look.color
    x = f"x of {name}"
    if look.dash == CELLS and explorer.surface is not None:
        glyph: Any = _cells(explorer.surface, name)
    elif panel.kind == "surface" and look.points:
        # a mark stands out from cells of any colour
        glyph = Scatter(x=x, y=name, size=10, fill_color=color, line_color="white", line_width=2)
    elif panel.kind == "cloud" or look.points:
        glyph = Scatter(x=x, y=name, size=4, fill_color=color, line_color=None, fill_alpha=0.6)
    elif look.dash == FILL:
        glyph = Patch(x=x, y=name, fill_color=color, line_color=None)
    else:
        glyph = Line(x=x, y=name, line_color=color, line_dash=look.dash, line_width=look.width)
    return GlyphRenderer(data_source=source, glyph=glyph, name=name, visible=look.shown)


def _counts(explorer: Explorer, panel: int) -> bool:
    """Return whether the horizontal values of a panel are whole, those of a count."""
    curves = [x for case in explorer.cases for x, _ in case.curves[panel].values()]
    known = [x[np.isfinite(x)] for x in curves]
    # values on a page are packed in 16 bits
    fine = 2e-5 * max((float(np.ptp(x)) for x in known if x.size), default=0.0)
    whole = [bool((np.abs(x - np.rint(x)) <= fine).all()) for x in known]
    return any(x.size for x in known) and all(whole)


def _columns(explorer: Explorer, case: Case, panel: int) -> dict[str, np.ndarray]:
    """Return the columns of a panel's source; shorter curves are filled with gaps."""
    curves = case.curves[panel]
    longest = max((len(x) for x, _ in curves.values()), default=0)
    out = {}
    for name in explorer.names(panel):
        x, y = curves.get(name, (np.empty(0), np.empty(0)))
        for column, values in ((f"x of {name}", x), (name, y)):
            out[column] = np.full(longest, np.nan)
            out[column][: len(values)] = values
    if explorer.panels[panel].kind == "surface" and explorer.surface is not None:
        heights = np.log10(case.heights) if explorer.surface.logarithmic else case.heights
        out[HEIGHT] = np.full(longest, np.nan)
        out[HEIGHT][: len(heights)] = heights
    return out


def _cases(explorer: Explorer) -> str:
    """Return the cases as JSON that may stand in a page's script."""
    content = {
        "looks": {
            name: {"color": look.color, "shown": look.shown}
            for name, look in explorer.looks.items()
        },
        "panels": len(explorer.panels),
        "surface": None
        if explorer.surface is None
        else {
            "name": explorer.surface.name,
            "section": explorer.surface.section,
            "heights": HEIGHT,
            "size": explorer.surface.size,
            "logarithmic": explorer.surface.logarithmic,
        },
        "cases": [
            {
                "title": case.title,
                "note": case.note,
                "chosen": case.chosen,
                "panels": [
                    packed(_columns(explorer, case, number))
                    for number in range(len(explorer.panels))
                ],
            }
            for case in explorer.cases
        ],
    }
    return json.dumps(content, separators=(",", ":"), ensure_ascii=True).replace("<", "\\u003c")
