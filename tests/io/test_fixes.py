"""Latitudes and longitudes: ways to write them, and positions in metres."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pytest

from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.readers.angles import parse_degrees
from residnet.io.readers.tables import CsvConfig

pytest.importorskip("pyproj")
T = np.arange(0.0, 60.0, 0.2)
NORTH = 30.0 * np.sin(0.05 * T)
EAST = 2.0 * T
# radii of curvature of WGS 84 at 54.3 deg north, in m per degree
FIXES = pd.DataFrame({"t": T, "lat": 54.3 + NORTH / 111_302.6, "lon": 10.1 + EAST / 65_100.6})


def read(file: Path) -> Log:
    channels = {name: {"column": name[:3], "unit": "deg"} for name in ("latitude", "longitude")}
    return (
        CsvConfig.model_validate({"time": {"column": "t"}, "channels": channels}).build().read(file)
    )


def test_fixes_become_metres_north_and_east_of_the_first(tmp_path: Path) -> None:
    made = FIXES.copy()
    file = tmp_path / "log.csv"
    made.loc[20, ["lat", "lon"]] = 0.0
    made.to_csv(file, index=False)
    log = read(file)
    assert set(log.channels) == {"x", "y"}
    good = np.arange(T.size) != 20
    np.testing.assert_array_equal(np.isfinite(log["x"]), good)
    np.testing.assert_allclose(log["x"][good], NORTH[good], atol=0.01)
    np.testing.assert_allclose(log["y"][good], EAST[good], atol=0.01)
    assert {finding["code"] for finding in log.meta["findings"]} >= {"origin", "no_fix"}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FIXES.assign(lat=5418.123).to_csv(index=False), "latitude reaches 5418 deg"),
        ('"' + "0.5,1.0\n" * 40_000, "line 1 is no header"),
    ],
)
def test_what_holds_no_fixes(text: str, said: str, tmp_path: Path) -> None:
    file = tmp_path / "log.csv"
    file.write_text(text)
    with pytest.raises(DataError, match=said):
        read(file)


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
    np.testing.assert_allclose(
        parse_degrees(pd.Series([cell, None]), "latitude", form)[0], 59.90535
    )
    if cell.startswith("N") or cell[-1] in "Nn":
        south = cell.replace("N", "S") if "N" in cell else f"{cell[:-1]}s"
        np.testing.assert_allclose(parse_degrees(pd.Series([south]), "latitude", form), -59.90535)


@pytest.mark.parametrize(
    ("cell", "said"),
    [
        ("59°64.321'N", "is no latitude"),
        ("59.5 54 N", "is no latitude"),
        ("N59S", "is no latitude"),
        ("-59N", "is no latitude"),
        ("59E", "no hemisphere of latitude"),
        ("10 30 O", "set letter_o"),
        ("noon", "is no latitude"),
    ],
)
def test_what_is_no_latitude(cell: str, said: str) -> None:
    with pytest.raises(DataError, match=said):
        parse_degrees(pd.Series(["59N", cell]), "latitude")
