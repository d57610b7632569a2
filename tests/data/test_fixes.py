"""Tables with latitude and longitude: positions in metres, and drafts that take them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pytest
import yaml
from drafted_logs import drafted
from tiny_tasks import boat

from residnet.core.errors import DataError
from residnet.data.readers.tables import CsvConfig
from residnet.data.readers.written import degrees_of
from residnet.tasks import drafting

pytest.importorskip("pyproj")
CHANNELS = {
    "latitude": {"column": "Lat", "unit": "deg"},
    "longitude": {"column": "Lon", "unit": "deg"},
    "psi": {"column": "HDG (deg)", "unit": "deg"},
}


def table(seed: int, seconds: float = 60.0) -> pd.DataFrame:
    """What a plotter records: fixes, speed and course over ground, heading, rate of turn."""
    d = boat(seed, seconds)
    north, east = np.degrees(d.x / 6.371e6), np.degrees(d.y / 6.371e6 / np.cos(np.radians(54.3)))
    return pd.DataFrame(
        {
            "Date/Time": pd.Timestamp("2024-05-03 09:12") + pd.to_timedelta(d.t, unit="s"),
            "Lat": (54.3 + north).round(8),
            "Lon": (10.1 + east).round(8),
            "SOG (kn)": (1.943844 * np.hypot(d.u, d.v)).round(3),
            "HDG (deg)": (np.degrees(d.psi) % 360.0).round(2),
            "ROT (deg/min)": (60.0 * np.degrees(d.r)).round(2),
            "Rudder (deg)": np.degrees(d.delta).round(2),
            "Engine RPM": (60.0 * d.n).round(),
        }
    )


def test_fixes_become_metres_north_and_east_of_the_first(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    made = table(3)
    made.loc[20, ["Lat", "Lon"]] = 0.0
    made.to_csv(file, index=False)
    time = {"column": "Date/Time", "unit": "date"}
    config = CsvConfig.model_validate({"time": time, "channels": CHANNELS})
    log = config.build().read(file)
    assert set(log.channels) == {"x", "y", "psi"}
    truth = boat(3, 60.0)
    assert np.isnan(log["x"][20])
    good = np.isfinite(log["x"])
    # the sphere of the sample and the ellipsoid differ by less than half a per cent
    np.testing.assert_allclose(log["x"][good], truth.x[good], atol=0.005 * np.ptp(truth.x) + 0.01)
    np.testing.assert_allclose(log["y"][good], truth.y[good], atol=0.005 * np.ptp(truth.y) + 0.01)
    assert {finding["code"] for finding in log.meta["findings"]} >= {"origin", "no_fix"}


def test_a_latitude_in_degrees_and_minutes_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    made = table(3)
    made["Lat"] = 5418.123
    made.to_csv(file, index=False)
    config = CsvConfig.model_validate(
        {"time": {"column": "Date/Time", "unit": "date"}, "channels": CHANNELS}
    )
    with pytest.raises(DataError, match="latitude reaches 5418 deg"):
        config.build().read(file)


def test_a_plotters_table_is_drafted_without_a_word(tmp_path: Path) -> None:
    files = [tmp_path / f"trial{k}.csv" for k in range(3)]
    for k, file in enumerate(files):
        table(100 + k).to_csv(file, index=False)
    content = yaml.safe_load(drafting.drafted(files, tmp_path, "boat").text)
    channels = content["data"]["reader"]["channels"]
    assert channels["latitude"] == {"column": "Lat", "unit": "deg"}
    assert channels["longitude"] == {"column": "Lon", "unit": "deg"}
    assert channels["psi"] == {"column": "HDG (deg)", "unit": "deg"}
    assert content["signals"]["inputs"] == ["delta", "n"]


def test_a_first_line_without_end_is_no_header(tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text('"' + "0.5,1.0\n" * 40_000)
    config = CsvConfig.model_validate(
        {"time": {"column": "Date/Time", "unit": "date"}, "channels": CHANNELS}
    )
    with pytest.raises(DataError, match="line 1 is no header"):
        config.build().read(file)


@pytest.mark.parametrize(
    "cell",
    [
        "59°54.321'N", "5954.321,N", "59 54 19.26 N", "59° 54′ 19.26″ n", "N 59° 54.321'",
        "59-54.321N", "59:54:19.26", "59.90535 N", "59°54,321'N", "59deg 54min 19.26sec N",
        "59d54m19.26N", "59°54'19.26''N", "+59 54.321", "59º54.321´N", "59.90535°",
    ],
)  # fmt: skip
def test_ways_to_write_a_latitude(cell: str) -> None:
    form: Literal["number", "ddmm"] = "ddmm" if "5954" in cell else "number"
    np.testing.assert_allclose(degrees_of(pd.Series([cell, None]), "latitude", form)[0], 59.90535)
    if cell.startswith("N") or cell[-1] in "Nn":
        south = cell.replace("N", "S") if "N" in cell else f"{cell[:-1]}s"
        np.testing.assert_allclose(degrees_of(pd.Series([south]), "latitude", form), -59.90535)


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("59°64.321'N", "is no latitude"),
        ("59.5 54 N", "is no latitude"),
        ("N59S", "is no latitude"),
        ("-59N", "is no latitude"),
        ("59E", "no hemisphere of latitude"),
        ("10 30 O", "O is east to some"),
        ("noon", "is no latitude"),
    ],
)
def test_what_is_no_latitude(cell: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        degrees_of(pd.Series(["59N", cell]), "latitude")


def minutes(value: float, side: str) -> str:
    return f"{int(value)}°{value % 1 * 60:.7f}'{side}"


def seconds(value: float, side: str) -> str:
    return f"{int(value)} {int(value % 1 * 60)} {value % 1 * 60 % 1 * 60:.5f} {side}"


def packed(value: float, side: str) -> str:
    return f"{100 * int(value) + value % 1 * 60:.7f},{side}"


@pytest.mark.parametrize("write", [minutes, seconds, packed])
def test_written_positions_are_drafted_and_read(
    write: Callable[[float, str], str], tmp_path: Path
) -> None:
    """South-west of the origin, so that both signs turn."""
    made, file = table(3), tmp_path / "log.csv"
    plain = made.assign(Lat=-made["Lat"], Lon=-made["Lon"])
    plain.to_csv(tmp_path / "plain.csv", index=False)
    written = made.assign(
        Lat=[write(value, "S") for value in made["Lat"]],
        Lon=[write(value, "W") for value in made["Lon"]],
    )
    written.to_csv(file, index=False)
    read = [drafted(path)[0] for path in (file, tmp_path / "plain.csv")]
    for name in ("x", "y"):
        np.testing.assert_allclose(read[0][name], read[1][name], atol=2e-3)


def test_numbers_with_minutes_and_letters_beside_them(tmp_path: Path) -> None:
    made, file = table(3), tmp_path / "log.csv"
    made.to_csv(tmp_path / "plain.csv", index=False)
    numbers = {
        name: [100 * int(value) + value % 1 * 60 for value in made[name]] for name in ("Lat", "Lon")
    }
    made.assign(**numbers, NS="N", EW="E").to_csv(file, index=False)
    log, _, marks = drafted(file)
    for name in ("x", "y"):
        np.testing.assert_allclose(log[name], drafted(tmp_path / "plain.csv")[0][name], atol=2e-3)
    assert any("degrees and minutes in one" in text for _, text in marks.guesses)
