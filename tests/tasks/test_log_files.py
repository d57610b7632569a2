"""Logs by the files and folders that a command names."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import written_logs

from residnet.core.errors import UsageError
from residnet.data.drafting.reading import log_files


def test_folders_hold_tables_recordings_or_other_logs(tmp_path: Path) -> None:
    pytest.importorskip("rosbags")
    log = written_logs.trial(3.0)
    tables, bags, boxes = tmp_path / "tables", tmp_path / "bags", tmp_path / "boxes"
    for folder in (tables, bags / "one", bags / "two", boxes):
        folder.mkdir(parents=True)
    table = written_logs.csv(log, tables)
    # what lies beside tables is no log
    (tables / "README.txt").write_text("Trials of a boat.\n")
    assert log_files([tables], folders=True) == log_files([tables]) == [table]
    # a file that is named twice is one log
    assert log_files([table, tables, tables / ".." / "tables" / table.name]) == [table]
    bag_files = [written_logs.bag2(log, bags / name) for name in ("one", "two")]
    assert log_files([bags], folders=True) == bag_files
    assert log_files([bag_files[0]], folders=True) == bag_files[:1]
    box = written_logs.mcap(log, boxes)
    shutil.rmtree(boxes / "whole")
    assert log_files([boxes], folders=True) == [box]
    with pytest.raises(UsageError, match=r"holds no csv or Parquet file$"):
        log_files([boxes])
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="holds no log of a format"):
        log_files([tmp_path / "empty"], folders=True)
