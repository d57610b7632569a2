"""Tables as people write them: local dates, decimal commas, encodings, servos, Excel, any case."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError, UsageError
from residnet.core.log import Log
from residnet.core.units import canonical_unit, to_si
from residnet.io.readers import ReaderConfig
from residnet.io.readers.text_tables import read_table_head
from residnet.io.readers.timestamps import detect_date_order, is_date_column, parse_texts

SPELT = {
    "deg/min": "deg/min|° / MIN|度/分",
    "deg/s": "Degrees per second",
    "kn": "KT|Knots",
    "rpm": "RPM",
    "1/min": "U/min|rev/min|min-1",
    "m/s": "m s-1",
    "rad/s": "rad s^-1",
    "m/s^2": "m/s²",
    "%": "%",
    "us": "µs|US",
    "N m": "Nm",
    "kN": "kN",
}


@pytest.mark.parametrize("unit", SPELT)
def test_spelling_of_a_unit(unit: str) -> None:
    written = SPELT[unit].split("|")
    assert [canonical_unit(one) for one in written] == [unit] * len(written)


def test_case_alone_is_settled_by_the_dimension() -> None:
    assert to_si("KN", "m/s") == pytest.approx(1852 / 3600)
    assert to_si("KN", "N") == 1000.0
    with pytest.raises(UsageError, match="may be kn or kN"):
        canonical_unit("KN")


@pytest.mark.parametrize("written", ["deg/m", "deg/h", "kn/s", "mrad", "rad/mm", "deg/ms"])
def test_no_suggestion_differs_by_a_factor(written: str) -> None:
    with pytest.raises(UsageError) as caught:
        canonical_unit(written)
    assert "did you mean" not in str(caught.value)


@pytest.mark.parametrize(
    ("cells", "order", "seconds"),
    [
        (["03.05.2024 23:59:59,5", "04.05.2024 00:00:01"], "dmy", 1.5),
        (["03/05/2024 11:59:59 PM", "03/06/2024 12:00:01 AM"], "mdy", 2.0),
        (["31/05/2024 10:00", "31/05/2024 10:01"], "dmy", 60.0),
        (["12-Nov-2020 11:14:47", "12-Nov-2020 11:14:48"], "dmy", 1.0),
        (["7. Mär. 2024 11:14:47", "7. Mär. 2024 11:14:48"], "dmy", 1.0),
        (["2024年5月3日 12時00分01秒", "2024年5月3日 12時00分02秒"], "ymd", 1.0),
        (["2024-05-03T12:00:00.5+02:00", "2024-05-03T10:00:01Z"], "ymd", 0.5),
        (["23:59:59.9", "00:00:00.1"], None, 0.2),
    ],
)
def test_forms_of_dates(cells: list[str], order: str | None, seconds: float) -> None:
    column = pd.Series(cells)
    assert is_date_column(column)
    assert detect_date_order(column) == order
    ns = parse_texts(column, has_only_dates=True).ns
    assert ns[-1] - ns[0] == round(1e9 * seconds)


def test_the_hour_that_comes_twice() -> None:
    local = ["27.10.2024 02:59:59", "27.10.2024 02:00:01", "27.10.2024 02:00:02"]
    ns = parse_texts(pd.Series(local), zone="Europe/Berlin", has_only_dates=True).ns
    assert (ns - pd.Timestamp("2024-10-27 00:59:59").value).tolist() == [0, 2 * 10**9, 3 * 10**9]


def test_cells_that_are_no_dates() -> None:
    assert not is_date_column(pd.Series(["1.5", "2.5"]))
    with pytest.raises(DataError, match="'soon' in row 2 is no date"):
        parse_texts(pd.Series(["03.05.2024 10:00:00", "soon"]), has_only_dates=True)
    with pytest.raises(DataError, match=r"'31\.31\.2024 10:00' in row 1 is no date with dmy"):
        parse_texts(pd.Series(["31.31.2024 10:00"]), has_only_dates=True)


def _read(path: Path, settings: dict[str, Any]) -> Log:
    return validate_config(settings, ReaderConfig, "here").build().read(path)


CHANNELS = {
    "u": {"column": "Fahrt [kn]", "unit": "KN"},
    "delta": {"column": "Servo [µs]", "unit": "deg", "offset": 1500, "scale": 0.07},
}


def test_a_german_table(tmp_path: Path) -> None:
    path = tmp_path / "fahrt.csv"
    lines = ["Datum;Uhrzeit;Fahrt [kn];Servo [µs]"]
    lines += [f"03.05.2024;12:00:0{i},5;{i},25;{1400 + 100 * i}" for i in range(4)]
    path.write_bytes("\r\n".join([*lines, ""]).encode("cp1252"))
    time = {"column": "Uhrzeit", "date": "Datum", "unit": "date", "zone": "Europe/Berlin"}
    table = {"kind": "csv", "delimiter": ";", "decimal": ",", "encoding": "cp1252"}
    log = _read(path, {**table, "time": time, "channels": CHANNELS})
    np.testing.assert_allclose(log.t, [0.0, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(log["u"], (np.arange(4) + 0.25) * 1852 / 3600)
    np.testing.assert_allclose(log["delta"], np.radians([-7.0, 0.0, 7.0, 14.0]), atol=1e-12)
    assert log.meta["epoch_ns"] == pd.Timestamp("2024-05-03 10:00:00.5").value


def test_an_excel_sheet(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    path = tmp_path / "fahrt.xlsx"
    moments = pd.date_range("2024-05-03 12:00:00", periods=4, freq="500ms")
    table = pd.DataFrame({"Zeit": moments, "Fahrt [kn]": [1.0, 2, 3, 4], "Servo [µs]": 1500})
    with pd.ExcelWriter(path) as writer:
        pd.DataFrame({"note": ["x"]}).to_excel(writer, sheet_name="about", index=False)
        table.to_excel(writer, sheet_name="run", index=False)
    settings = {"kind": "excel", "sheet": "run", "time": {"column": "Zeit", "unit": "date"}}
    log = _read(path, {**settings, "channels": CHANNELS})
    np.testing.assert_allclose(log.t, [0.0, 0.5, 1.0, 1.5])
    np.testing.assert_allclose(log["u"], np.arange(1, 5) * 1852 / 3600)
    with pytest.raises(UsageError, match="no sheet 'runs'; did you mean 'run'"):
        _read(path, {**settings, "sheet": "runs", "channels": CHANNELS})
    path.write_bytes(b"PK nothing")
    with pytest.raises(DataError, match="damaged or not an Excel file"):
        _read(path, {**settings, "channels": CHANNELS})


NUMBERS = "0.0,1.0,2.0,10\n0.1,1.1,2.1,10\n0.2,1.2,2.2,10\n0.3,1.3,2.3,10\n"


def test_names_in_two_rows_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(f"Time,Position,Position,Rudder\ns,X,Y,deg\n{NUMBERS}")
    with pytest.raises(DataError, match=r"run\.csv.*'Position' above X, Y.*'Position X'.*--names"):
        read_table_head(path, 4)


def test_a_row_that_groups_names_is_skipped(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(f"Time,Position,Position,Rudder\nt,X,Y,delta\n{NUMBERS}")
    table, _ = read_table_head(path, 4)
    assert list(table.columns) == ["t", "X", "Y", "delta"]


def test_units_below_repeated_names_are_no_names(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    path.write_text(f"Time,Speed,Speed,Rudder\ns,m/s,kn,deg\n{NUMBERS}")
    table, _ = read_table_head(path, 4)
    assert list(table.columns) == ["Time", "Speed.0", "Speed.1", "Rudder"]


@pytest.mark.parametrize(
    ("time", "message"),
    [
        ({"column": "t", "unit": "date", "zone": "Europe/Berlim"}, "no time zone is called"),
        ({"column": "t", "zone": "UTC"}, "zone applies to dates only; set unit: date"),
        ({"column": "t", "unit": "m"}, r"time.unit: unit 'm' does not measure \[s\]"),
    ],
)
def test_times_that_cannot_be(time: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        validate_config({"kind": "csv", "time": time, "channels": CHANNELS}, ReaderConfig, "here")
