"""Canonical logs whose file was changed by hand or by a fault: one line, or the log."""

from __future__ import annotations

import json
import random
import re
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from residnet.api.data import read_logs
from residnet.core.errors import DataError, ResidnetError
from residnet.core.log import Log
from residnet.io.readers.base import CanonicalConfig
from residnet.quality import inspect_log

STRANGE: list[Any] = [None, 3, -1.5, True, "", "x", [], [1, None], {}, {"a": []}, [[{}]], 1e400]


def places(node: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The paths of all values below a node."""
    inside = node.items() if isinstance(node, dict) else enumerate(node)
    out = []
    for key, value in inside:
        out.append((*path, key))
        if isinstance(value, dict | list):
            out += places(value, (*path, key))
    return out


def written(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    t = 0.1 * np.arange(80)
    channels = {name: np.sin(t + k) for k, name in enumerate(("x", "y", "psi", "u", "v", "r", "n"))}
    finding = {"level": "note", "code": "origin", "text": "somewhere", "figures": {"latitude": 1.0}}
    meta = {"source": "boat.csv", "sha256": "0" * 64, "findings": [finding], "spikes": {"u": 1}}
    Log("boat", t, channels, {}, "zigzag", {"hard:gap": t > 7.0}, meta).save(path)
    table = pq.read_table(path)
    about = json.loads(table.schema.metadata[b"residnet"])
    return about, {name: table.column(name).to_numpy() for name in table.column_names}


@pytest.mark.parametrize("seed", range(3))
def test_a_changed_file_is_a_log_or_one_line(seed: int, tmp_path: Path) -> None:
    draw = random.Random(seed)
    path = tmp_path / "boat.parquet"
    refused: list[str] = []
    for number in range(60):
        about, columns = written(path)
        what = number % 4
        if what < 2:
            *above, key = draw.choice(places(about))
            node = about
            for step in above:
                node = node[step]
            if what:
                del node[key]
            else:
                node[key] = draw.choice(STRANGE)
        else:
            name = draw.choice(list(columns))
            values = columns.pop(name)
            changed = draw.choice(
                [values.astype(str), values.astype(np.int64), np.full(values.shape, np.nan), None]
            )
            columns |= {} if changed is None else {name: changed}
        text = json.dumps(about) if number % 9 else json.dumps(about)[: draw.randrange(200)]
        table = pa.table(columns)
        pq.write_table(table.replace_schema_metadata({"residnet": text}), path)
        try:
            inspect_log(CanonicalConfig().build().read(path), None)
        except ResidnetError as error:
            refused.append(str(error))
    assert 10 < len(refused) < 60
    assert [line for line in refused if "\n" in line or "boat" not in line] == []


@pytest.mark.parametrize("place", ["column", "manoeuvre"])
def test_a_name_that_is_no_utf8_text_is_a_log_or_one_line(place: str, tmp_path: Path) -> None:
    path = tmp_path / "boat.parquet"
    t = 0.1 * np.arange(80)
    channels = {name: np.sin(t) for name in ("x", "y", "psi", "voltage")}
    Log("boat", t, channels, {"voltage": "V"}, "zigzag20").save(path)
    name = {"column": b"voltage", "manoeuvre": b"zigzag20"}[place]
    path.write_bytes(path.read_bytes().replace(name, name[:-2] + b"\xe9\xff"))
    if place == "manoeuvre":
        assert read_logs(path)[0].manoeuvre.startswith("zigzag")
        return
    with pytest.raises(DataError, match=re.escape(f"{path}: the column name 'voltaéÿ'")):
        read_logs(path)
