"""The rows of a table as they come, piece by piece, brought to the channels of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import final

import numpy as np

from residnet.core.errors import DataError
from residnet.core.names import to_si
from residnet.data.plausible import beyond_belief, fills, largest
from residnet.data.readers.base import require_increasing, require_samples, require_values
from residnet.data.readers.recording import Remark, remark
from residnet.data.readers.spool import Spool
from residnet.data.readers.tables.channel_map import ChannelMap


@final
class Rows:
    """The rows of a table, collected piece by piece: measured ones are kept, in SI.

    What must hold over the whole table is checked on the way.
    """

    def __init__(
        self,
        path: Path,
        time: tuple[str, str],
        channels: Mapping[str, ChannelMap],
        row: Callable[[int], str],
        *,
        on_disk: bool,
    ) -> None:
        self._path, self._channels, self._row = path, channels, row
        self._time, self._time_unit = time
        self._spool = Spool(1 + len(channels), on_disk=on_disk)
        self._count, self._end = 0, 0
        self._fills: dict[str, int] = {}
        self._has_values = dict.fromkeys(channels, False)
        self._heading = np.nan
        self._places: list[tuple[int, range | np.ndarray]] = []

    def add(self, values: list[np.ndarray], first: int) -> None:
        """Append one piece: time and channels as they stand in the table.

        `first` is the index of the first row.

        Raises:
            DataError: where a row has measurements but no time, or a value is none that a vessel
                can have.
        """
        finite = [np.isfinite(channel) for channel in values[1:]]
        known, clock = np.logical_or.reduce(finite), np.isfinite(values[0])
        undated = np.flatnonzero(known & ~clock)
        if undated.size:
            raise DataError(
                f"{self._path}: {self._row(first + int(undated[0]))} has measurements but no time"
                f" in column '{self._time}' ({undated.size} such rows); delete them"
                " or restore their time"
            )
        keep = clock
        if not self._end:
            keep = keep & np.logical_or.accumulate(known)
        if not keep.any():
            return
        whole = bool(keep.all())
        index = slice(None) if whole else np.flatnonzero(keep)
        self._places.append(
            (
                self._count,
                range(first, first + len(keep)) if whole else np.flatnonzero(keep) + first,
            )
        )
        channels = []
        for (name, entry), raw, has_value in zip(
            self._channels.items(), values[1:], finite, strict=True
        ):
            self._has_values[name] |= bool(has_value.any())
            filled = fills(raw)
            if filled.any():
                self._fills[name] = self._fills.get(name, 0) + int(filled.sum())
                raw = np.where(filled, np.nan, raw)
            self._require_plausible(name, entry, raw, first)
            channels.append(self._continued(name, entry.convert(name, raw[index])))
        self._spool.add([values[0][index] * to_si(self._time_unit), *channels])
        measured = np.flatnonzero(known[index])
        if measured.size:
            self._end = self._count + int(measured[-1]) + 1
        self._count += int(keep.sum())

    def finish(self) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Return the time and channels up to the last measurement.

        Raises:
            DataError: where there are too few rows, time does not increase, or a channel holds no
                number.
        """
        t, *values = (column[: self._end] for column in self._spool.finish())
        require_samples(self._path, t)
        require_increasing(self._path, t, lambda i: self._row(self._table_row(i)))
        for (name, entry), has_value in zip(
            self._channels.items(), self._has_values.values(), strict=True
        ):
            if not has_value:
                require_values(self._path, name, entry.column, np.full(t.size, np.nan))
        return t, dict(zip(self._channels, values, strict=True))

    def remarks(self) -> list[Remark]:
        """Return what was seen on the way, in the form of `Log.meta["findings"]`."""
        return [
            remark(
                "note",
                "fill_values",
                f"{count} cells of {name} hold a fill value and count as missing",
                count=count,
            )
            for name, count in self._fills.items()
        ]

    def _require_plausible(self, name: str, entry: ChannelMap, raw: np.ndarray, first: int) -> None:
        """Stop at a value that no vessel can have.

        Raises:
            DataError: naming its row and column.
        """
        unit = entry.si(name)
        bad = np.flatnonzero(beyond_belief(entry.in_si(name, raw), unit))
        if bad.size:
            i = int(bad[0])
            raise DataError(
                f"{self._path}: {self._row(first + i)}, column '{entry.column}': {raw[i]:g} makes"
                f" {name} larger than {largest(unit):g} {unit}, which no vessel reaches"
                f" ({bad.size} such cells); correct or empty them, or correct the unit"
            )

    def _continued(self, name: str, values: np.ndarray) -> np.ndarray:
        """Return a piece of a channel; a heading goes on from the piece before."""
        if name != "psi":
            return values
        known = np.flatnonzero(np.isfinite(values))
        if not known.size:
            return values
        if np.isfinite(self._heading):
            turns = np.rint((values[known[0]] - self._heading) / (2.0 * np.pi))
            values = values - 2.0 * np.pi * turns if turns else values
        self._heading = float(values[known[-1]])
        return values

    def _table_row(self, i: int) -> int:
        """Return the index in the table of a kept row."""
        start, places = next(
            (start, places) for start, places in reversed(self._places) if start <= i
        )
        return int(places[i - start])
