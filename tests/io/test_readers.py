"""Readers: units, signs and frames by hand, and every error with its place."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.core.log import Log
from residnet.io.readers import ReaderConfig
from residnet.io.readers.base import LogReader
from residnet.io.readers.text_tables import coerce_numeric


def build(
    channels: dict[str, Any], kind: str = "csv", time: dict[str, str] | None = None, **options: Any
) -> LogReader:
    config = {"kind": kind, "time": time or {"column": "t"}, "channels": channels, **options}
    return validate_config(config, ReaderConfig, "test").build()


SIMPLE = {"u": {"column": "u", "unit": "m/s"}, "v": {"column": "v", "unit": "m/s"}}


def read(tmp_path: Path, text: str, channels: dict[str, Any] = SIMPLE, **options: Any) -> Log:
    path = tmp_path / "zigzag" / "run_7.csv"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return build(channels, **options).read(path)


def test_units_signs_and_identity(tmp_path: Path) -> None:
    channels = {
        "u": {"column": "speed", "unit": "kn"},
        "delta": {"column": "rudder", "unit": "deg", "sign": -1},
        "n": {"column": "shaft", "unit": "rpm"},
        "fuel": {"column": "fuel", "unit": "kN"},
    }
    text = "ms,speed,rudder,shaft,fuel,unused\n1000,1,10,60,2,a\n1500,2,-20,120,3,b\n"
    log = read(tmp_path, text, channels, time={"column": "ms", "unit": "ms"}, manoeuvre="folder")
    assert log.name == "run_7"
    assert log.manoeuvre == "zigzag"
    np.testing.assert_allclose(log.t, [1.0, 1.5])
    np.testing.assert_allclose(log["u"], np.array([1.0, 2.0]) * 1852.0 / 3600.0)
    np.testing.assert_allclose(log["delta"], np.radians([-10.0, 20.0]))
    np.testing.assert_allclose(log["n"], [1.0, 2.0])
    np.testing.assert_allclose(log["fuel"], [2000.0, 3000.0])
    assert log.units == {"u": "m/s", "delta": "rad", "n": "1/s", "fuel": "N"}
    assert log.meta["sha256"] == hashlib.sha256(text.encode()).hexdigest()
    assert (log.meta["rows_read"], log.meta["rows_dropped"]) == (2, 0)
    assert log.meta["source"].endswith("run_7.csv")


def test_east_north_up_heading_and_forward_port_up_axes(tmp_path: Path) -> None:
    # a vessel that heads 30 deg north of east and turns to port has a compass heading of 60 deg
    # that falls
    channels = {
        name: {"column": name, "unit": unit, "frame": "body_fpu"}
        for name, unit in [("u", "m/s"), ("v", "m/s"), ("r", "rad/s")]
    }
    channels["psi"] = {"column": "yaw", "unit": "deg", "frame": "enu"}
    log = read(tmp_path, "t,u,v,r,yaw\n0,1,0.2,0.1,30\n1,1,0.2,0.1,36\n", channels)
    np.testing.assert_allclose(np.degrees(log["psi"]), [60.0, 54.0])
    np.testing.assert_allclose(log["u"], 1.0)
    np.testing.assert_allclose(log["v"], -0.2)
    np.testing.assert_allclose(log["r"], -0.1)


def test_heading_is_unwrapped_across_missing_cells_and_wind_is_not(tmp_path: Path) -> None:
    channels = {"psi": {"column": "h", "unit": "deg"}, "wind_dir": {"column": "w", "unit": "deg"}}
    log = read(tmp_path, "t,h,w\n0,350,350\n1,,350\n2,10,10\n3,30,10\n", channels)
    np.testing.assert_allclose(np.degrees(log["psi"]), [350.0, np.nan, 370.0, 390.0])
    np.testing.assert_allclose(np.degrees(log["wind_dir"]), [350.0, 350.0, 10.0, 10.0])


def test_rows_without_measurements_go_at_the_ends_only(tmp_path: Path) -> None:
    log = read(tmp_path, "t,u,v\n0,,\n\n1,1,2\n2,,\n3,1,\n4,2,3\n5,,\n")
    np.testing.assert_array_equal(log.t, [1.0, 2.0, 3.0, 4.0])
    np.testing.assert_array_equal(log["v"], [2.0, np.nan, np.nan, 3.0])
    assert (log.meta["rows_read"], log.meta["rows_dropped"]) == (7, 3)


def test_rows_written_twice_are_read_once(tmp_path: Path) -> None:
    log = read(tmp_path, "t,u,v\n0,1,2\n1,1,2\n1,1,2\n1,1,2\n2,1,\n2,1,\n")
    np.testing.assert_array_equal(log.t, [0.0, 1.0, 2.0])
    assert [one["code"] for one in log.meta["findings"]] == ["copied_rows"]


def test_delimiter_decimal_comma_byte_order_mark_and_spaces(tmp_path: Path) -> None:
    log = read(tmp_path, "\ufefft; u ;v\n0,5; 1,25;2\n1,0;1,5;3\n", delimiter=";", decimal=",")
    np.testing.assert_array_equal(log.t, [0.5, 1.0])
    np.testing.assert_array_equal(log["u"], [1.25, 1.5])


@pytest.mark.parametrize(
    ("cells", "angles"),
    [
        (["P12.3", "S05.0", "", "S00.0"], [-12.3, 5.0, np.nan, 0.0]),
        (["0", "PORT 3", "STBD 4", "p1,5"], [0.0, -3.0, 4.0, -1.5]),
    ],
)
def test_sides_of_rudder_angles_are_signs(cells: list[str], angles: list[float]) -> None:
    table = coerce_numeric(pd.DataFrame({"rudder": cells}), "," if "p1,5" in cells else ".")
    np.testing.assert_array_equal(table["rudder"], angles)
    names = pd.DataFrame({"name": ["P12", "POLAR 5", "S1A"]})
    assert coerce_numeric(names)["name"].tolist() == ["P12", "POLAR 5", "S1A"]


def test_numbers_are_read_to_the_last_bit(tmp_path: Path) -> None:
    values = np.random.default_rng(0).normal(size=200) * 50
    text = "t,u,v\n" + "".join(f"{i},{value!r},0\n" for i, value in enumerate(values.tolist()))
    np.testing.assert_array_max_ulp(read(tmp_path, text)["u"], values, maxulp=1)


ROWS = "t,u,v\n0,1,2\n1,1,2\n"


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        ("", DataError, ["empty"]),
        ("t,u,v\n", DataError, ["0 usable rows", "at least 2"]),
        ("t,u,v\n0,1,2\n", DataError, ["1 usable rows"]),
        ("t,u,w\n0,1,2\n1,1,2\n", UsageError, ["no column 'v'"]),
        ("t,u,v2\n0,1,2\n1,1,2\n", UsageError, ["no column 'v'", "did you mean 'v2'?"]),
        ("t;u;v\n0;1;2\n", UsageError, ["no column 't'", "delimiter"]),
        ("t,u,u,v\n0,1,1,2\n1,1,1,2\n", DataError, ["column 'u' 2 times"]),
        ("t,u,v\n0,1,2\n1,1.2x,2\n", DataError, ["line 3, column 'u'", "'1.2x'"]),
        ("t,u,v\n0,1,2\n1,inf,2\n", DataError, ["line 3, column 'u'", "finite"]),
        ("t,u,v\n0,,2\n1,,2\n", DataError, ["column 'u' (channel u) holds no number"]),
        (
            "t,u,v\n0,1,2\n\n1,1,2\n1,1,2\n1,1,3\n",
            DataError,
            ["repeats from line 4 (1 s) to line 5", "2 such steps"],
        ),
        (
            "t,u,v\n0,1,2\n2,1,2\n1,1,2\n",
            DataError,
            ["runs backwards from line 3 (2 s) to line 4 (1 s)"],
        ),
        ("t,u,v\n0,1,2\n,1,2\n2,1,2\n", DataError, ["line 3 has measurements but no time"]),
        ("t,u,v\n0,1,5,2\n1,1,2\n", DataError, ["line 2 has 4 cells, the header 3", "decimal"]),
        ("t,u,v\n0,1,2\n1,1,2,3,4\n", DataError, ["line 3 has 5 cells, the header 3"]),
        (
            f't,u,v\n0,1,2\n1,1,"{"2" * 200_000}',
            DataError,
            ["not a regular table, its header has 3"],
        ),
    ],
)
def test_faulty_tables(tmp_path: Path, text: str, error: type[Exception], words: list[str]) -> None:
    with pytest.raises(error) as caught:
        read(tmp_path, text)
    message = str(caught.value)
    assert "run_7.csv" in message
    assert "\n" not in message
    for word in words:
        assert word in message


def test_missing_file_names_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "turn_1.csv").write_text(ROWS)
    with pytest.raises(UsageError, match=r"turn_2.csv: no such file; did you mean 'turn_1.csv'"):
        build(SIMPLE).read(tmp_path / "turn_2.csv")
    with pytest.raises(UsageError, match="is a folder"):
        build(SIMPLE).read(tmp_path)


@pytest.mark.parametrize(
    ("channels", "words"),
    [
        ({"psi": {"column": "a", "unit": "deg/s"}}, "unit 'deg/s' does not measure [rad]"),
        ({"u": {"column": "a", "unit": "fathom"}}, "unknown unit 'fathom'"),
        (
            {"x": {"column": "a", "unit": "m", "frame": "enu"}},
            "frame 'enu' does not define it (frames that do: ned)",
        ),
        ({"delta": {"column": "a", "unit": "rad", "frame": "body_fpu"}}, "frames that do: none"),
        ({"t": {"column": "a", "unit": "s"}}, "'t' is no name of a channel"),
        ({"u": {"column": "a", "unit": "m/s", "sign": 0}}, "sign"),
        ({key: {"column": "a", "unit": "-"} for key in ("qx", "qw")}, "add qy, qz"),
        ({}, "channels"),
    ],
)
def test_faulty_channel_maps_stop_as_config_errors(channels: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError) as caught:
        build(channels)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_foreign_parquet_equals_csv(tmp_path: Path) -> None:
    table = pd.DataFrame(
        {"t": [0, 1, 2], "u": [1.5, None, 2.5], "v": ["1", "2", "3"], "text": list("abc")}
    )
    table.to_parquet(tmp_path / "run.parquet")
    table.to_csv(tmp_path / "run.csv", index=False)
    a, b = (
        build(SIMPLE, "parquet").read(tmp_path / "run.parquet"),
        build(SIMPLE).read(tmp_path / "run.csv"),
    )
    for name in ("u", "v"):
        np.testing.assert_array_equal(a[name], b[name])
    with pytest.raises(DataError, match="row 1, column 'text': 'a' is not a finite number"):
        build({"u": {"column": "text", "unit": "m/s"}}, "parquet").read(tmp_path / "run.parquet")
    with pytest.raises(UsageError, match="no column 'tex'; did you mean 'text'"):
        build({"u": {"column": "tex", "unit": "m/s"}}, "parquet").read(tmp_path / "run.parquet")
    with pytest.raises(DataError, match="damaged or not a Parquet file"):
        build(SIMPLE, "parquet").read(tmp_path / "run.csv")


def test_canonical_round_trip_keeps_masks_and_origin(tmp_path: Path) -> None:
    log = read(tmp_path, ROWS).replace(masks={"hard:gap": np.array([False, True])})
    log.save(tmp_path / "other.parquet")
    again = (
        validate_config({"kind": "canonical"}, ReaderConfig, "test")
        .build()
        .read(tmp_path / "other.parquet")
    )
    np.testing.assert_array_equal(again["v"], log["v"])
    np.testing.assert_array_equal(again.masks["hard:gap"], [False, True])
    assert again.name == "other"
    assert again.meta["origin"]["sha256"] == log.meta["sha256"]
    assert (
        again.meta["sha256"]
        == hashlib.sha256((tmp_path / "other.parquet").read_bytes()).hexdigest()
    )


@pytest.mark.parametrize(
    ("log", "error", "words"),
    [
        (
            Log("a", np.array([0.0, 1.0, 1.0]), {"u": np.ones(3)}),
            DataError,
            r"repeats from row 2 \(1 s\) to row 3",
        ),
        (Log("a", np.array([0.0]), {"u": np.ones(1)}), DataError, "1 usable rows"),
        (Log("a", np.array([0.0, 1.0]), {"u": np.full(2, np.nan)}), DataError, "holds no number"),
        (
            Log("a", np.array([0.0, 1.0]), {"u": np.ones(2)}, {"u": "kn"}),
            UsageError,
            r"channel u is in \[kn\]",
        ),
    ],
)
def test_faulty_canonical_logs(
    tmp_path: Path, log: Log, error: type[Exception], words: str
) -> None:
    log.save(tmp_path / "a.parquet")
    with pytest.raises(error, match=words):
        validate_config({"kind": "canonical"}, ReaderConfig, "test").build().read(
            tmp_path / "a.parquet"
        )
