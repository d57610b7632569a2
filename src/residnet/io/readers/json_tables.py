"""JSON lines and JSON documents as tables, with a column for each key."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

from residnet.core.errors import DataError
from residnet.core.names import truncate
from residnet.io.readers.text_encoding import open_as_utf8
from residnet.io.readers.text_tables import coerce_numeric

if TYPE_CHECKING:
    import pandas as pd

_MAX_LIST_COLUMNS = 16
"""Longest JSON list whose entries become columns."""
_MIN_TABLE_ROWS = 20
"""Number of rows from which a second list in a JSON document counts as a table."""


def read_json_head(path: Path, rows: int) -> pd.DataFrame:
    """Return the first rows of a JSON table, with a column for each key."""
    import pandas as pd

    objects = list(islice(JsonObjectReader(path), rows))
    if not objects:
        raise DataError(f"{path}: the file is empty; one JSON object per line was expected")
    return coerce_numeric(pd.DataFrame(objects).infer_objects())


@final
class JsonObjectReader:
    """Iterator over the flattened objects of a JSON file; nested keys become `nav.lat`, `q[0]`."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.is_truncated = False

    def __iter__(self) -> Iterator[dict[str, Any]]:
        n_objects = 0
        with open_as_utf8(self._path) as file, file.open("rb") as stream:
            if (table := _parse_json_table(self._path, file)) is not None:
                yield from map(_flatten_json, table)
                return
            for line_number, line in enumerate(stream, start=1):
                text = line.decode("utf-8-sig", errors="replace").strip()
                try:
                    if text:
                        value = json.loads(text)
                        if not isinstance(value, dict):
                            raise ValueError("no object")
                        yield from _expand_signal_k(value)
                        n_objects += 1
                except (ValueError, RecursionError) as error:
                    # the last line is incomplete if the recorder was switched off
                    self.is_truncated = n_objects > 0 and not line.endswith(b"\n")
                    if self.is_truncated:
                        return
                    raise DataError(
                        f"{self._path}: line {line_number}, '{truncate(text, 60)}', is no JSON"
                        " object; give files with one object per line"
                    ) from error


def _parse_json_table(path: Path, file: Path) -> Sequence[Mapping[str, Any]] | None:
    """Return the rows of the table in a JSON document; None if the file has one object per line.

    Raises:
        DataError: if the document contains no table or several.
    """
    if path.suffix.lower() != ".json":
        return None
    try:
        document = json.loads(file.read_text("utf-8-sig", errors="replace"))
    except (ValueError, RecursionError):
        return None
    tables = dict(_find_json_tables(document))
    if not tables:
        raise DataError(
            f"{path}: contains no table; a list of objects, or named lists of equal length, were"
            " expected"
        )
    longest_name = max(tables, key=lambda name: len(tables[name]))
    other_names = [
        name
        for name, rows in tables.items()
        if len(rows) >= _MIN_TABLE_ROWS and name != longest_name
    ]
    if other_names:
        table_sizes = ", ".join(
            f"{name} ({len(tables[name])} rows)" for name in [longest_name, *other_names]
        )
        raise DataError(
            f"{path}: contains several tables, {table_sizes}; write each with its time to a"
            " separate file: files whose names differ in one word only are read as one log"
        )
    return tables[longest_name]


def _find_json_tables(
    value: Any, name: str = ""
) -> Iterator[tuple[str, Sequence[Mapping[str, Any]]]]:
    """Yield name and rows of each table in a JSON value.

    A table is a list of objects, or a group of named lists of equal length.
    """
    if isinstance(value, list) and value and all(isinstance(row, dict) for row in value):
        yield name, value
    if not isinstance(value, dict):
        return
    columns = {key: cells for key, cells in value.items() if isinstance(cells, list)}
    plain_columns = {
        n: c for n, c in columns.items() if not any(isinstance(cell, dict) for cell in c)
    }
    max_length = max(map(len, plain_columns.values()), default=0)
    plain_columns = {key: cells for key, cells in plain_columns.items() if len(cells) == max_length}
    if len(plain_columns) > 1:
        yield (
            name,
            [
                dict(zip(plain_columns, row, strict=True))
                for row in zip(*plain_columns.values(), strict=True)
            ],
        )
    for key, child in value.items():
        yield from _find_json_tables(child, f"{name}.{key}" if name else str(key))


def _expand_signal_k(value: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the rows of an object: one, or one for each update of a Signal K message."""
    updates = value.get("updates")
    if not isinstance(updates, list) or "context" not in value:
        yield _flatten_json(value)
        return
    for update in updates:
        values_by_path = {entry["path"]: entry["value"] for entry in update.get("values", [])}
        yield _flatten_json({"timestamp": update.get("timestamp")} | values_by_path)


def _flatten_json(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the numbers and texts of a nested object, by keys such as `nav.lat` and `q[0]`."""
    flattened: dict[str, Any] = {}
    if value.get("type") == "Point" and isinstance(value.get("coordinates"), list):
        # GeoJSON, RFC 7946, section 3.1.1
        coordinates = zip(("longitude", "latitude"), value["coordinates"], strict=False)
        value = dict(coordinates)
    for key, entry in value.items():
        name = f"{prefix}{key}"
        if isinstance(entry, dict):
            flattened |= _flatten_json(entry, f"{name}.")
        elif isinstance(entry, list):
            # longer lists are scans or images, not channels
            entry = entry if len(entry) <= _MAX_LIST_COLUMNS else []
            flattened |= _flatten_json({f"{name}[{i}]": part for i, part in enumerate(entry)})
        else:
            flattened[name] = entry
    return flattened
