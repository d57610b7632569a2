"""Workbooks with several tests, angles without units, and vessels that dive by heave."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import openpyxl
import pandas as pd
import pytest

import residnet
from residnet.core.errors import ResidnetError
from residnet.core.layout import SIX_DOF_LAYOUT, DegreesOfFreedom
from residnet.core.log import Log
from residnet.io.drafting.vertical import refuse_vertical_y

TRUTH = pd.read_csv(Path(__file__).parents[1] / "corpus" / "truth_1.csv")


def make_test(first: int = 0, n_rows: int = 300) -> pd.DataFrame:
    """Return the table of a test of a model basin."""
    rows = TRUTH.iloc[first : first + n_rows]
    return pd.DataFrame(
        {
            "Time [s]": rows.t - rows.t.iloc[0],
            "X [m]": rows.x,
            "Y [m]": rows.y,
            "Heading [deg]": np.degrees(rows.psi),
            "Rudder [deg]": np.degrees(rows.delta),
            "RPM": rows.n * 60.0,
        }
    )


def refusal_of(folder: Path) -> str:
    """Return the message with which the logs of a folder are refused."""
    with pytest.raises(ResidnetError) as refused:
        residnet.read_logs(folder)
    message = str(refused.value)
    assert "\n" not in message
    assert str(folder / "tests.xlsx") in message
    return message


def test_a_sheet_for_each_test_is_refused_with_code_that_splits_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pd.ExcelWriter(tmp_path / "tests.xlsx") as book:
        pd.DataFrame({"Item": ["Lpp", "B"], "m": [3.2, 0.4]}).to_excel(book, sheet_name="Model")
        make_test().to_excel(book, sheet_name="ZZ 10", index=False, startrow=2)
        make_test(400).to_excel(book, sheet_name="ZZ 20", index=False, startrow=2)
    message = refusal_of(tmp_path)
    assert "sheets ZZ 10, ZZ 20 have the same columns" in message
    monkeypatch.chdir(tmp_path)
    exec("import pandas; " + message[message.index("[sheet.to_csv") :])
    (tmp_path / "tests.xlsx").unlink()
    logs = residnet.read_logs(tmp_path)
    assert [len(log) for log in logs] == [300, 300]


def test_tests_below_each_other_are_refused_with_their_row(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    for first in (0, 400):
        table = make_test(first)
        book.active.append(["Test", f"no. {first}"])
        book.active.append(list(table.columns))
        for row in table.to_numpy().tolist():
            book.active.append(row)
    book.save(tmp_path / "tests.xlsx")
    assert "row 304 has the column names again ('Time [s]'" in refusal_of(tmp_path)


def test_tests_side_by_side_are_refused(tmp_path: Path) -> None:
    book = openpyxl.Workbook()
    table = make_test()
    book.active.append([*table.columns, None, *table.columns])
    for row in table.to_numpy().tolist():
        book.active.append([*row, None, *row])
    book.save(tmp_path / "tests.xlsx")
    assert "has 2 tables side by side, each with 'Time [s]'" in refusal_of(tmp_path)


def make_dive() -> dict[str, np.ndarray]:
    """Return the motion of a vessel that dives by heave, with noise of roll and pitch."""
    noise = np.random.default_rng(0).normal(0.0, 0.005, (2, len(TRUTH)))
    phase = TRUTH.t.to_numpy() * 2.0 * np.pi / 40.0
    motion = {name: TRUTH[name].to_numpy() for name in ("x", "y", "psi", "u", "v", "r")}
    motion |= {"phi": noise[0], "theta": noise[1]}
    return motion | {"z": 5.0 + 2.0 * np.sin(phase), "w": 0.1 * np.pi * np.cos(phase)}


def test_small_tilts_without_unit_have_the_unit_of_the_heading(tmp_path: Path) -> None:
    dive = make_dive()
    angles = {"roll": dive["phi"], "pitch": dive["theta"], "yaw": dive["psi"]}
    table = {"t": TRUTH.t, "north": dive["x"], "east": dive["y"], "rudder": TRUTH.delta}
    table |= {"u": dive["u"], "v": dive["v"], "r": dive["r"]}
    table |= {name: np.degrees(values) for name, values in angles.items()}
    pd.DataFrame(table).to_csv(tmp_path / "dive.csv", index=False)
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    assert np.allclose(log["psi"], dive["psi"], atol=1e-3)
    assert np.allclose(log["phi"], dive["phi"], atol=1e-3)


def test_a_vessel_that_dives_by_heave_has_six_degrees_of_freedom() -> None:
    dive = make_dive()
    assert DegreesOfFreedom.from_channels(dive).velocities == SIX_DOF_LAYOUT.velocities
    sounder = dive | {"w": np.zeros(len(TRUTH))}
    assert not DegreesOfFreedom.from_channels(sounder).is_six_dof


def test_a_track_with_y_up_is_refused_and_a_dive_is_not(tmp_path: Path) -> None:
    angle = np.linspace(0.0, 12.0, 400)
    flat = np.full(400, 0.12)
    half = -0.5 * angle
    table = {"time": angle, "pos_x": np.sin(angle), "pos_y": flat, "pos_z": -np.cos(angle)}
    table |= {"rot_x": 0.0 * half, "rot_y": np.sin(half), "rot_z": 0.0 * half}
    table |= {"rot_w": np.cos(half), "fan": np.sin(0.3 * angle), "rudder": np.cos(0.2 * angle)}
    pd.DataFrame(table).to_csv(tmp_path / "hover.csv", index=False)
    with pytest.raises(ResidnetError, match=r"hover\.csv: column 'pos_y' is almost constant"):
        residnet.read_logs(tmp_path)
    refuse_vertical_y(tmp_path, [*table], [table | {"pos_x": angle}], {"x": "pos_x", "y": "pos_y"})
