"""Description of a figure, drawn as a static image (`still.py`) and on a page (`browser.py`).

A figure has panels. Each panel shows named curves, and curves of the same name look the same in all
panels. One of several cases (a run, a protocol) is shown at a time.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from residnet.core.format import format_exponents
from residnet.core.stretches import find_runs

TEXT_COLOR = "ink"
"""The colour of text: black on paper, light on a dark screen."""
Curve: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Horizontal and vertical values [T]; NaN marks a gap."""
# named as the functions of matplotlib: lines at values of an axis, and vertical bands
GlyphKind: TypeAlias = Literal["line", "points", "fill", "hline", "vline", "vspan"]

# Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies
BLUE = "#0072B2"
ORANGE = "#E69F00"
VERMILLION = "#D55E00"
PURPLE = "#CC79A7"
GREEN = "#009E73"
SKY_BLUE = "#56B4E9"
GREY = "#7F7F7F"
COLORS = (BLUE, VERMILLION, GREEN, PURPLE, SKY_BLUE, ORANGE, GREY)
DASHES = ("solid", "long", "dashdot", "short", "dense", "dashed", "dotted")


@dataclass(frozen=True)
class GlyphStyle:
    """Appearance of one named curve in every panel.

    Attributes:
        label: text in the legend and at the visibility switch.
        color: CSS colour such as `#0072B2`, or `TEXT_COLOR`.
        dash: `solid`, `dashed`, `dotted`, `dashdot`, `long`, `short` or `dense`.
        width: width of the line in points.
        kind: `line`, `points`, `fill` (outlines separated by gaps), `hline` (horizontal lines at
            the vertical values), `vline` (vertical lines at the horizontal values) or `vspan`
            (vertical bands between two horizontal values).
        is_visible: whether the curve is visible initially and drawn in static images.
        alpha: opacity.
        marker: marker of points: `o`, `s`, `x` or `^`.
        size: diameter of the marker in points.
        is_hollow: whether markers are drawn as outlines.
        z_order: drawing order; higher values are drawn on top.
    """

    label: str
    color: str = TEXT_COLOR
    dash: str = "solid"
    width: float = 1.4
    kind: GlyphKind = "line"
    is_visible: bool = True
    alpha: float = 1.0
    marker: str = "o"
    size: float = 4.0
    is_hollow: bool = False
    z_order: float = 3


MAX_PREVIEW_HEIGHT = 280
"""Maximum height in pixels of a panel at the top of a page, which leaves space for the first rows
of a table on the screen of a phone.
"""
MEASURED_STYLE = GlyphStyle("measured", width=0.7, z_order=2)
"""Style of measured values, thin below the curves of models."""
SOLID_STYLE = GlyphStyle("", BLUE, width=1.6)
"""Style of the first of two curves that are compared."""
DASHED_STYLE = GlyphStyle("", ORANGE, "dashed", 1.6, z_order=4)
"""Style of the second of them, distinguished by colour and line style."""
MASKED_STYLE = GlyphStyle("masked", "#E0E0E0", kind="vspan", alpha=0.8, z_order=0)
START_STYLE = GlyphStyle("start", kind="points", size=6, is_hollow=True, z_order=6)
"""Style of the start of a track, a ring above all curves."""
ZERO_LINE_STYLE = GlyphStyle("", "#666666", width=0.8, kind="hline", z_order=1)


