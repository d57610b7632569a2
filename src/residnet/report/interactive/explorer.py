"""What an interactive figure shows: cases to choose from, panels, and curves that can be hidden."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeAlias

import numpy as np

INK = "ink"
"""The colour of text, for what was measured: black on paper, light on a dark screen."""

FILL = "fill"
"""Stands for the dash of a curve whose inside is filled, without a line."""

CELLS = "cells"
"""Stands for the dash of what is drawn as the coloured cells of a surface, one at each point."""

PanelKind: TypeAlias = Literal["curves", "map", "cloud", "surface"]


@dataclass(frozen=True)
class Look:
    """How the curves of one name look in every panel.

    Attributes:
        label: beside its switch.
        color: as CSS has it, or `INK`.
        dash: of its line as Bokeh has it: `solid`, `dashed`, `dotted`, `dashdot`, `dotdash`; or
            `FILL`.
        width: of its line in pixels.
        shown: whether it is switched on at first.
        points: it is drawn as points, not as a line.
    """

    label: str
    color: str
    dash: str = "solid"
    width: float = 1.8
    shown: bool = True
    points: bool = False


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
        title: above it, in words and with its unit.
        x_label: of the horizontal axis with its unit, empty where a panel beneath names it.
        kind: `curves` share their horizontal axis, a `map` has equal scales, a `cloud` is of
            points, a `surface` of coloured cells.
        height: in pixels.
        logarithmic: whether the vertical axis is.
        x_logarithmic: whether the horizontal axis is.
        group: panels of curves of one group share their horizontal axis.
        x_names: what stands at the horizontal axis in place of numbers, by their places as text.
        y_names: the same for the vertical axis.
        beside: it may stand beside others where the page is wide enough.
        x_limits: where the horizontal axis begins and ends at first; empty for all of the curves.
        y_limits: the same for the vertical axis.
        unnumbered: the vertical axis has no numbers, for several axes stand side by side.
    """

    title: str
    x_label: str = ""
    kind: PanelKind = "curves"
    height: int = 170
    logarithmic: bool = False
    x_logarithmic: bool = False
    group: str = ""
    x_names: Mapping[str, str] = field(default_factory=dict)
    y_names: Mapping[str, str] = field(default_factory=dict)
    beside: bool = False
    x_limits: Sequence[float] = ()
    y_limits: Sequence[float] = ()
    unnumbered: bool = False


Curve: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Horizontal and vertical values [T] of one curve, NaN where there is a gap."""


@dataclass(frozen=True)
class Surface:
    """What the first panel of an interactive figure shows as the coloured cells of a grid.

    Its second panel shows the section along the horizontal axis and its third one that along the
    vertical axis, each through a cell that the reader chooses.

    Attributes:
        name: of the cells among the looks.
        section: of the sections and of the chosen cell among the looks.
        x_label: what stands on the horizontal axis.
        y_label: what stands on the vertical axis.
        height: what the colours tell, with its unit.
        limits: heights of the first and the last colour.
        size: width and height of a cell in the units of the axes.
        logarithmic: whether colours and sections are.
    """

    name: str
    section: str
    x_label: str
    y_label: str
    height: str
    limits: tuple[float, float]
    size: tuple[float, float]
    logarithmic: bool = False


@dataclass(frozen=True)
class Case:
    """What all panels show at a time.

    Attributes:
        title: in the list to choose from.
        curves: for each panel, curves by name.
        note: a sentence on the case, empty where nothing is to be said.
        heights: of the surface's cells [T], in the order of their curve; empty without one.
        chosen: cell whose sections are shown first, horizontal and vertical value.
    """

    title: str
    curves: Sequence[Mapping[str, Curve]]
    note: str = ""
    heights: np.ndarray = field(default_factory=lambda: np.empty(0))
    chosen: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Explorer:
    """An interactive figure: one case of several, in panels with switches for its curves.

    Attributes:
        name: of its parts on the page, letters and `-`.
        title: a few words.
        caption: whole sentences that say what to look for.
        chooser: what the cases are, beside the list to choose from.
        looks: of the curves by name, in the order of the switches.
        panels: from top to bottom.
        cases: at least one.
        surface: what the first panel shows; None where all panels are of curves.
    """

    kind: ClassVar[str] = "explorer"
    name: str
    title: str
    caption: str
    chooser: str
    looks: Mapping[str, Look]
    panels: Sequence[Panel]
    cases: Sequence[Case] = field(default_factory=tuple)
    surface: Surface | None = None

    def names(self, panel: int) -> list[str]:
        """Return the names of the curves that a panel shows in any case, in order."""
        present = {name for case in self.cases for name in case.curves[panel]}
        return [name for name in self.looks if name in present]


def joined(curves: Sequence[Curve]) -> Curve:
    """Return several curves as one with gaps between them."""
    if not curves:
        return np.empty(0), np.empty(0)
    gap = np.array([np.nan])
    x, y = (
        np.concatenate([part for curve in curves for part in (curve[axis], gap)])[:-1]
        for axis in (0, 1)
    )
    return x, y


def thinned(length: int, most: int) -> np.ndarray:
    """Return the numbers of evenly spaced samples, at most so many, the first and last included."""
    if length <= most:
        return np.arange(length)
    return np.unique(np.linspace(0, length - 1, most).round().astype(int))
