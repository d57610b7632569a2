"""Tables written as JSON lines: an object a line, as loggers of programs write them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from residnet.core.errors import DataError, UsageError
from residnet.core.names import nearest, shown
from residnet.data.readers.encoding import as_utf8

if TYPE_CHECKING:
    import pandas as pd

_PIECE = 20_000
_LONGEST = 16
"""Most entries of a list that become columns."""


def read_json_lines(path: Path, columns: Sequence[str]) -> Iterator[tuple[pd.DataFrame, float]]:
    """Yield the wanted columns of a file of JSON lines piece by piece, with the share read.

    A column is a key; keys of objects within are joined by dots, entries of lists are counted from
    zero in brackets, as in `pose.q[0]`. An object without a key has an empty cell there; lists of
    more than 16 entries are passed over.

    Raises:
        UsageError: where no object has one of the columns.
        DataError: where a line is no JSON object.
    """
    import pandas as pd

    lost = dict.fromkeys(columns)
    known: dict[str, None] = {}
    for rows, share, cut in _pieces(path):
        for row in rows:
            known |= dict.fromkeys(row)
        lost = {name: None for name in lost if name not in known}
        table = pd.DataFrame(
            {i: [row.get(name) for row in rows] for i, name in enumerate(columns)}
        ).infer_objects()
        table.columns = pd.Index(list(columns))
        if cut:
            table.attrs["cut"] = True
        yield table, share
    for name in lost:
        raise UsageError(f"{path}: no key '{name}'{nearest(name, list(known))}")


def json_table(path: Path, rows: int) -> pd.DataFrame:
    """Return the first rows of a file of JSON lines, a column for each key.

    Raises:
        DataError: where it is empty, or a line is no JSON object.
    """
    import pandas as pd

    found: list[Mapping[str, Any]] = []
    for piece, _, _ in _pieces(path):
        found += piece
        if len(found) >= rows:
            break
    if not found:
        raise DataError(f"{path}: the file is empty; an object a line was expected")
    return pd.DataFrame(found[:rows]).infer_objects()


def _pieces(path: Path) -> Iterator[tuple[list[dict[str, Any]], float, bool]]:
    """Yield flat objects, the share of the file read, and whether it ends within a line.

    Raises:
        DataError: where a line is no JSON object.
    """
    rows: list[dict[str, Any]] = []
    size, passed, some = max(1, path.stat().st_size), 0, False
    with as_utf8(path) as file, file.open("rb") as stream:
        for number, line in enumerate(stream, start=1):
            passed += len(line)
            text = line.decode("utf-8-sig", errors="replace").strip()
            if not text:
                continue
            try:
                rows.append(_object(text))
            except (ValueError, RecursionError) as error:
                # a recorder that was switched off ends within a line
                if some and not line.endswith(b"\n"):
                    yield rows, 1.0, True
                    return
                raise DataError(
                    f"{path}: line {number}, '{shown(text, 60)}', is no JSON object; give files"
                    " with one object a line"
                ) from error
            some = True
            if len(rows) == _PIECE:
                yield rows, min(1.0, passed / size), False
                rows = []
        if rows:
            yield rows, 1.0, False


def _object(text: str) -> dict[str, Any]:
    """Return one object without objects and lists within.

    Raises:
        ValueError: where the text is none.
    """
    value = json.loads(text)
    if not isinstance(value, dict):
        raise ValueError("no object")
    return _flat(value)


def _flat(value: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Return the numbers and texts of an object by their paths."""
    out: dict[str, Any] = {}
    for key, entry in value.items():
        name = f"{before}{key}"
        if isinstance(entry, dict):
            out |= _flat(entry, f"{name}.")
        elif isinstance(entry, list):
            # scans and pictures are no channels
            entry = entry if len(entry) <= _LONGEST else []
            out |= _flat({f"{name}[{i}]": part for i, part in enumerate(entry)})
        else:
            out[name] = entry
    return out
