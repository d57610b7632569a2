"""A first channel map for an undescribed table, to be checked and pasted into a config.

It is guessed from names, units in the header and values.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from residnet.core.config import validate
from residnet.core.errors import DataError, UsageError
from residnet.core.names import CHANNEL_UNITS, to_si, units
from residnet.data.drafting.text_tables import text_table
from residnet.data.readers.base import LogReader, require_file
from residnet.data.readers.tables.table import CsvConfig, ParquetConfig

if TYPE_CHECKING:
    import pandas as pd

_ROWS = 20_000
# channel -> what columns that hold it are called, without units and punctuation; the first that
# fits is taken
_NAMES = {
    "x": r"x|north|northing|x pos(ition)?( mid)?|pos(ition)? (x|north)|n pos",
    "y": r"y|east|easting|y pos(ition)?( mid)?|pos(ition)? (y|east)|e pos",
    "psi": r"psi( hat)?|heading|yaw|hdg|yaw angle|course angle",
    "u": r"u|surge|surge (velo(city)?|speed)|u velo(city)?|u mid",
    "v": r"v|vm|sway|sway (velo(city)?|speed)|vm? velo(city)?|v mid",
    "r": r"r|yaw ?rate|rate of turn|rot|r ang ?velo(city)?|turn rate",
    "phi": r"phi|roll|roll angle|heel",
    "p": r"p|roll rate",
    "u_dot": r"u ?dot",
    "v_dot": r"v ?dot",
    "r_dot": r"r ?dot",
    "delta": r"delta|rudder( angle)?|delta rudder|rudder deg",
    "n": r"n|rev|rps|rpm|n prop|propeller (speed|revolutions|rpm)|shaft (speed|rpm)",
    "wind_speed": r"wind (speed|velo(city)?)( true)?|true wind speed",
    "wind_dir": r"wind (dir(ection)?|angle)( true)?|true wind dir(ection)?",
}
_TIME = re.compile(r"t|time|timestamp|time stamp|stamp|sec|secs|seconds|elapsed( time)?|t s")
_IN_BRACKETS = re.compile(r"[\[(]([^\])]*)[\])]")
_WRITTEN = {
    "deg/sec": "deg/s",
    "knots": "kn",
    "kts": "kn",
    "knot": "kn",
    "degrees": "deg",
    "°": "deg",
    "mps": "m/s",
    "nm": "N m",
    "sec": "s",
    "": "-",
}


@dataclass(frozen=True)
class Draft:
    """A channel map that may be right.

    Attributes:
        content: `data.reader` of a config.
        remarks: columns that were left out, in the form of `Log.meta["findings"]`.
    """

    content: dict[str, Any]
    remarks: tuple[dict[str, Any], ...]

    def reader(self) -> LogReader:
        """Return the reader that it describes."""
        kind = CsvConfig if self.content["kind"] == "csv" else ParquetConfig
        return validate(self.content, kind, "draft channel map").build()

    def lines(self) -> list[str]:
        """Return the map as YAML, to paste under `data:`."""
        out = ["reader:", f"  kind: {self.content['kind']}"]
        out += [
            f"  {key}: {self.content[key]!r}".replace("'", '"')
            for key in ("delimiter", "decimal")
            if key in self.content
        ]
        time = self.content["time"]
        out += [f'  time: {{column: "{time["column"]}", unit: {time["unit"]}}}', "  channels:"]
        return out + [
            f'    {name}: {{column: "{entry["column"]}", unit: {entry["unit"]}}}'
            for name, entry in self.content["channels"].items()
        ]


def draft_map(path: Path) -> Draft:
    """Guess the channel map of a csv or Parquet table from its header and first 20,000 rows.

    Raises:
        UsageError: where there is no file, or it is no table.
        DataError: where it is empty, or no column increases as time does.
    """
    require_file(path)
    table, about = _peek(path)
    numbers, remarks = _numeric(table)
    clock = _clock(path, numbers)
    channels: dict[str, dict[str, str]] = {}
    for column in numbers:
        if column != clock:
            name = _channel(column, channels)
            channels[name] = {"column": column, "unit": _unit(name, column, numbers[column])}
    if not channels:
        raise DataError(f"{path}: no column beside time '{clock}' holds numbers")
    content = {**about, "time": {"column": clock, "unit": _time_unit(clock)}, "channels": channels}
    return Draft(content, tuple(remarks))


def _peek(path: Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    if path.suffix == ".parquet":
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            batches = pq.ParquetFile(path).iter_batches(batch_size=_ROWS)
            return next(batches).to_pandas(), {"kind": "parquet"}
        except (pa.ArrowException, OSError, StopIteration) as error:
            raise DataError(
                f"{path}: not a readable Parquet table"
                f" ({str(error).splitlines()[0] if str(error) else 'no rows'})"
            ) from error
    table, about = text_table(path, _ROWS)
    table.columns = [str(name).strip() for name in table.columns]
    return table, about


def _numeric(table: pd.DataFrame) -> tuple[dict[str, np.ndarray], list[dict[str, Any]]]:
    """Return the columns that hold numbers, and remarks about those that do not."""
    import pandas as pd

    numbers: dict[str, np.ndarray] = {}
    empty, text = [], []
    for column in table.columns:
        values = pd.to_numeric(table[column], errors="coerce").to_numpy(dtype=float)
        if table[column].isna().all():
            empty.append(str(column))
        elif np.isnan(values).sum() > table[column].isna().sum() or table[column].dtype == bool:
            text.append(str(column))
        else:
            numbers[str(column)] = values
    remarks = []
    for code, what, names in (
        ("empty_columns", "hold nothing", empty),
        ("text_cells", "hold text", text),
    ):
        if names:
            remarks.append(
                {
                    "level": "note",
                    "code": code,
                    "text": f"{len(names)} columns {what}: {', '.join(names[:8])}",
                    "figures": {"count": len(names)},
                }
            )
    return numbers, remarks


def _clock(path: Path, numbers: dict[str, np.ndarray]) -> str:
    named = [column for column in numbers if _TIME.fullmatch(_bare(column))]
    rising = [
        column
        for column, values in numbers.items()
        if values.size > 1 and bool((np.diff(values) > 0.0).all())
    ]
    if not named and not rising:
        raise DataError(
            f"{path}: no column is called time or increases as time does; name it in a channel map"
            " (--config)"
        )
    return next((column for column in named if column in rising), (named or rising)[0])


def _bare(column: str) -> str:
    """Name without units and punctuation."""
    return re.sub(r"[^a-z]+", " ", _IN_BRACKETS.sub("", column).lower()).strip()


def _channel(column: str, taken: dict[str, Any]) -> str:
    """Return the canonical name, else the column's own made fit to be one."""
    bare = _bare(column)
    if not re.search(r"\d", column):
        for name, pattern in _NAMES.items():
            if name not in taken and re.fullmatch(pattern, bare):
                return name
    made_name = (
        re.sub(r"[^a-z0-9]+", "_", _IN_BRACKETS.sub("", column).lower()).strip("_") or "column"
    )
    made_name = made_name if made_name not in CHANNEL_UNITS else f"{made_name}_"
    while made_name in taken:
        made_name += "_"
    return made_name


