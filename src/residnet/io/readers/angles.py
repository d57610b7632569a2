"""Parsers of latitudes, longitudes and other angles, as people and receivers write them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import truncate
from residnet.io.readers.timestamps import require_valid_cells, strip_cells

if TYPE_CHECKING:
    import pandas as pd

AngleForm = Literal["number", "ddmm"]
"""Notation of an angle in one number: decimal degrees, or degrees and minutes as in 5954.321."""
LetterO = Literal["east", "west"]
"""Meaning of the letter O in a longitude: Ost and Oost, or Oeste, Ouest and Ovest."""
_DECIMAL = r"\d+(?:[.,]\d+)?"
_ANGLE_PATTERN = (
    r"^\s*(?P<lead>[NSEWOnsewo])?\s*(?P<sign>[-+−])?\s*"
    rf"(?P<degrees>{_DECIMAL})\s*(?:°|º|˚|deg\.?|d)?"
    rf"(?:(?:(?<=[°º˚d.g])\s*|\s+|\s*[:\-]\s*)(?P<minutes>{_DECIMAL})\s*(?:''|['′’´:m]|min\.?)?"
    rf"(?:(?:(?<=['′’´:mn.])\s*|\s+)(?P<seconds>{_DECIMAL})\s*(?:\"|″|”|''|′′|’’|sec\.?)?)?)?"
    r"[\s,]*(?P<tail>[NSEWOnsewo])?\s*$"
)
_HEMISPHERE_SIGNS = {"n": 1.0, "e": 1.0, "s": -1.0, "w": -1.0}
"""Sign of a coordinate by the letter of its hemisphere."""
_HEMISPHERES_OF_CHANNEL = {"latitude": "ns", "longitude": "ew"}
_ACCEPTED_FORMS = (
    "; accepted are 59.90535, 59°54.321'N, 59 54 19.3 N and, with `form: ddmm`, 5954.321"
)


def parse_degrees(
    cells: pd.Series, name: str, form: AngleForm = "number", letter_o: LetterO | None = None
) -> np.ndarray:
    """Convert cells such as `59°54.321'N`, `59 54 19.3 N` or `-59.9` to angles [T] in deg.

    Args:
        cells: text or numbers [T]; empty cells become NaN.
        name: name of the channel; it limits the hemispheres of `latitude` and `longitude`.
        form: notation of cells that are one number.
        letter_o: meaning of O; None rejects it.

    Raises:
        DataError: if a cell is no such angle; the message quotes the first one.
    """
    import pandas as pd

    quantity = name if name in _HEMISPHERES_OF_CHANNEL else "angle"
    if pd.api.types.is_numeric_dtype(cells):
        values = cells.to_numpy(dtype=np.float64, na_value=np.nan)
        angles = degrees_from_form(values, form)
        require_valid_cells(cells, np.isnan(angles) & ~np.isnan(values), quantity, _ACCEPTED_FORMS)
        return angles
    column, is_filled = strip_cells(cells)
    parts = column[is_filled].str.extract(_ANGLE_PATTERN)
    degrees, minutes, seconds = (
        pd.to_numeric(parts[part].str.replace(",", "."), errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        for part in ("degrees", "minutes", "seconds")
    )
    has_no_minutes = np.isnan(minutes)
    degrees = np.where(has_no_minutes, degrees_from_form(degrees, form), degrees)
    # only the smallest unit may have a fraction; printers round 59.99 to 60
    is_invalid = np.isnan(degrees) | (~has_no_minutes & ((degrees % 1 > 0) | (minutes > 60.0)))
    is_invalid |= ~np.isnan(seconds) & ((minutes % 1 > 0) | (seconds > 60.0))
    # a hemisphere stands before or behind the angle, and replaces a negative sign
    lead, tail = (parts[part].str.lower() for part in ("lead", "tail"))
    hemisphere = lead.fillna(tail)
    is_negative = parts["sign"].fillna("+").isin(["-", "−"]).to_numpy()
    signs = hemisphere_signs(hemisphere, name, letter_o)
    is_invalid |= (lead.notna() & tail.notna()).to_numpy()
    is_invalid |= is_negative & (signs > 0) & hemisphere.notna()
    require_valid_cells(column[is_filled], is_invalid, quantity, _ACCEPTED_FORMS)
    angles_deg = np.full(len(cells), np.nan)
    magnitude = degrees + np.nan_to_num(minutes) / 60.0 + np.nan_to_num(seconds) / 3600.0
    angles_deg[is_filled] = np.where(is_negative, -1.0, signs) * magnitude
    return angles_deg


def degrees_from_form(values: np.ndarray, form: AngleForm) -> np.ndarray:
    """Convert numbers [T] of a notation to degrees [T]; NaN if the minutes exceed 60."""
    if form == "number":
        return values
    magnitude = np.abs(values)
    whole_degrees = np.floor(magnitude / 100.0)
    minutes = magnitude % 100.0
    with np.errstate(invalid="ignore"):
        degrees: np.ndarray = np.where(minutes <= 60.0, np.sign(values), np.nan)
    degrees *= whole_degrees + minutes / 60.0
    return degrees


def hemisphere_signs(
    hemispheres: pd.Series, name: str, letter_o: LetterO | None = None
) -> np.ndarray:
    """Return the sign [T] of each hemisphere: 1 for N and E, -1 for S and W, 1 for empty cells.

    Args:
        hemispheres: letters [T].
        name: name of the channel.
        letter_o: meaning of O; None rejects it.

    Raises:
        DataError: if a cell is no hemisphere of this channel.
    """
    letters = hemispheres.astype("string").str.strip().str.lower()
    letters = letters.mask(letters == "")
    if letter_o is not None and name == "longitude":
        letters = letters.replace("o", letter_o[0])
    allowed = _HEMISPHERES_OF_CHANNEL.get(name, "nsew")
    is_invalid = (letters.notna() & ~letters.isin([*allowed])).to_numpy(dtype=bool)
    if is_invalid.any():
        first_invalid = truncate(str(hemispheres.iloc[int(np.argmax(is_invalid))]), 20)
        hint = ""
        if first_invalid.upper() == "O":
            hint = "; O means east in some languages and west in others: set letter_o"
        raise DataError(
            f"'{first_invalid}' is no hemisphere of {name}; {' or '.join(allowed.upper())} was"
            f" expected{hint}"
        )
    return letters.map(_HEMISPHERE_SIGNS).fillna(1.0).to_numpy(dtype=np.float64)
