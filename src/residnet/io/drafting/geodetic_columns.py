"""Columns of latitude and longitude: notations, hemispheres and the letter O."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import truncate
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.drafting.table_preview import TablePreview
from residnet.io.header_vocabulary import (
    GERMANIC_PATTERN,
    match_state_channel,
    normalize_name,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers.angles import AngleForm, LetterO, hemisphere_signs, parse_degrees

if TYPE_CHECKING:
    import pandas as pd

_ANGLE_FORMS: tuple[AngleForm, ...] = ("number", "ddmm")
MAX_COORDINATES = {"latitude": 90.0, "longitude": 180.0}
"""Largest absolute value of a coordinate in deg."""
_HEMISPHERES = {"latitude": {"N", "S"}, "longitude": {"E", "W", "O"}}
ColumnSettings = Mapping[str, Mapping[str, Any]]
"""Column -> further settings of its entry in a channel map."""


def refuse_minute_columns(path: Path, columns: Sequence[str]) -> None:
    """Refuse positions with degrees and minutes in separate columns.

    Raises:
        DataError: if a column has minutes of latitude or longitude.
    """
    minute_columns = [
        name
        for name in columns
        if match_state_channel(parse_name(name)) in MAX_COORDINATES
        and parse_header_unit(name, "s") == "min"
    ]
    if minute_columns:
        raise DataError(
            f"{path}: '{minute_columns[0]}' has minutes whose degrees are in another"
            " column; write degrees + minutes / 60 to one column each for latitude and longitude"
        )


def refuse_unparsed_positions(preview: TablePreview, column_by_channel: Mapping[str, str]) -> None:
    """Refuse positions in a notation that `convert_positions_to_degrees` does not know.

    Raises:
        DataError: if a column of text is a latitude or longitude, and there is no other position.
    """
    position_texts = [
        name
        for name in preview.text_columns
        if match_state_channel(parse_name(name)) in MAX_COORDINATES
    ]
    if (
        position_texts
        and "x" not in column_by_channel
        and not set(MAX_COORDINATES) <= set(column_by_channel)
    ):
        example = preview.text_columns[position_texts[0]].dropna().iloc[0]
        raise DataError(
            f"{preview.path}: column '{position_texts[0]}' contains"
            f" '{truncate(str(example))}', which is no latitude or longitude; accepted are"
            " 59.90535, 59°54.321'N, 59 54 19.3 N and 5954.321"
        )


def convert_positions_to_degrees(
    preview: TablePreview, draft_notes: DraftNotes
) -> tuple[TablePreview, ColumnSettings]:
    """Convert columns of latitude and longitude to degrees.

    Args:
        preview: first rows of a table.
        draft_notes: receives guesses.

    Returns:
        The table with degrees, and the settings `form`, `hemisphere` and `letter_o` of its columns.
        Tables without both columns in a known notation are unchanged.
    """
    import pandas as pd

    columns: dict[str, str] = {}
    for column in preview.column_names:
        channel = match_state_channel(parse_name(column))
        if channel in MAX_COORDINATES and column not in preview.empty_columns:
            columns.setdefault(channel, column)
    if len(columns) < 2:
        return preview, {}
    cells = {
        name: pd.Series(preview.numeric_columns[column])
        if column in preview.numeric_columns
        else preview.text_columns[column]
        for name, column in columns.items()
    }
    hemisphere_columns = {name: _find_hemisphere_column(preview, name) for name in columns}
    letter_o = _ask_letter_o(
        preview, hemisphere_columns["longitude"] or columns["longitude"], draft_notes
    )
    parsed_positions = _parse_positions(cells, letter_o)
    if parsed_positions is None:
        return preview, {}
    form, degrees = parsed_positions
    settings: dict[str, dict[str, Any]] = {column: {} for column in columns.values()}
    if form == "ddmm":
        for entry in settings.values():
            entry["form"] = form
        text = "numbers above 90 are assumed degrees and minutes in one, 5954.321 for 59° 54.321'"
        draft_notes.add_guess((*CHANNELS_KEY, "latitude"), text)
    for name, hemisphere_column in hemisphere_columns.items():
        if hemisphere_column is not None:
            settings[columns[name]]["hemisphere"] = preview.original_name(hemisphere_column)
            degrees[name] = degrees[name] * hemisphere_signs(
                preview.text_columns[hemisphere_column], name, letter_o
            )
    if letter_o is not None:
        settings[columns["longitude"]]["letter_o"] = letter_o
    converted = {
        **preview.numeric_columns,
        **{columns[name]: values for name, values in degrees.items()},
    }
    used_columns = {*columns.values(), *hemisphere_columns.values()}
    return (
        dataclasses.replace(
            preview,
            numeric_columns={
                name: converted[name] for name in preview.column_names if name in converted
            },
            text_columns={
                name: cells
                for name, cells in preview.text_columns.items()
                if name not in used_columns
            },
        ),
        settings,
    )


def _parse_positions(
    cells: Mapping[str, pd.Series], letter_o: LetterO | None
) -> tuple[AngleForm, dict[str, np.ndarray]] | None:
    """Return the first notation in which all cells are angles in range, and the degrees [T].

    Args:
        cells: cells of latitude and longitude.
        letter_o: meaning of the letter O as a hemisphere.

    Returns:
        None if there is no such notation.
    """
    for form in _ANGLE_FORMS:
        try:
            degrees = {
                name: parse_degrees(texts, name, form, letter_o) for name, texts in cells.items()
            }
        except DataError:
            continue
        max_angles = {name: np.abs(v[np.isfinite(v)]).max(initial=0) for name, v in degrees.items()}
        if all(max_angles[name] <= MAX_COORDINATES[name] for name in cells):
            return form, degrees
    return None


def _ask_letter_o(preview: TablePreview, column: str, draft_notes: DraftNotes) -> LetterO | None:
    """Return the meaning of the letter O as a hemisphere; None if no longitude has it.

    It means east in German and Dutch, west in Romance languages: other cells or the language of the
    column names decide.
    """
    cells = preview.text_columns.get(column)
    if cells is None:
        return None
    letters = {*cells.dropna().astype("string").str.upper().str.extractall("([EOW])")[0]}
    if "O" not in letters:
        return None
    is_germanic = any(
        GERMANIC_PATTERN.search(normalize_name(name)) for name in preview.column_names
    )
    is_east = "W" in letters or ("E" not in letters and is_germanic)
    meaning: LetterO = "east" if is_east else "west"
    reason = f"the letter O is assumed {meaning}; it is east in German and Dutch"
    key = (*CHANNELS_KEY, "longitude")
    question = "meaning of the letter O as a hemisphere"
    answer = draft_notes.ask_question(key, question, meaning, reason, ("west", "east"))
    return "east" if answer == "east" else "west"


def _find_hemisphere_column(preview: TablePreview, name: str) -> str | None:
    """Return the column with the hemispheres of latitude or longitude, or None."""
    for column, cells in preview.text_columns.items():
        letters = set(cells.dropna().astype("string").str.strip().str.upper()) - {""}
        if letters and letters <= _HEMISPHERES[name]:
            return column
    return None
