"""Positions that a table writes with degrees, minutes and letters of hemispheres."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import shown
from residnet.data.drafting.channels import CHANNELS
from residnet.data.drafting.questions import Marks
from residnet.data.drafting.sheets import Sheet
from residnet.data.drafting.words import plain, state_channel, words_of
from residnet.data.readers.angles import Form, LetterO, degrees_of, side_signs

if TYPE_CHECKING:
    import pandas as pd

_FORMS: tuple[Form, ...] = ("number", "ddmm")
_LARGEST = {"latitude": 90.0, "longitude": 180.0}
_SIDES = {"latitude": {"N", "S"}, "longitude": {"E", "W", "O"}}
_GERMANIC = re.compile(r"breite|l(?:ae|a)nge|breedte|lengte|zeit|tijd|kurs|koers|ruder|roer")
Settings = Mapping[str, Mapping[str, Any]]
"""Column -> what its entry in a channel map says beside column and unit."""


def with_degrees(sheet: Sheet, marks: Marks) -> tuple[Sheet, Settings]:
    """Return a sheet with its positions as numbers of degrees, and how their columns are read.

    Columns that hold nothing that can be read so stay what they are.
    """
    columns = _columns(sheet)
    if set(columns) != set(_LARGEST):
        return sheet, {}
    numbers: dict[str, np.ndarray] = {}
    settings: dict[str, dict[str, Any]] = {}
    letter_o, why = _letter_o(sheet, columns["longitude"])
    for form in _FORMS:
        try:
            numbers = {
                column: _degrees(sheet, name, column, form, letter_o)
                for name, column in columns.items()
            }
        except DataError:
            continue
        if all(_largest(numbers[column]) <= _LARGEST[name] for name, column in columns.items()):
            settings = {column: {} if form == "number" else {"form": form} for column in numbers}
            break
    if not settings:
        return sheet, {}
    if settings[columns["latitude"]]:
        text = "numbers beyond 90 are taken as degrees and minutes in one, 5954.321 for 59° 54.321'"
        marks.guess((*CHANNELS, "latitude"), text)
    for name, column in columns.items():
        side = _side(sheet, name)
        if side is not None:
            settings[column]["hemisphere"] = sheet.column(side)
            numbers[column] = numbers[column] * side_signs(sheet.texts[side], name, letter_o)
    if letter_o is not None:
        settings[columns["longitude"]]["letter_o"] = letter_o
        marks.guess((*CHANNELS, "longitude"), why)
    used = {entry["hemisphere"] for entry in settings.values() if "hemisphere" in entry}
    texts = {name: cells for name, cells in sheet.texts.items() if name not in {*numbers, *used}}
    read = {**sheet.numbers, **numbers}
    order = {name: read[name] for name in sheet.header if name in read}
    return dataclasses.replace(sheet, numbers=order, texts=texts), settings


def _columns(sheet: Sheet) -> dict[str, str]:
    """Return channel -> the first column called latitude, or longitude."""
    out: dict[str, str] = {}
    for column in sheet.header:
        channel = state_channel(words_of(column))
        if channel in _LARGEST and column not in sheet.empty:
            out.setdefault(channel, column)
    return out


def _letter_o(sheet: Sheet, longitude: str) -> tuple[LetterO | None, str]:
    """Return what O means as a hemisphere, and why; None where no longitude has it.

    Beside W it is the east, and beside E the west. Alone it is as the names of columns have it:
    the east in German and Dutch, the west in Spanish, French, Italian and Portuguese.
    """
    side = _side(sheet, "longitude")
    cells = sheet.texts.get(side or longitude)
    if cells is None:
        return None, ""
    ends = cells.dropna().astype("string").str.upper().str.extract(r"^\s*([EOW])?.*?([EOW])?\s*$")
    found = {str(letter) for end in ends for letter in ends[end].dropna().unique()}
    if "O" not in found:
        return None, ""
    if len(found) > 1:
        return ("east" if "W" in found else "west"), f"O stands beside {min(found - {'O'})}"
    german = any(_GERMANIC.search(plain(name)) for name in sheet.header)
    means: LetterO = "east" if german else "west"
    return means, f"the letter O is taken as {means}, by the language of the columns' names"


def _degrees(
    sheet: Sheet, name: str, column: str, form: Form, letter_o: LetterO | None
) -> np.ndarray:
    """Return the values [T] of the column of a channel in degrees.

    Raises:
        DataError: where it cannot be read so.
    """
    import pandas as pd

    values = sheet.numbers.get(column)
    cells = sheet.texts[column] if values is None else pd.Series(values)
    return degrees_of(cells, name, form, letter_o)


def _largest(values: np.ndarray) -> float:
    return float(np.nanmax(np.abs(values))) if np.isfinite(values).any() else 0.0


def _side(sheet: Sheet, name: str) -> str | None:
    """Return the column that holds the letters of a channel's hemispheres; None for none."""
    return next(
        (
            column
            for column, cells in sheet.texts.items()
            if _letters(cells) and _letters(cells) <= _SIDES[name]
        ),
        None,
    )


def _letters(cells: pd.Series) -> set[str]:
    filled = cells.dropna().astype("string").str.strip().str.upper()
    return set(filled[filled != ""].unique())


def refuse_written_positions(sheet: Sheet, names: Mapping[str, str]) -> None:
    """Refuse positions that cannot be read where there are no others.

    Raises:
        DataError: naming the column and its first cell.
    """
    found = [
        name
        for name in sheet.texts
        if state_channel(words_of(name)) in _LARGEST and "x" not in names
    ]
    if found and not set(_LARGEST) <= set(names):
        cell = sheet.texts[found[0]].dropna().iloc[0]
        raise DataError(
            f"{sheet.path}: column '{found[0]}' holds '{shown(str(cell))}', which is no latitude or"
            " longitude beside its other column; forms that are read are 59.90535, 59°54.321'N,"
            " 59 54 19.3 N and 5954.321"
        )
