"""Cells of one column of a topic's csv, as its chunks come."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, final

import numpy as np

from residnet.core.errors import DataError
from residnet.data.readers.recording import Remark, key_of, remark
from residnet.data.readers.stamps import Stamps, parse_texts

if TYPE_CHECKING:
    import pandas as pd

SECONDS, NANOSECONDS = ("secs", "sec"), ("nsecs", "nanosec")
"""Last parts of the names of a header stamp's two columns, in ROS 1 and ROS 2."""


def names_sender(column: str) -> bool:
    """Return whether a column says who sent a row."""
    return key_of(column).endswith("frame_id")


@final
class Cells:
    """One column as its chunks come.

    Times are whole ns, numbers float64 (whole stamps int64); of text only a summary is kept.
    """

    def __init__(self, name: str, *, is_time: bool) -> None:
        self.name, self.rows, self.spoilt, self.cut = name, 0, 0, False
        self._is_time, self._whole = (
            is_time,
            key_of(name).rsplit("_", 1)[-1]
            in (
                *SECONDS,
                *NANOSECONDS,
            ),
        )
        self._parts: list[np.ndarray] = []
        self._filled, self._sample = 0, ""
        self._stamps: list[Stamps] = []

    def add(self, cells: pd.Series) -> None:
        """Append one chunk of the column.

        Raises:
            DataError: where a cell of the time column is no time.
        """
        import pandas as pd

        self.rows += len(cells)
        if self._is_time:
            self._stamps.append(self._parsed(cells.to_numpy(dtype=object)))
            return
        if names_sender(self.name) and not pd.api.types.is_numeric_dtype(cells.dtype):
            # one object per name, not per row
            names = cells.fillna("").astype(str).astype("category")
            self._parts.append(
                np.array(names.cat.categories, dtype=object)[names.cat.codes.to_numpy()]
            )
            self._sample, self._filled = "name", self._filled + len(cells)
            self.spoilt += len(cells)
            return
        if pd.api.types.is_numeric_dtype(cells.dtype):
            whole = self._whole and cells.dtype.kind in "iu"
            self._parts.append(cells.to_numpy() if whole else cells.to_numpy(dtype=np.float64))
            self._filled += int(cells.notna().sum())
            return
        numbers = pd.to_numeric(cells.astype("string"), errors="coerce").to_numpy(
            dtype=np.float64, na_value=np.nan
        )
        self._parts.append(numbers)
        filled = cells.notna().to_numpy()
        self._filled += int(filled.sum())
        self.spoilt += int((filled & np.isnan(numbers)).sum())
        self._sample = self._sample or str(next(iter(cells[filled & np.isnan(numbers)]), ""))

    def _parsed(self, texts: np.ndarray) -> Stamps:
        if self.cut:
            raise DataError(f"row {self.rows - len(texts)} of column '{self.name}' is no time")
        unpadded = None if not self._stamps else self._stamps[0].unpadded
        try:
            return parse_texts(texts, unpadded)
        except DataError:
            # a recorder that loses power leaves half a row
            self.cut = True
            if len(texts) < 2:
                raise
            return parse_texts(texts[:-1], unpadded)

    @property
    def numeric(self) -> bool:
        """Whether most of what is filled in are numbers."""
        return not self._is_time and (not self.spoilt or 2 * self.spoilt < self._filled)

    def numbers(self) -> np.ndarray:
        """Return the column [T] as numbers."""
        return np.concatenate(self._parts)

    def words(self) -> np.ndarray:
        """Return the column [T] as text."""
        return np.concatenate(
            [
                part if part.dtype == object else np.full(part.size, "", dtype=object)
                for part in self._parts
            ]
        )

    def times(self) -> Stamps:
        """Return the column as times."""
        first = self._stamps[0]
        remarks = tuple(noted for stamps in self._stamps for noted in stamps.remarks)
        # one remark for all chunks
        merged = (
            [
                {
                    **remarks[0],
                    "figures": {
                        key: sum(noted["figures"][key] for noted in remarks)
                        for key in remarks[0]["figures"]
                    },
                }
            ]
            if remarks
            else []
        )
        return dataclasses.replace(
            first, ns=np.concatenate([stamps.ns for stamps in self._stamps]), remarks=tuple(merged)
        )

    def remark(self, topic: str) -> Remark:
        """Return the remark about a column of text."""
        kind = "structures" if self._sample.startswith(("{", "[", "(")) else "text"
        shown = self._sample if len(self._sample) <= 40 else self._sample[:37] + "..."
        text = (
            f"topic {topic}: column '{self.name}' holds {kind} ('{shown}'), not numbers; it is"
            " left out"
        )
        return remark("note", "not_numbers", text, rows=float(self.rows))
