"""Figures drawn and kept: what a figure shows, its file, and reading it back with its caption."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from residnet.report.blocks import Figure, Section
from residnet.report.figures.style import save

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
                words = dict(picture.info)
        except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
            # damaged: it is drawn again, or is not one of residnet
            continue
        if "Title" in words and "Description" in words:
            out.append(Figure(path, str(words["Title"]), str(words["Description"])))
    return out


def figures_section(folder: Path) -> Section | None:
    """Return a section with all figures of a folder, None where there are none."""
    figures = read_figures(folder)
    return Section("Figures", figures, pictures=True) if figures else None
