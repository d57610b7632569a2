"""The interactive figure that shows what a drawn one does: its lines, points, bands and bars.

A picture carries its curves in its own file, so that a report can be written again from the run
folder alone.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.report.interactive.explorer import (
    FILL,
    INK,
    Case,
    Curve,
    Explorer,
    Look,
    Panel,
    joined,
    thinned,
)
from residnet.report.interactive.packing import packed, unpacked
from residnet.report.interactive.surfaces import surface_content, surface_explorer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_SAMPLES = 600
_MOST_OF_FAMILY = 6_000
"""Most samples of curves of one name in one panel."""
_MOST_PANELS = 24
_MOST_TEXT = 900_000
"""Most characters that a PNG file may carry in one text and still be read."""
_OTHERS = "other lines"
_SHADES = "shades"
_SCALES = ("linear", "log")


@dataclass
class _Found:
    """What is drawn in a figure under one name."""

    look: Look
    curves: dict[int, list[Curve]] = field(default_factory=dict)


def curves_text(figure: Figure) -> str:
    """Return what a drawn figure shows as text.

    It is empty where that is more than curves and points, or surfaces with a bar of their colours.
    """
    labels = _labels(figure)
    surfaces = surface_content(figure, lambda one: _drawn(one, labels), _words)
    if surfaces is not None:
        return _stored({"surface": surfaces})
    axes = [one for one in figure.axes if one.get_visible() and one.has_data()]
    if not axes or len(axes) > _MOST_PANELS or not all(map(_plain, axes)):
        return ""
    found: dict[str, _Found] = {}
    for number, one in enumerate(axes):
        for name, look, curve in _drawn(one, labels):
            entry = found.setdefault(name, _Found(look))
            entry.curves.setdefault(number, []).append(curve)
    if not any(entry.look.label != _OTHERS for entry in found.values()):
        # names are all that an interactive figure has to switch
        return ""
    content = {
        "panels": [_panel(one, axes) for one in axes],
        "looks": {
            name: [entry.look.color, entry.look.dash, entry.look.width, entry.look.points]
            for name, entry in found.items()
        },
        "curves": [_of_panel(found, number) for number in range(len(axes))],
    }
    return _stored(content)


def _stored(content: Mapping[str, Any]) -> str:
    """Return what a figure shows as text; empty where a file cannot carry that much."""
    text = json.dumps(content, separators=(",", ":"))
    return text if len(text) <= _MOST_TEXT else ""


def picture_explorer(name: str, title: str, caption: str, text: str) -> Explorer | None:
    """Return the interactive figure of a picture from its curves; None where they cannot be read.

    Args:
        name: of its parts on the page.
        title: a few words.
        caption: whole sentences that say what to look for.
        text: as `curves_text` gave it.
    """
    try:
        content = json.loads(text)
        if "surface" in content:
            return surface_explorer(name, title, caption, content["surface"])
        panels = [Panel(**panel) for panel in content["panels"]]
        looks = {
            label: Look(label, color, dash, float(width), points=bool(points))
            for label, (color, dash, width, points) in content["looks"].items()
        }
        curves = [
            {label: (unpacked(of, f"x{label}"), unpacked(of, f"y{label}")) for label in _names(of)}
            for of in content["curves"]
        ]
    except (ValueError, TypeError, KeyError, AttributeError):
        return None
    return Explorer(name, title, caption, "", looks, panels, [Case(title, curves)])


def _names(columns: Mapping[str, Any]) -> list[str]:
    return [column[1:] for column in columns if column.startswith("y")]


def _of_panel(found: Mapping[str, _Found], number: int) -> dict[str, Any]:
    columns: dict[str, np.ndarray] = {}
    for name, entry in found.items():
        curves = entry.curves.get(number)
        if curves:
            most = max(20, min(_MOST_SAMPLES, _MOST_OF_FAMILY // len(curves)))
            x, y = joined([_thin(curve, most) for curve in curves])
            columns |= {f"x{name}": x, f"y{name}": y}
    return packed(columns)


def _thin(curve: Curve, most: int) -> Curve:
    rows = thinned(len(curve[0]), most)
    return curve[0][rows], curve[1][rows]


def _plain(axes: Axes) -> bool:
    """Return whether axes hold nothing but what an interactive panel can show."""
    from matplotlib.collections import QuadMesh

    return (
        axes.name == "rectilinear"
        and not axes.images
        and not any(isinstance(part, QuadMesh) for part in axes.collections)
        and {axes.get_xscale(), axes.get_yscale()} <= set(_SCALES)
    )


def _panel(axes: Axes, all_axes: list[Axes]) -> dict[str, Any]:
    """Return the settings of the panel that shows some axes."""
    titles = [axes.get_title(side) for side in ("left", "center", "right")]
    label = _words(axes.get_ylabel())
    title = ": ".join(text for text in (*map(_words, titles), label) if text)
    if not title:
        # the first panel of a row tells what all show
        row = [one for one in all_axes if one.get_shared_y_axes().joined(one, axes)]
        title = _words(next((one.get_ylabel() for one in row if one.get_ylabel()), ""))
    upright = len(axes.get_yticks()) == 0
    equal = axes.get_aspect() in ("equal", 1.0)
    first = next(
        i
        for i, one in enumerate(all_axes)
        if one is axes or one.get_shared_x_axes().joined(one, axes)
    )
    return {
        "title": title,
        "x_label": _words(axes.get_xlabel()),
        "kind": "map" if equal else "curves",
        "height": 380 if equal or upright else 210,
        "logarithmic": axes.get_yscale() == "log",
        "x_logarithmic": axes.get_xscale() == "log",
        "group": f"x{first}",
        "x_names": _tick_names(axes.xaxis),
        "y_names": _tick_names(axes.yaxis),
        "beside": _beside(axes),
        "unnumbered": upright,
        "x_limits": [] if axes.get_autoscalex_on() else list(map(float, axes.get_xlim())),
        "y_limits": [] if axes.get_autoscaley_on() else list(map(float, axes.get_ylim())),
    }


def _beside(axes: Axes) -> bool:
    """Return whether axes stand in one of several columns."""
    place = axes.get_subplotspec()
    return place is not None and place.get_gridspec().ncols > 1


def _tick_names(axis: Any) -> dict[str, str]:
    """Return the names that stand at an axis in place of numbers, by their places."""
    from matplotlib.ticker import FixedLocator, ScalarFormatter

    locator, formatter = axis.get_major_locator(), axis.get_major_formatter()
    if not isinstance(locator, FixedLocator) or isinstance(formatter, ScalarFormatter):
        return {}
    places = np.asarray(locator(), dtype=float).tolist()
    texts = [
        "\n".join(map(_words, str(formatter(place, number)).split("\n")))
        for number, place in enumerate(places)
    ]
    return {f"{place:g}": text for place, text in zip(places, texts, strict=True) if text}


def _words(text: str) -> str:
    """Return a label without the signs of mathematical type-setting."""
    for written, shown in (("$^2$", "²"), ("$^3$", "³"), ("$", ""), ("\\cdot", "·"), ("\\", "")):
        text = text.replace(written, shown)
    return " ".join(text.split())


def _key(color: Any, dash: str) -> tuple[str, str]:
    from matplotlib.colors import to_hex

    return to_hex(color), dash


def _labels(figure: Figure) -> dict[tuple[str, str], str]:
    """Return what the legends call a colour and kind of line."""
    legends = [*figure.legends, *(one.legend_ for one in figure.axes if one.legend_ is not None)]
    out: dict[tuple[str, str], str] = {}
    for legend in legends:
        for handle, text in zip(legend.legend_handles, legend.get_texts(), strict=False):
            color = getattr(handle, "get_color", None) or getattr(handle, "get_facecolor", None)
            if handle is None or color is None:
                continue
            shade = color()
            shade = shade[0] if np.ndim(shade) == 2 and len(shade) else shade
            out.setdefault(_key(shade, _dash_of(handle)), _words(text.get_text()))
    return out


def _dash_of(artist: Any) -> str:
    style = getattr(artist, "get_linestyle", lambda: "-")()
    names = {"-": "solid", "--": "dashed", ":": "dotted", "-.": "dashdot", "None": "none"}
    return names.get(style, "solid") if isinstance(style, str) else "solid"


def _shade(color: Any, artist: Any) -> str:
    """Return a colour as a page has it; what is faint on paper stays to be seen on a screen."""
    from matplotlib.colors import to_hex, to_rgba

    red, green, blue, alpha = to_rgba(color, artist.get_alpha())
    return to_hex((red, green, blue, max(alpha, 0.25)), keep_alpha=alpha < 1.0)


def _look(
    artist: Any,
    color: Any,
    labels: Mapping[tuple[str, str], str],
    points: bool,
    filled: bool = False,
) -> Look:
    """Return how an artist looks, under its own label or that of its likes in a legend."""
    from matplotlib.colors import to_hex, to_rgba

    dash = _dash_of(artist)
    # what no legend has room for is named by its group
    own = str(artist.get_gid() or artist.get_label() or "")
    likes = [text for (shade, _), text in labels.items() if shade == to_hex(color)]
    # a shade has no kind of line
    alike = "" if filled else labels.get(_key(color, dash), "")
    label = own if own and not own.startswith("_") else alike
    label = label or (likes[0] if len(likes) == 1 else _OTHERS)
    red, green, blue, alpha = to_rgba(color, artist.get_alpha())
    grey = max(red, green, blue) - min(red, green, blue) < 0.05
    shade = _shade(color, artist)
    ink = grey and red < 0.5 and alpha > 0.5
    width = getattr(artist, "get_linewidth", lambda: 1.0)()
    width = float(np.ravel(width)[0]) if np.size(width) else 1.0
    return Look(
        _words(label),
        INK if ink or label == _OTHERS else shade,
        "solid" if dash == "none" else dash,
        round(min(max(1.2 * width, 0.8), 2.4), 2),
        points=points,
    )


def _drawn(axes: Axes, labels: Mapping[tuple[str, str], str]) -> list[tuple[str, Look, Curve]]:
    """Return name, look and values of all that is drawn in some axes."""
    from matplotlib.collections import LineCollection, PathCollection
    from matplotlib.colors import to_rgba

    parts: list[tuple[Look, Curve]] = []
    for line in axes.get_lines():
        marked = line.get_marker() not in ("None", "", None)
        # a line needs two points to be seen
        points = _dash_of(line) == "none" or (marked and np.size(line.get_xdata()) < 2)
        if points and not marked:
            continue
        parts.append((_look(line, line.get_color(), labels, points), _line(axes, line)))
    for part in axes.collections:
        if isinstance(part, PathCollection):
            offsets = np.ma.filled(np.asarray(part.get_offsets(), dtype=float), np.nan)
            shade = part.get_facecolor()
            if len(offsets) and len(shade):
                look = _look(part, shade[0], labels, True)
                parts.append((look, (offsets[:, 0], offsets[:, 1])))
            continue
        stroke = isinstance(part, LineCollection)
        shades = part.get_edgecolor() if stroke else part.get_facecolor()
        if len(shades):
            outlines = [path.vertices for path in part.get_paths()]
            look = _look(part, shades[0], labels, False, filled=not stroke)
            look = look if stroke else _filled(look, _shade(shades[0], part))
            parts.append((look, _outline(outlines)))
    # a shade across all of the axes ends at their limits
    to_data = axes.transData.inverted()
    for patch in axes.patches:
        polygons = patch.get_path().transformed(patch.get_transform() + to_data).to_polygons()
        face, edge = patch.get_facecolor(), patch.get_edgecolor()
        filled = to_rgba(face)[3] > 0
        look = _look(patch, face if filled else edge, labels, False, filled=filled)
        look = _filled(look, _shade(face, patch)) if filled else look
        parts.append((look, _outline(polygons[:1])))
    # what stands at other places than numbers tell is left out: frames and arrows
    found = [(look, curve) for look, curve in parts if np.isfinite(curve[0]).any()]
    return [(look.label + (" (points)" if look.points else ""), look, c) for look, c in found]


def _filled(look: Look, color: str) -> Look:
    """Return how a shade of that colour looks."""
    label = _SHADES if look.label == _OTHERS else f"{look.label}, shade"
    return replace(look, label=label, color=color, dash=FILL)


def _line(axes: Axes, line: Any) -> Curve:
    """Return the values of a line; one across all of the axes ends at their limits."""
    x, y = (np.array(values, dtype=float) for values in (line.get_xdata(), line.get_ydata()))
    transform = line.get_transform()
    if transform == axes.get_yaxis_transform(which="grid"):
        low, high = axes.get_xlim()
        x = low + (high - low) * x
    elif transform == axes.get_xaxis_transform(which="grid"):
        low, high = axes.get_ylim()
        y = low + (high - low) * y
    return _stepped(x, y, line.get_drawstyle())


def _stepped(x: np.ndarray, y: np.ndarray, style: str) -> Curve:
    """Return a curve with the corners of its steps."""
    if style == "steps-post":
        return np.repeat(x, 2)[1:], np.repeat(y, 2)[:-1]
    if style in ("steps", "steps-pre"):
        return np.repeat(x, 2)[:-1], np.repeat(y, 2)[1:]
    return x, y


def _outline(paths: list[Any]) -> Curve:
    return joined([(np.asarray(p, float)[:, 0], np.asarray(p, float)[:, 1]) for p in paths])
