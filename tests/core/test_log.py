"""The canonical log: what is written comes back bit by bit, and other files are refused by name."""

from __future__ import annotations

from pathlib import Path

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


def test_round_trip(log: Log, tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    log.save(path)
    again = Log.load(path)
    assert (again.name, again.manoeuvre, again.units, again.meta) == (
        log.name,
        log.manoeuvre,
        log.units,
        log.meta,
    )
    assert again.t.tobytes() == log.t.tobytes()
    assert list(again.channels) == list(log.channels)
    for name, values in log.channels.items():
        assert again[name].dtype == np.float64
        assert again[name].tobytes() == values.tobytes()
    assert list(again.masks) == list(log.masks)
    for reason, mask in log.masks.items():
        assert again.masks[reason].dtype == np.bool_
        np.testing.assert_array_equal(again.masks[reason], mask)


def test_round_trip_of_a_bare_log(tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    Log("empty", np.zeros(0), {}).save(path)
    again = Log.load(path)
    assert len(again) == 0
    assert (again.name, again.manoeuvre, again.channels, again.masks, again.meta) == (
        "empty",
        "unknown",
        {},
        {},
        {},
    )


def test_units_are_filled_in(log: Log) -> None:
    assert log.units == {"fuel": "kg", "u": "m/s", "psi": "rad"}
    assert Log("x", np.zeros(1), {"odd": np.zeros(1)}).units == {"odd": "-"}


def test_usable_is_what_no_mask_excludes(log: Log) -> None:
    assert np.flatnonzero(~log.usable).tolist() == [0, 1, 2, 3, 4, 40]
    assert Log("x", np.zeros(3), {}).usable.all()


def test_access(log: Log) -> None:
    np.testing.assert_array_equal(
        log.stack(["psi", "fuel"]), np.column_stack([log["psi"], log["fuel"]])
    )
    assert log.stack([]).shape == (50, 0)
    assert log.replace(name="other").name == "other"
    with pytest.raises(
        UsageError, match=r"log zigzag-20: no channel 'fuels'; did you mean 'fuel'\?$"
    ):
        log["fuels"]


def test_channels_have_the_clocks_length() -> None:
    with pytest.raises(DataError, match="log x: channel u has 2 samples, time has 3"):
        Log("x", np.arange(3.0), {"u": np.zeros(2)})


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"nope\.parquet: no such file$"):
        Log.load(tmp_path / "nope.parquet")


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"t,u\n0,1\n", id="csv"),
        pytest.param(
            b"PAR1" + bytes(40) + b"PAR1",
            id="damaged footer",
        ),
    ],
)
def test_not_parquet(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "log.parquet"
    path.write_bytes(content)
    with pytest.raises(UsageError, match=r"log\.parquet: not a Parquet file") as caught:
        Log.load(path)
    assert "\n" not in str(caught.value)


def test_cut_short(log: Log, tmp_path: Path) -> None:
    path = tmp_path / "log.parquet"
    log.save(path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(UsageError, match="not a Parquet file"):
        Log.load(path)


@pytest.mark.parametrize(
    "metadata", [None, {"other": "{}"}, {"residnet": '{"schema": "residnet.log/0"}'}]
)
def test_foreign_parquet(tmp_path: Path, metadata: dict[str, str] | None) -> None:
    path = tmp_path / "log.parquet"
    pq.write_table(pa.table({"t": [0.0, 1.0]}).replace_schema_metadata(metadata), path)
    with pytest.raises(UsageError, match=f"not a residnet log \\({SCHEMA}\\)"):
        Log.load(path)


def test_a_log_is_shown_in_one_line() -> None:
    log = Log("run 1", 0.1 * np.arange(901), {"u": np.zeros(901), "psi": np.zeros(901)})
    assert repr(log) == "Log('run 1', unknown, 901 samples over 90.0 s: u [m/s], psi [rad])"
    assert "0 samples over 0.0 s" in repr(Log("none", np.zeros(0), {}))


def test_a_log_of_a_model_alone_names_no_vessel(tmp_path: Path) -> None:
    log = Log("flown", np.arange(3.0), {"u": np.zeros(3)}, meta={"vessel": None, "findings": []})
    log.save(tmp_path / "flown.parquet")
    assert Log.load(tmp_path / "flown.parquet").meta["vessel"] is None
