"""A figure described once, drawn as a still picture (`still`) and in a browser (`browser`).

A figure has panels. What each panel shows bears names, and one name looks the same in all of them.
One of several cases (a run, a protocol) is shown at a time.
"""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np

from residnet.core.files import file_stem, whole
from residnet.core.format import powers
from residnet.core.progress import begin
from residnet.core.stretches import stretches
from residnet.report.blocks import Section

INK = "ink"
"""The colour of text: black on paper, light on a dark screen."""
Curve: TypeAlias = tuple[np.ndarray, np.ndarray]
"""Horizontal and vertical values [T], NaN where there is a gap."""
Kind: TypeAlias = Literal["line", "points", "fill", "across", "upright", "strip", "cells"]

# Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies
BLUE, ORANGE, VERMILLION, PURPLE, GREEN, SKY, GREY = (
    "#0072B2",
    "#E69F00",
    "#D55E00",
    "#CC79A7",
    "#009E73",
    "#56B4E9",
    "#7F7F7F",
)
COLORS = (BLUE, VERMILLION, GREEN, PURPLE, SKY, ORANGE, GREY)
DASHES = ("solid", "long", "dashdot", "short", "dense", "dashed", "dotted")


@dataclass(frozen=True)
class Look:
    """How what bears one name looks in every panel.

    Attributes:
        label: in the legend, and beside its switch.
        color: as CSS has it, or `INK`.
        dash: `solid`, `dashed`, `dotted`, `dashdot`, `long`, `short` or `dense`.
        width: of its line in points.
        kind: a `line`, `points`, a `fill` of outlines that gaps part; lines `across` at vertical
            values or `upright` at horizontal ones; `strip`s from one horizontal value to another;
            `cells` of a surface.
        shown: it is switched on at first, and drawn in still pictures.
        alpha: opacity.
        marker: of points: `o`, `s`, `x` or `^`.
        size: of points, in points.
        hollow: points are rings.
        order: what has a higher one lies on top.
    """

    label: str
    color: str = INK
    dash: str = "solid"
    width: float = 1.4
    kind: Kind = "line"
    shown: bool = True
    alpha: float = 1.0
    marker: str = "o"
    size: float = 4.0
    hollow: bool = False
    order: float = 3


GLANCE = 280
"""Most pixels of a panel on a first screen, which on a phone holds rows of a table as well."""
MEASURED = Look("measured", width=0.7, order=2)
SOLID = Look("", BLUE, width=1.6)
DASHED = Look("", ORANGE, "dashed", 1.6, order=4)
"""Two curves of equal rank, told apart by colour and by line."""
MASKED = Look("masked", "#E0E0E0", kind="strip", alpha=0.8, order=0)
START = Look("start", kind="points", size=6, hollow=True, order=6)
ZERO = Look("", "#666666", width=0.8, kind="across", order=1)