def style_family(names: Iterable[str], width: float = 1.4) -> dict[str, GlyphStyle]:
    """Return a style for each name, distinguished by colour and line style.

    Args:
        names: names of the curves, which are also their labels.
        width: width of all curves.
    """
    n_colors = len(COLORS)
    return {
        name: GlyphStyle(
            name, COLORS[i % n_colors], DASHES[(i + i // n_colors) % n_colors], width=width
        )
        for i, name in enumerate(names)
    }


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
        y_label: label of the vertical axis with its unit.
        x_label: label of the horizontal axis with its unit; empty if the panel below has the label.
        title: title above the panel.
        kind: `map` for equal scales of both axes, `curves` for others.
        height: height in pixels on a page; 110 pixels are an inch in a static image.
        x_log, y_log: whether an axis is logarithmic.
        group: name of the group of `curves` panels that share their horizontal axis.
        x_names, y_names: tick labels that replace numbers, by position.
        si_unit: SI unit of the vertical values and the factor from SI; empty if they are in SI
            units.
        x_limits, y_limits: initial limits of an axis; empty for the range of the data.
    """

    y_label: str = ""
    x_label: str = ""
    title: str = ""
    kind: Literal["curves", "map"] = "curves"
    height: int = 165
    x_log: bool = False
    y_log: bool = False
    group: str = ""
    x_names: Mapping[str, str] = field(default_factory=dict)
    y_names: Mapping[str, str] = field(default_factory=dict)
    x_limits: Sequence[float] = ()
    y_limits: Sequence[float] = ()
    si_unit: tuple[str, float] | tuple[()] = ()

    @property
    def heading(self) -> str:
        """Title above the panel."""
        return format_exponents(
            " ".join(": ".join(part for part in (self.title, self.y_label) if part).split())
        )


@dataclass(frozen=True)
class Case:
    """The curves of all panels for one selectable case.

    Attributes:
        title: entry in the selection list.
        curves: for each panel, curves by name.
        note: optional sentence about the case.
        has_static_image: whether a static image of the case is written.
        texts: annotations of the static image: panel number, position and text; a vertical
            position of NaN is the upper edge.
    """

    title: str
    curves: Sequence[Mapping[str, Curve]]
    note: str = ""
    has_static_image: bool = True
    texts: Sequence[tuple[int, float, float, str]] = ()


@dataclass(frozen=True)
class Figure:
    """A figure with panels, selectable cases and visibility switches.

    Attributes:
        name: stem of its files and of its HTML identifiers.
        title: short title.
        caption: sentences that explain the figure.
        styles: style of each curve by name, in the order of the legend.
        panels: panels from top to bottom; row by row if there are several columns.
        cases: selectable cases, at least one.
        chooser: label of the selection list.
        columns: number of panel columns.
        static_images: paths of the PNG files.
        is_drawing: whether a page shows the first case as a drawing that needs no JavaScript.
    """

    kind: ClassVar[str] = "figure"
    name: str
    title: str
    caption: str
    styles: Mapping[str, GlyphStyle]
    panels: Sequence[Panel]
    cases: Sequence[Case]
    chooser: str = ""
    columns: int = 1
    static_images: Sequence[Path] = ()
    is_drawing: bool = False

    @property
    def html_id(self) -> str:
        """Prefix of the HTML identifiers of the figure: letters, digits and `-`."""
        return "figure-" + re.sub(r"[^a-z0-9]+", "-", self.name.lower())

    @property
    def static_cases(self) -> list[Case]:
        """Cases with a static image, in the order of the images."""
        return [case for case in self.cases if case.has_static_image]

    def preview(self, n_panels: int = 1) -> Figure:
        """Return a figure of the first panels without caption, for the top of a page.

        The preview has no static images because the complete figure follows on the page.
        """
        # panels beneath each other share the name of their horizontal axis
        last = self.panels[-1]
        cases = [replace(case, curves=case.curves[:n_panels], texts=()) for case in self.cases]
        preview_panels = [
            replace(
                panel,
                height=min(panel.height, MAX_PREVIEW_HEIGHT),
                x_label=panel.x_label or last.x_label,
            )
            for panel in self.panels[:n_panels]
        ]
        present_names = {
            name for case in cases for case_curves in case.curves for name in case_curves
        }
        return replace(
            self,
            name=f"{self.name} first",
            caption="",
            styles={
                name: style
                for name, style in self.styles.items()
                if name in present_names and style.is_visible
            },
            panels=preview_panels,
            cases=cases,
            static_images=(),
            is_drawing=True,
        )

    def curve_names(self, panel: int) -> list[str]:
        """Return the names of the curves that a panel shows in one case or more, in order."""
        present = {name for case in self.cases for name in case.curves[panel]}
        return [name for name in self.styles if name in present]

    def has_integer_axis(self, panel: int) -> bool:
        """Return whether a panel needs integer ticks, because all its x values are integers."""
        x_values = [x for case in self.cases for x, _ in case.curves[panel].values()]
        finite_values = [x[np.isfinite(x)] for x in x_values]
        # values that are read from a file were rounded to 16 bits, see `figure_files`
        tolerance = 2e-5 * max((float(np.ptp(x)) for x in finite_values if x.size), default=0.0)
        return any(x.size for x in finite_values) and all(
            (abs(x - x.round()) <= tolerance).all() for x in finite_values
        )


def split_at_gaps(x: ArrayLike, y: ArrayLike) -> list[Curve]:
    """Split a curve into its parts between gaps (values that are not finite)."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    is_finite = np.isfinite(x) & np.isfinite(y)
    return [(x[a:b], y[a:b]) for a, b in zip(*find_runs(is_finite), strict=True)]


def join_with_gaps(xy_pairs: Iterable[tuple[ArrayLike, ArrayLike]]) -> Curve:
    """Join several curves to one, with a gap between each two."""
    gap = [np.nan]
    padded_curves = [
        (np.append(np.asarray(x, dtype=float), gap), np.append(np.asarray(y, dtype=float), gap))
        for x, y in xy_pairs
    ]
    x, y = (
        np.concatenate([padded_curve[axis] for padded_curve in padded_curves] or [np.empty(1)])[:-1]
        for axis in (0, 1)
    )
    return x, y


def subsample_indices(length: int, max_count: int) -> np.ndarray:
    """Return at most `max_count` evenly spaced sample indices, including the first and the last."""
    if length <= max_count:
        return np.arange(length)
    return np.unique(np.linspace(0, length - 1, max_count).round().astype(int))


def band_outline(x: ArrayLike, lower: ArrayLike, upper: ArrayLike) -> Curve:
    """Return the outline of the area between two curves [T] over x [T], for a style `fill`."""
    lower = np.asarray(lower, dtype=float)
    upper = np.asarray(upper, dtype=float)
    is_finite = np.isfinite(lower) & np.isfinite(upper)
    x = np.asarray(x, dtype=float)
    return join_with_gaps(
        (np.append(x[a:b], x[a:b][::-1]), np.append(lower[a:b], upper[a:b][::-1]))
        for a, b in zip(*find_runs(is_finite), strict=True)
    )


def bar_outlines(
    positions: Iterable[float], values: Iterable[float], thickness: float = 0.8
) -> Curve:
    """Return the outlines of vertical bars from zero, for a style `fill`.

    Exchange x and y of the result for horizontal bars.
    """
    corners = thickness * np.array([-0.5, -0.5, 0.5, 0.5])
    return join_with_gaps(
        [
            (position + corners, value * np.array([0.0, 1.0, 1.0, 0.0]))
            for position, value in zip(positions, values, strict=True)
        ]
    )


def error_bars(positions: Iterable[float], lower: Iterable[float], upper: Iterable[float]) -> Curve:
    """Return vertical lines from lower to upper values.

    Exchange x and y of the result for horizontal lines.
    """
    return join_with_gaps(
        [
            ([position] * 2, limits)
            for position, *limits in zip(positions, lower, upper, strict=True)
        ]
    )


def step_curve(x: ArrayLike, y: ArrayLike) -> Curve:
    """Return a step function that holds each value up to the next sample."""
    return np.repeat(np.asarray(x, dtype=float), 2)[1:], np.repeat(np.asarray(y, dtype=float), 2)[
        :-1
    ]


def tick_labels(texts: Iterable[str]) -> dict[str, str]:
    """Return texts as the tick labels of an axis at 0, 1, 2, ...; see `Panel.x_names`."""
    return {str(index): text for index, text in enumerate(texts)}
