"""How every figure looks: colours and lines by role, sizes for print, light PNG files."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import numpy as np

from residnet.core.files import whole
from residnet.report.interactive.pictures import curves_text
from residnet.report.run_reader import RunFiles

_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")

DPI = 140
CURVES = "Curves"
"""Name of the text in a picture's file that holds the curves that it shows."""
WIDTH = 7.0
"""Width of every figure in inches: the text block of an A4 page, so that 9 pt stay 9 pt in print.
"""

# Okabe and Ito's palette, which stays distinct under the common colour-vision deficiencies
_ORANGE, _SKY, _GREEN, _BLUE, _VERMILLION, _PURPLE, _GREY = (
    "#E69F00",
    "#56B4E9",
    "#009E73",
    "#0072B2",
    "#D55E00",
    "#CC79A7",
    "#7F7F7F",
)
_HEADS: tuple[tuple[str, Any], ...] = (
    (_BLUE, "-"),
    (_VERMILLION, (0, (6, 1.5))),
    (_PURPLE, (0, (4, 1, 1, 1))),
    (_SKY, (0, (2, 1))),
)
FAMILY: tuple[dict[str, Any], ...] = (
    {"color": _ORANGE, "linestyle": "--"},
    {"color": _BLUE, "linestyle": "-"},
    {"color": _VERMILLION, "linestyle": (0, (6, 1.5))},
    {"color": _PURPLE, "linestyle": (0, (4, 1, 1, 1))},
    {"color": _GREEN, "linestyle": "-."},
    {"color": _SKY, "linestyle": (0, (2, 1))},
)
"""Curves of a family, the reference first."""
# the plant lies on the head that comes near it and shows it through its gaps
_ORDER = {"zero": 3, "baseline": 3, "truth": 5}
MEASURED: dict[str, Any] = {
    "color": "black",
    "linestyle": "-",
    "linewidth": 0.7,
    "label": "measured",
    "zorder": 2,
}
SOLID: dict[str, Any] = {"color": _BLUE, "linestyle": "-", "linewidth": 1.6, "zorder": 3}
DASHED: dict[str, Any] = {"color": _ORANGE, "linestyle": (0, (4, 2)), "linewidth": 1.6, "zorder": 4}
"""Two curves of equal rank, told apart by colour and by line."""
MASKED: dict[str, Any] = {"color": "0.88", "linewidth": 0, "zorder": 0}

# Any: matplotlib types the keys as a closed set of literals
RC: Any = {
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


def styled(draw: Callable[_Arguments, _Result]) -> Callable[_Arguments, _Result]:
    """Return a drawing function that draws in the style of the reports wherever it is called."""

    @wraps(draw)
    def drawn(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        from matplotlib import rc_context

        with rc_context(RC):
            return draw(*args, **kwargs)

    return drawn


def new_figure(height: float) -> Any:
    """Return a figure `WIDTH` wide and `height` inches high, made without pyplot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, height), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, path: Path, title: str, caption: str) -> None:
    """Write a PNG that carries its title and caption as text.

    Its palette of 128 colours takes a third of the bytes; chosen by coverage, it keeps the thin
    lines' own colours, which a palette chosen by frequency would mix.
    """
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    figure.canvas.draw()
    picture = (
        Image.fromarray(np.asarray(figure.canvas.buffer_rgba()))
        .convert("RGB")
        .quantize(128, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    )
    words = PngInfo()
    words.add_itxt("Title", title)
    words.add_itxt("Description", caption)
    # so that a page can show the curves themselves, whenever it is written
    if curves := curves_text(figure):
        words.add_itxt(CURVES, curves, zip=True)
    with whole(path) as file:
        picture.save(file, format="PNG", optimize=True, dpi=(DPI, DPI), pnginfo=words)


def styles(run: RunFiles) -> dict[str, dict[str, Any]]:
    """Return the line properties of each model.

    Zero, baseline and truth have their own; the selected head is always the solid blue one.
    """
    fixed: dict[str, tuple[str, Any]] = {
        "zero": (_GREY, ":"),
        "baseline": (_ORANGE, "--"),
        "truth": (_GREEN, "-."),
    }
    out: dict[str, dict[str, Any]] = {}
    for model, kind in run.kinds.items():
        if kind in fixed:
            color, line = fixed[kind]
        else:
            place = run.heads.index(model)
            color, line = (
                _HEADS[place % len(_HEADS)][0],
                _HEADS[(place + place // len(_HEADS)) % len(_HEADS)][1],
            )
        out[model] = {
            "color": color,
            "linestyle": line,
            "linewidth": 1.4,
            "label": short_label(run, model),
            "zorder": _ORDER.get(kind, 4),
        }
    return out


def short_label(run: RunFiles, model: str) -> str:
    """Return the name of a model in figures, where a long one would run over its neighbours."""
    full = run.label(model)
    return full if len(model) <= 20 else full.replace(model, model[:19] + "…")


def legend_above(figure: Any, handles: dict[str, Any]) -> None:
    """Put one legend above the panels of a figure, in as many columns as its width holds."""
    # in points: the sample and its spaces, then the text at 9 pt
    widths = [46.0 + 4.9 * len(text) for text in handles]
    columns = max(len(widths), 1)
    while columns > 1 and _legend_width(widths, columns) > 72.0 * WIDTH:
        columns -= 1
    figure.legend(handles.values(), handles.keys(), loc="outside upper center", ncols=columns)


def _legend_width(widths: list[float], columns: int) -> float:
    # matplotlib fills a legend column by column
    lines, longer = divmod(len(widths), columns)
    total, start = 0.0, 0
    for column in range(columns):
        stop = start + lines + (1 if column < longer else 0)
        total += max(widths[start:stop])
        start = stop
    return total


def collect(handles: dict[str, Any], axes: Any) -> None:
    """Add the labelled artists of some axes to the handles of a legend, each label once."""
    for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
        handles.setdefault(text, handle)