def family(names: Iterable[str], **given: Any) -> dict[str, Look]:
    """Return looks of equal rank by name, told apart by colour and by line.

    Args:
        names: what they are labelled with.
        given: further attributes of all looks.
    """
    most = len(COLORS)
    return {
        name: Look(
            name, **{"color": COLORS[i % most], "dash": DASHES[(i + i // most) % most]} | given
        )
        for i, name in enumerate(names)
    }


@dataclass(frozen=True)
class Panel:
    """One set of axes.

    Attributes:
        y_label: of the vertical axis, with its unit.
        x_label: of the horizontal axis, with its unit; empty where a panel beneath names it.
        title: above it.
        kind: a `map` has equal scales; `curves` of one group share their horizontal axis.
        height: in pixels on a page, at 110 to the inch in a still picture.
        x_log, y_log: whether an axis is logarithmic.
        group: of panels that share their horizontal axis.
        x_names, y_names: what stands at an axis in place of numbers, by place.
        si: SI unit of the vertical values, and their factor from it; empty where they are in it.
        x_limits, y_limits: where an axis begins and ends at first; empty for all that is shown.
    """

    y_label: str = ""
    x_label: str = ""
    title: str = ""
    kind: Literal["curves", "map", "surface"] = "curves"
    height: int = 165
    x_log: bool = False
    y_log: bool = False
    group: str = ""
    x_names: Mapping[str, str] = field(default_factory=dict)
    y_names: Mapping[str, str] = field(default_factory=dict)
    x_limits: Sequence[float] = ()
    y_limits: Sequence[float] = ()
    si: tuple[str, float] | tuple[()] = ()

    @property
    def words(self) -> str:
        """What stands above the panel on a page."""
        return powers(" ".join(": ".join(one for one in (self.title, self.y_label) if one).split()))


@dataclass(frozen=True)
class Surface:
    """What the first panel shows as the coloured cells of a grid.

    The second panel shows the section along the horizontal axis, the third one that along the
    vertical axis, through a cell that the reader chooses. Cells bear the name `surface`, sections
    the name `section`.

    Attributes:
        height: what the colours tell, with its unit.
        limits: heights of the first and the last colour.
        size: width and height of a cell in the units of the axes.
        log: whether colours and sections are logarithmic.
    """

    height: str
    limits: tuple[float, float]
    size: tuple[float, float]
    log: bool = False


@dataclass(frozen=True)
class Case:
    """What all panels show at a time.

    Attributes:
        title: in the list to choose from.
        curves: for each panel, curves by name.
        note: a sentence on the case, empty where nothing is to be said.
        still: it has a still picture.
        texts: number of a panel, place and words of what is written into a still picture; a
            vertical place of NaN is the upper edge.
        heights: of the surface's cells [T], in the order of their curve.
        chosen: cell whose sections are shown first.
    """

    title: str
    curves: Sequence[Mapping[str, Curve]]
    note: str = ""
    still: bool = True
    texts: Sequence[tuple[int, float, float, str]] = ()
    heights: np.ndarray = field(default_factory=lambda: np.empty(0))
    chosen: Sequence[float] = ()


@dataclass(frozen=True)
class Figure:
    """A figure: one case of several, in panels with switches for what they show.

    Attributes:
        name: of its files and of its parts on the page.
        title: a few words.
        caption: whole sentences that say what to look for.
        looks: by name, in the order of the legend.
        panels: from top to bottom, line by line where there are columns.
        cases: at least one.
        chooser: what the cases are, beside the list to choose from.
        columns: of panels beside each other.
        surface: what the first panel shows; None where all panels are of curves.
        stills: pictures that were written of it.
    """

    kind: ClassVar[str] = "figure"
    name: str
    title: str
    caption: str
    looks: Mapping[str, Look]
    panels: Sequence[Panel]
    cases: Sequence[Case]
    chooser: str = ""
    columns: int = 1
    surface: Surface | None = None
    stills: Sequence[Path] = ()

    @property
    def key(self) -> str:
        """Name of its parts on a page: letters, digits and `-`."""
        return "figure-" + re.sub(r"[^a-z0-9]+", "-", self.name.lower())

    @property
    def pictured(self) -> list[Case]:
        """Cases in the order of the stills."""
        return [case for case in self.cases if case.still]

    def part(self, panels: int = 1) -> Figure:
        """Return the first panels without words: a glance, for the first screen of a page.

        It has no stills, since the whole figure stands further down.
        """
        # panels beneath each other share the name of their horizontal axis
        last = self.panels[-1]
        cases = [replace(case, curves=case.curves[:panels], texts=()) for case in self.cases]
        shown = [
            replace(one, height=min(one.height, GLANCE), x_label=one.x_label or last.x_label)
            for one in self.panels[:panels]
        ]
        seen = {name for case in cases for curves in case.curves for name in curves}
        return replace(
            self,
            name=f"{self.name} first",
            caption="",
            looks={name: look for name, look in self.looks.items() if name in seen and look.shown},
            panels=shown,
            cases=cases,
            stills=(),
        )

    def names(self, panel: int) -> list[str]:
        """Return the names of what a panel shows in any case, in order."""
        present = {name for case in self.cases for name in case.curves[panel]}
        return [name for name in self.looks if name in present]

    def counts(self, panel: int) -> bool:
        """Return whether the horizontal values of a panel are whole, those of a count."""
        curves = [x for case in self.cases for x, _ in case.curves[panel].values()]
        known = [x[np.isfinite(x)] for x in curves]
        # values of a file are packed in 16 bits
        fine = 2e-5 * max((float(np.ptp(x)) for x in known if x.size), default=0.0)
        return any(x.size for x in known) and all((abs(x - x.round()) <= fine).all() for x in known)


def packed(columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return columns as 16-bit numbers with offset and step; equal columns are stored once."""
    out: dict[str, Any] = {}
    stored: dict[bytes, str] = {}
    for name, values in columns.items():
        before = stored.setdefault(values.tobytes(), name)
        if before != name:
            out[name] = before
            continue
        finite = np.isfinite(values)
        known = values[finite]
        low, span = (float(known.min()), float(np.ptp(known))) if known.size else (0.0, 0.0)
        # finer than any screen; the largest number is a gap
        step = span / 65_000 if span > 0 else 1.0
        levels = np.full(len(values), 65_535, dtype="<u2")
        levels[finite] = np.round((known - low) / step)
        out[name] = [low, step, base64.b64encode(levels.tobytes()).decode("ascii")]
    return out


def unpacked(columns: Mapping[str, Any], name: str) -> np.ndarray:
    """Return one of the columns that `packed` gave, as numbers [T]."""
    stored = columns[name]
    low, step, text = columns[stored] if isinstance(stored, str) else stored
    levels = np.frombuffer(base64.b64decode(text), dtype="<u2")
    values: np.ndarray = np.where(levels == 65_535, np.nan, low + step * levels)
    return values


def write_figure(folder: Path, figure: Figure, name: str = "") -> Figure:
    """Write a figure of a run: a PNG for each case that has one, and the figure itself beside them.

    Args:
        folder: for the files.
        figure: what they show.
        name: of the files, that of the figure where empty.
    """
    # a page that is written again reads them; drawing takes matplotlib
    from residnet.report.still import save, still

    folder.mkdir(parents=True, exist_ok=True)
    name = file_stem(name or figure.name)
    # the sections of a surface belong to the screen, its cases stand side by side
    groups = [figure.cases] if figure.surface else [[case] for case in figure.cases if case.still]
    stills = []
    for number, cases in enumerate(groups, start=1):
        path = folder / (f"{name}.png" if len(groups) == 1 else f"{name}_{number}.png")
        title = figure.title + (f": {cases[0].title}" if len(groups) > 1 else "")
        save(still(figure, cases), path, title, figure.caption)
        stills.append(path)
    content = {name: getattr(figure, name) for name in _PLAIN} | {
        "looks": {name: asdict(look) for name, look in figure.looks.items()},
        "panels": [asdict(panel) for panel in figure.panels],
        "surface": figure.surface and asdict(figure.surface),
        "stills": [path.name for path in stills],
        "cases": [_stored(figure, case) for case in figure.cases],
    }
    with whole(folder / f"{name}.json") as file:
        file.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")
    return replace(figure, stills=stills)


_PLAIN = ("name", "title", "caption", "chooser", "columns")


def _stored(figure: Figure, case: Case) -> dict[str, Any]:
    panels = []
    for of_panel in case.curves:
        # every cell of a surface has its height
        light = {
            name: curve if figure.looks[name].kind == "cells" else _light(*curve)
            for name, curve in of_panel.items()
        }
        # packed curves of NaN alone are gaps
        panels.append(
            packed(
                {
                    f"{axis}{name}": np.asarray(values, dtype=float)
                    for name, curve in light.items()
                    for axis, values in zip("xy", curve, strict=True)
                }
            )
        )
    heights = np.log10(case.heights) if figure.surface and figure.surface.log else case.heights
    return {
        "title": case.title,
        "note": case.note,
        "still": case.still,
        "chosen": list(map(float, case.chosen)),
        "heights": packed({"heights": heights}),
        "curves": panels,
    }


def write_figures(folder: Path, figures: Iterable[Figure]) -> list[Figure]:
    """Write figures in the order in which a page shows them; those of an earlier call are replaced.

    Other pictures of the folder stay.
    """
    for path in folder.glob("*.json"):
        before = _read(path)
        for file in (path, *before.stills) if before else ():
            file.unlink(missing_ok=True)
    begin("drawing figures")
    # the number keeps the order for whoever lists the folder
    return [
        write_figure(folder, one, f"{i:02d}_{one.name}") for i, one in enumerate(figures, start=1)
    ]


def read_figures(folder: Path, names: str = ".*") -> list[Figure]:
    """Return the figures of a folder in the order of their files; damaged ones are left out.

    Args:
        folder: as `write_figures` left it.
        names: regular expression of the names of those that are wanted.
    """
    found = (_read(path) for path in sorted(folder.glob("*.json")))
    return [figure for figure in found if figure and re.fullmatch(names, figure.name)]


def figures_section(folder: Path, names: str = ".*") -> list[Section]:
    """Return a section with the figures of a folder, none where there are none."""
    figures = read_figures(folder, names)
    return [Section("Figures", figures)] if figures else []


def _read(path: Path) -> Figure | None:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        surface = content["surface"] and Surface(**content["surface"])
        cases = []
        for case in content.pop("cases"):
            heights = unpacked(case.pop("heights"), "heights")
            case["heights"] = 10.0**heights if surface and surface.log else heights
            case["curves"] = [
                {
                    name[1:]: (unpacked(of, name), unpacked(of, f"y{name[1:]}"))
                    for name in of
                    if name[0] == "x"
                }
                for of in case["curves"]
            ]
            cases.append(Case(**case))
        return Figure(
            **{name: content[name] for name in _PLAIN},
            looks={name: Look(**look) for name, look in content["looks"].items()},
            panels=[Panel(**panel) for panel in content["panels"]],
            cases=cases,
            surface=surface,
            stills=[path.parent / name for name in content["stills"]],
        )
    except (OSError, ValueError, TypeError, KeyError):
        # damaged: it is drawn again, or is not one of residnet
        return None


def parts(x: Any, y: Any) -> list[Curve]:
    """Return a curve in the pieces that its gaps leave."""
    x, y = np.asarray(x, dtype=float), np.asarray(y, dtype=float)
    good = np.isfinite(x) & np.isfinite(y)
    return [(x[a:b], y[a:b]) for a, b in zip(*stretches(good), strict=True)]


def joined(curves: Iterable[tuple[Any, Any]]) -> Curve:
    """Return several curves as one with gaps between them."""
    gap = [np.nan]
    pieces = [
        (np.append(np.asarray(x, dtype=float), gap), np.append(np.asarray(y, dtype=float), gap))
        for x, y in curves
    ]
    x, y = (
        np.concatenate([piece[axis] for piece in pieces] or [np.empty(1)])[:-1] for axis in (0, 1)
    )
    return x, y


def thinned(length: int, most: int) -> np.ndarray:
    """Return the numbers of evenly spaced samples, at most so many, the first and last included."""
    if length <= most:
        return np.arange(length)
    return np.unique(np.linspace(0, length - 1, most).round().astype(int))


def _light(x: np.ndarray, y: np.ndarray) -> Curve:
    """Return a curve with no more samples than a screen shows."""
    pieces = parts(x, y)
    most = max(20, min(600, 6_000 // max(len(pieces), 1)))
    rows = [thinned(len(a), most) for a, _ in pieces]
    return joined([(a[kept], b[kept]) for (a, b), kept in zip(pieces, rows, strict=True)])


def band(x: Any, low: Any, high: Any) -> Curve:
    """Return the outline of what lies between two curves [T] over x [T], a `fill`."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    good = np.isfinite(low) & np.isfinite(high)
    x = np.asarray(x, dtype=float)
    return joined(
        (np.append(x[a:b], x[a:b][::-1]), np.append(low[a:b], high[a:b][::-1]))
        for a, b in zip(*stretches(good), strict=True)
    )


def bars(at: Any, values: Any, thick: float = 0.8) -> Curve:
    """Return the outlines of upright bars from zero, a `fill`; swap its parts for lying ones."""
    corners = thick * np.array([-0.5, -0.5, 0.5, 0.5])
    return joined(
        [
            (place + corners, value * np.array([0.0, 1.0, 1.0, 0.0]))
            for place, value in zip(at, values, strict=True)
        ]
    )


def whiskers(at: Any, low: Any, high: Any) -> Curve:
    """Return upright lines from low to high values, swap its parts for lying ones."""
    return joined([([place] * 2, ends) for place, *ends in zip(at, low, high, strict=True)])


def steps(x: Any, y: Any) -> Curve:
    """Return a curve that keeps each value up to the next one."""
    return np.repeat(np.asarray(x, dtype=float), 2)[1:], np.repeat(np.asarray(y, dtype=float), 2)[
        :-1
    ]


def names_of(texts: Iterable[str]) -> dict[str, str]:
    """Return what stands at the whole numbers of an axis."""
    return {str(place): text for place, text in enumerate(texts)}
