"""Figures drawn and kept: what a figure shows, its file, and reading it back with its caption."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.report.blocks import Figure, Section
from residnet.report.figures.style import CURVES, save
from residnet.report.interactive.pictures import picture_explorer

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Canvas


@dataclass(frozen=True)
class Drawing:
    """A matplotlib figure with the words that go with it.

    Attributes:
        name: of its file, without suffix.
        title: a few words.
        caption: whole sentences that say what to look for.
        figure: the matplotlib figure.
    """

    name: str
    title: str
    caption: str
    figure: Canvas


def write_drawings(folder: Path, drawings: Iterable[Drawing]) -> list[Figure]:
    """Write one PNG for each drawing.

    Figures that an earlier call left in the folder are replaced; other pictures stay.

    Args:
        folder: for the pictures.
        drawings: in the order in which a page shows them.

    Returns:
        The written figures.
    """
    for figure in read_figures(folder):
        figure.path.unlink()
    out: list[Figure] = []
    for drawing in drawings:
        # the number keeps the order for whoever lists the folder
        path = folder / f"{len(out) + 1:02d}_{drawing.name}.png"
        save(drawing.figure, path, drawing.title, drawing.caption)
        out.append(Figure(path, drawing.title, drawing.caption))
    return out


def read_figures(folder: Path) -> list[Figure]:
    """Return the figures of a folder with their captions, in the order of their names.

    Pictures without a caption were not written by residnet and are left out, as damaged ones are.
    """
    from PIL import Image

    out: list[Figure] = []
    for path in sorted(folder.glob("*.png")):
        try:
            with Image.open(path) as picture:
                words = {str(name): text for name, text in picture.info.items()}
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
            # damaged: it is drawn again, or is not one of residnet
            continue
        if "Title" in words and "Description" in words:
            out.append(_figure(path, words))
    return out


def _figure(path: Path, words: Mapping[str, Any]) -> Figure:
    title, caption = str(words["Title"]), str(words["Description"])
    if CURVES not in words:
        return Figure(path, title, caption)
    name = "figure-" + re.sub(r"[^a-z0-9]+", "-", path.stem.lower())
    return Figure(path, title, caption, picture_explorer(name, title, caption, str(words[CURVES])))


def picture_alone(path: Path) -> bytes:
    """Return a picture's file without its curves, which a page holds in a form of its own."""
    data = path.read_bytes()
    out, at = [data[:8]], 8
    while at < len(data):
        end = at + 12 + int.from_bytes(data[at : at + 4], "big")
        if data[at + 4 : at + 9 + len(CURVES)] != b"iTXt" + CURVES.encode() + b"\0":
            out.append(data[at:end])
        at = end
    return b"".join(out)


def figures_section(folder: Path, covered: str = "") -> Section | None:
    """Return a section with all figures of a folder, None where there are none.

    Args:
        folder: with the pictures.
        covered: regular expression of the names of those that other interactive figures of the
            page show already; they are drawn as pictures, for print.
    """
    figures = read_figures(folder)
    name = re.compile(rf"(\d+_)?({covered})")
    hidden = [figure for figure in figures if name.fullmatch(figure.path.stem)]
    shown = [figure for figure in figures if figure not in hidden]
    still = [replace(figure, explorer=None) for figure in hidden]
    if not figures:
        return None
    if not shown:
        return Section("Figures", still, pictures=True)
    pictures = Section("Pictures of the interactive figures", still, pictures=True)
    return Section("Figures", [*shown, pictures if still else None])
