"""The canonical log: what is written comes back bit by bit, and other files are refused by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from residnet.core.errors import DataError, UsageError
from residnet.core.log import SCHEMA, Log


@pytest.fixture
def log() -> Log:
    t = np.cumsum(np.random.default_rng(0).uniform(0.09, 0.11, 50))
    u = np.sin(t)
    u[3] = np.nan
    return Log(
        name="zigzag-20",
        t=t,
        channels={"u": u, "psi": 7.0 * t, "fuel": t**2},
        units={"fuel": "kg"},
        manoeuvre="zigzag",
        masks={"gap": t < t[5], "spike": np.arange(50) == 40},
        meta={"source": "trials/ä.csv", "sha256": "00", "set": [1, {"deep": None}]},
    )


def test_log_is_a_mapping_of_channels(log: Log) -> None:
    assert list(log) == list(log.keys()) == ["u", "psi", "fuel"]
    assert "u" in log
    assert "t" not in log
    assert dict(log)["psi"] is log["psi"]
    assert len(log) == 50


def test_log_save_and_load_are_lossless(log: Log, tmp_path: Path) -> None:
    for one in (log, Log("empty", np.zeros(0), {}, meta={"vessel": None})):
        one.save(tmp_path / "log.parquet")
        again = Log.load(tmp_path / "log.parquet")
        for part in ("name", "manoeuvre", "units", "meta"):
            assert getattr(again, part) == getattr(one, part)
        assert again.t.tobytes() == one.t.tobytes()
        assert list(again.channels) == list(one.channels)
        for name, values in one.channels.items():
            assert again[name].dtype == np.float64
            assert again[name].tobytes() == values.tobytes()
        assert list(again.masks) == list(one.masks)
        for reason, mask in one.masks.items():
            assert again.masks[reason].dtype == np.bool_
            np.testing.assert_array_equal(again.masks[reason], mask)


def test_log_usable_excludes_all_masks(log: Log) -> None:
    assert np.flatnonzero(~log.usable).tolist() == [0, 1, 2, 3, 4, 40]
    assert Log("x", np.zeros(3), {}).usable.all()
    assert log.units == {"fuel": "kg", "u": "m/s", "psi": "rad"}
    assert Log("x", np.zeros(1), {"odd": np.zeros(1)}).units == {"odd": "-"}


def test_log_access(log: Log) -> None:
    np.testing.assert_array_equal(
        log.stack(["psi", "fuel"]), np.column_stack([log["psi"], log["fuel"]])
    )
    assert log.stack([]).shape == (50, 0)
    assert log.replace(name="other").name == "other"
    with pytest.raises(UsageError, match=r"log zigzag-20: no channel 'fuels'; did you mean 'fuel'"):
        log["fuels"]
    with pytest.raises(DataError, match="log x: channel u has 2 samples, time has 3"):
        Log("x", np.arange(3.0), {"u": np.zeros(2)})


@pytest.mark.parametrize(
    ("content", "told"),
    [
        (None, "no such file$"),
        (b"", "not a Parquet file"),
        (b"t,u\n0,1\n", "not a Parquet file"),
        (b"PAR1" + bytes(40) + b"PAR1", "not a Parquet file"),
        ("cut short", "not a Parquet file"),
        ({}, f"not a residnet log \\({SCHEMA}\\)"),
        ({"other": "{}"}, "not a residnet log"),
        ({"residnet": '{"schema": "residnet.log/0"}'}, "not a residnet log"),
    ],
    ids=str,
)
def test_log_load_refuses_other_files(log: Log, tmp_path: Path, content: Any, told: str) -> None:
    path = tmp_path / "log.parquet"
    if isinstance(content, dict):
        pq.write_table(pa.table({"t": [0.0, 1.0]}).replace_schema_metadata(content), path)
    elif content == "cut short":
        log.save(path)
        path.write_bytes(path.read_bytes()[:-20])
    elif content is not None:
        path.write_bytes(content)
    with pytest.raises(UsageError, match=rf"log\.parquet: {told}") as caught:
        Log.load(path)
    assert "\n" not in str(caught.value)


def test_log_repr_is_one_line() -> None:
    log = Log("run 1", 0.1 * np.arange(901), {"u": np.zeros(901), "psi": np.zeros(901)})
    assert repr(log) == "Log('run 1', unknown, 901 samples over 90.0 s: u [m/s], psi [rad])"
    assert "0 samples over 0.0 s" in repr(Log("none", np.zeros(0), {}))
