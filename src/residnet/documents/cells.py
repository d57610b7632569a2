"""What the documents' report pages share: figures of a document beside our own, and pictures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from residnet.report.blocks import Cell
from residnet.report.figure import Figure, read_figures
from residnet.report.format import minus, number


def beside_published(value: float | None, published: float | None, digits: int = 4) -> Cell:
    """Return a cell with a number of the run, and in small print the document's own number.

    Args:
        value: number of the run; None where there is none.
        published: number that the document prints; None where it prints none.
        digits: significant digits.
    """
    # the document's number keeps the digits that it is printed with
    note = "" if published is None else f"published {minus(f'{published:.{digits}g}')}"
    return Cell(number(value, digits), note)


def joined(values: Sequence[float], digits: int = 3) -> str:
    """Return several numbers as text, with slashes between them."""
    return " / ".join(number(value, digits) for value in values)


def listed(names: Sequence[str]) -> str:
    """Return names as a list in a sentence, as in "a, b and c"."""
    *first, last = names
    return f"{', '.join(first)} and {last}" if first else last


def notes_text(notes: Mapping[str, Any]) -> str:
    """Return what an estimator chose in one line, such as "penalty 0.1; order 3/3/1"."""

    def text(value: Any) -> str:
        if isinstance(value, dict):
            return ", ".join(f"{key} {text(part)}" for key, part in value.items())
        if isinstance(value, list):
            return "/".join(text(part) for part in value)
        return number(value, 4) if isinstance(value, float) else str(value)

    return "; ".join(f"{key} {text(value)}" for key, value in notes.items())


def pictures(run: Path, *beginnings: str) -> list[Figure]:
    """Return the figures of a run whose names begin with one of the given beginnings.

    They stand in the order of the beginnings, then in that of their names.
    """
    stored = read_figures(run / "figures")
    return [
        figure for beginning in beginnings for figure in stored if figure.name.startswith(beginning)
    ]
