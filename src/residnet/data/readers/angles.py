"""Angles written in degrees and minutes, with or without a hemisphere."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import shown

if TYPE_CHECKING:
    import pandas as pd

Form = Literal["number", "ddmm"]
"""How a number stands for an angle: as degrees, or as degrees and minutes in one."""
LetterO = Literal["east", "west"]
"""What O stands for: Ost and Oost, or Oeste, Ouest and Ovest."""
_NUMBER = r"\d+(?:[.,]\d+)?"
_FORM = (
    r"^\s*(?P<lead>[NSEWOnsewo])?\s*(?P<sign>[-+−])?\s*"
    rf"(?P<degrees>{_NUMBER})\s*(?:°|º|˚|deg\.?|d)?"
    rf"(?:(?:(?<=[°º˚d.g])\s*|\s+|\s*[:\-]\s*)(?P<minutes>{_NUMBER})\s*(?:''|['′’´:m]|min\.?)?"
    rf"(?:(?:(?<=['′’´:mn.])\s*|\s+)(?P<seconds>{_NUMBER})\s*(?:\"|″|”|''|′′|’’|sec\.?)?)?)?"
    r"[\s,]*(?P<tail>[NSEWOnsewo])?\s*$"
)
_SIDES = {"n": 1.0, "e": 1.0, "s": -1.0, "w": -1.0}
_OF = {"latitude": "ns", "longitude": "ew"}


def degrees_of(
    cells: pd.Series, name: str, form: Form = "number", letter_o: LetterO | None = None
) -> np.ndarray:
    """Return angles [T] in degrees from cells such as `59°54.321'N`, `59 54 19.3 N` or `-59.9`.

    NaN stands for empty cells.

    Args:
        cells: of one column.
        name: of the channel: a latitude has no east.
        form: of a number that stands alone.
        letter_o: what O stands for; None refuses it.

    Raises:
        DataError: naming the first cell that is no such angle.
    """
    import pandas as pd

    if pd.api.types.is_numeric_dtype(cells):
        values = cells.to_numpy(dtype=np.float64, na_value=np.nan)
        angles = from_form(values, form)
        _require(cells, np.isnan(angles) & ~np.isnan(values), name)
        return angles
    column = cells.astype("string").str.strip()
    known = (column.notna() & (column != "")).to_numpy()
    parts = column[known].str.extract(_FORM)
    degrees, minutes, seconds = (
        pd.to_numeric(parts[part].str.replace(",", "."), errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        for part in ("degrees", "minutes", "seconds")
    )
    alone = np.isnan(minutes)
    degrees = np.where(alone, from_form(degrees, form), degrees)
    # a fraction has nothing below it; sixty is what a printer may have rounded to
    wrong = np.isnan(degrees) | (~alone & ((degrees % 1 > 0) | (minutes > 60.0)))
    wrong |= ~np.isnan(seconds) & ((minutes % 1 > 0) | (seconds > 60.0))
    lead, tail = (parts[part].str.lower() for part in ("lead", "tail"))
    side = lead.fillna(tail)
    turned = parts["sign"].fillna("+").isin(["-", "−"]).to_numpy()
    signs = side_signs(side, name, letter_o)
    wrong |= (lead.notna() & tail.notna()).to_numpy() | (turned & (signs > 0) & side.notna())
    _require(column[known], wrong, name)
    out = np.full(len(cells), np.nan)
    size = degrees + np.nan_to_num(minutes) / 60.0 + np.nan_to_num(seconds) / 3600.0
    out[known] = np.where(turned, -1.0, signs) * size
    return out


def from_form(values: np.ndarray, form: Form) -> np.ndarray:
    """Return degrees [T] from numbers of a form; NaN where the minutes are more than sixty."""
    if form == "number":
        return values
    size = np.abs(values)
    whole, minutes = np.floor(size / 100.0), size % 100.0
    with np.errstate(invalid="ignore"):
        out: np.ndarray = np.where(minutes <= 60.0, np.sign(values), np.nan)
    out *= whole + minutes / 60.0
    return out


def side_signs(sides: pd.Series, name: str, letter_o: LetterO | None = None) -> np.ndarray:
    """Return 1 or -1 [T] for the letters of hemispheres; 1 where there is none.

    Raises:
        DataError: where a letter is none of this channel's.
    """
    letters = sides.astype("string").str.strip().str.lower()
    letters = letters.mask(letters == "")
    if letter_o is not None and name == "longitude":
        letters = letters.replace("o", letter_o[0])
    allowed = _OF.get(name, "nsew")
    wrong = (letters.notna() & ~letters.isin([*allowed])).to_numpy(dtype=bool)
    if wrong.any():
        first = shown(str(sides.iloc[int(np.argmax(wrong))]), 20)
        either = (
            "; O is east to some and west to others: set letter_o" if first.upper() == "O" else ""
        )
        raise DataError(
            f"'{first}' is no hemisphere of {name}; {' or '.join(allowed.upper())} was"
            f" expected{either}"
        )
    return letters.map(_SIDES).fillna(1.0).to_numpy(dtype=np.float64)


def _require(cells: pd.Series, wrong: np.ndarray, name: str) -> None:
    if wrong.any():
        at = int(np.argmax(wrong))
        raise DataError(
            f"'{shown(str(cells.iloc[at]), 40)}' is no {name if name in _OF else 'angle'}"
            f" ({int(wrong.sum())} such cells); forms that are read are 59.90535, 59°54.321'N,"
            " 59 54 19.3 N and, with `form: ddmm`, 5954.321"
        )
