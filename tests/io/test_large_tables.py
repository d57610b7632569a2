"""Tables that are read piece by piece: the same log as in one piece."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from residnet.core.config import validate_config
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.readers import ReaderConfig, table_lines, text_tables
from residnet.io.readers.base import LogReader


def reader(kind: str = "csv") -> LogReader:
    channels = {"psi": {"column": "h", "unit": "deg"}, "u": {"column": "u", "unit": "kn"}}
    return validate_config(
        {"kind": kind, "time": {"column": "t"}, "channels": channels}, ReaderConfig, "test"
    ).build()


def in_pieces(path: Path, monkeypatch: pytest.MonkeyPatch, *, rows: int) -> Log:
    monkeypatch.setattr(text_tables, "_CHUNK_ROWS", rows)
    monkeypatch.setattr(table_lines, "_BLOCK_BYTES", 10 * rows)
    return reader().read(path)


def assert_equal(a: Log, b: Log) -> None:
    np.testing.assert_array_equal(a.t, b.t)
    for name in a.channels:
        np.testing.assert_allclose(a[name], b[name], rtol=0, atol=1e-12)
    assert a.meta["rows_dropped"] == b.meta["rows_dropped"]


def test_pieces_give_the_log_of_the_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    t = 0.1 * np.arange(1000)
    frame = pd.DataFrame({"t": t, "h": np.remainder(37.0 * t + 350.0, 360.0), "u": np.sin(t)})
    # no measurement at both ends, a hole in the heading, a blank row
    frame.loc[:149, ["h", "u"]] = np.nan
    frame.loc[900:, ["h", "u"]] = np.nan
    frame.loc[300:319, "h"] = np.nan
    frame.loc[500] = np.nan
    path = tmp_path / "a.csv"
    frame.to_csv(path, index=False)
    frame.to_parquet(path.with_suffix(".parquet"))
    whole = reader().read(path)
    assert_equal(reader("parquet").read(path.with_suffix(".parquet")), whole)
    assert len(whole) == 749
    assert float(np.nanmax(np.abs(np.diff(whole["psi"])))) < 0.2
    for rows in (7, 100, 999):
        assert_equal(in_pieces(path, monkeypatch, rows=rows), whole)


def test_faults_are_named_by_their_line_in_any_piece(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lines = [f"{0.1 * i:.1f},1,2" for i in range(100)]
    for line, text, words in [
        (57, "5.5,x,2", "line 59, column 'h': 'x'"),
        (57, "1.0,1,2", "backwards from line 58"),
        (57, "5.7,1,2,4", "line 59 has"),
    ]:
        path = tmp_path / "a.csv"
        path.write_text("t,h,u\n" + "\n".join([*lines[:line], text, *lines[line + 1 :]]) + "\n")
        with pytest.raises(DataError, match=words):
            in_pieces(path, monkeypatch, rows=10)