def _unit(name: str, column: str, values: np.ndarray) -> str:
    """Return the unit from the header, else the SI unit, else degrees for large angles."""
    declared = _IN_BRACKETS.search(column)
    expected = CHANNEL_UNITS.get(name)
    candidates = [
        declared.group(1).strip() if declared else "",
        *reversed(re.split(r"[_\s]", column)),
    ]
    for text in candidates:
        unit = _WRITTEN.get(text.lower(), text)
        if text and unit in units():
            try:
                to_si(unit, expected)
            except UsageError:
                continue
            return unit
    if expected is None:
        return (
            "rad"
            if re.search(r"dir|angle|azi", _bare(column))
            and float(np.nanmax(np.abs(values))) <= 6.5
            else "-"
        )
    largest = float(np.nanquantile(np.abs(values), 0.99)) if np.isfinite(values).any() else 0.0
    if expected == "rad" and (
        (name in ("delta", "phi") and largest > 1.7)
        or (name in ("psi", "wind_dir") and 30.0 < largest <= 360.0)
    ):
        return "deg"
    return "rpm" if name == "n" and "rpm" in _bare(column) else expected


def _time_unit(column: str) -> str:
    declared = _IN_BRACKETS.search(column)
    candidates: Sequence[str] = [
        declared.group(1).strip() if declared else "",
        *reversed(re.split(r"[_\s]", column)),
    ]
    return next((unit for unit in candidates if unit in ("s", "ms", "us", "ns", "min", "h")), "s")
