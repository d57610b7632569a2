"""Excel files of model tests in layouts of several basins; the motion is known."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl
import pandas as pd
import pytest
import yaml

import residnet
from residnet.core.log import Log
from residnet.io.readers.excel_tables import read_excel_sheet
from residnet.physics.actuators.steering_gear import simulate_gear

pytestmark = pytest.mark.usefixtures("omit_currents")

DEGREES = 180.0 / np.pi
LENGTH = 3.2186


def make_test(kind: str, angle_deg: float) -> Log:
    """Return a zigzag or a turning circle of a first-order ship, with a steering gear."""
    dt = 0.2
    t = np.arange(0.0, 120.0, dt)
    command = np.zeros_like(t)
    u = np.full_like(t, 1.09)
    v = np.zeros_like(t)
    r = np.zeros_like(t)
    pose = np.zeros((len(t), 3))
    delta = 0.0
    delta_log = np.zeros_like(t)
    side = float(np.sign(angle_deg))
    for k in range(len(t) - 1):
        if t[k] < 5.0:
            command[k] = 0.0
        elif kind == "turning_circle":
            command[k] = angle_deg / DEGREES
        else:
            if side * pose[k, 2] >= abs(angle_deg) / DEGREES:
                side = -side
            command[k] = side * abs(angle_deg) / DEGREES
        delta_log[k] = delta
        delta = float(simulate_gear(command[k : k + 1].repeat(2), delta, dt, 0.6, 0.3, 0.0)[1])
        r[k + 1] = r[k] + dt * (0.16 * delta - r[k]) / 2.0
        v[k + 1] = -1.2 * r[k + 1]
        u[k + 1] = u[k] + dt * (0.05 * (1.09 - u[k]) - 2.0 * r[k] ** 2)
        psi = pose[k, 2]
        north = u[k] * np.cos(psi) - v[k] * np.sin(psi)
        east = u[k] * np.sin(psi) + v[k] * np.cos(psi)
        pose[k + 1] = pose[k] + dt * np.array([north, east, r[k]])
    command[-1] = command[-2]
    delta_log[-1] = delta
    x, y, psi_log = pose.T
    channels = {
        "x": x, "y": y, "psi": psi_log, "u": u, "v": v, "r": r, "cmd_delta": command,
        "delta": delta_log,
    }  # fmt: skip
    return Log(kind, t, channels, manoeuvre=kind)


@cache
def make_tests() -> dict[str, Log]:
    """Return the tests of all layouts by the name of their file."""
    return {
        "run_4711": make_test("zigzag", 10.0),
        "run_4712": make_test("zigzag", 20.0),
        "run_4713": make_test("turning_circle", 35.0),
    }


def table_of(log: Log, columns: dict[str, tuple[str, float]]) -> list[list[float]]:
    """Return rows of time and of channels times a factor."""
    values = [log.t, *(log[channel] * factor for channel, (_, factor) in columns.items())]
    return np.round(np.column_stack(values), 5).tolist()


PLAIN = {
    "x": ("X0", 1.0), "y": ("Y0", 1.0), "psi": ("Heading", DEGREES), "u": ("u", 1.0),
    "v": ("v", 1.0), "r": ("Rate of turn", DEGREES), "cmd_delta": ("Rudder order", DEGREES),
    "delta": ("Rudder angle", DEGREES),
}  # fmt: skip


def write_merged_groups(workbook: Any, log: Log, label: str) -> None:
    """Write merged cells that group the columns, names, and a row of units."""
    sheet = workbook.active
    sheet.append(["", "Position", "", "Motion", "", "", "", "Steering", ""])
    for cells in ("B1:C1", "D1:G1", "H1:I1"):
        sheet.merge_cells(cells)
    sheet.append(["Time", *(name for name, _ in PLAIN.values())])
    sheet.append(["s", "m", "m", "deg", "m/s", "m/s", "deg/s", "deg", "deg"])
    for row in table_of(log, PLAIN):
        sheet.append(row)


def write_comments(workbook: Any, log: Log, label: str) -> None:
    """Write comments above, a cell with the type of the test, units in the names."""
    sheet = workbook.active
    sheet.append(["Basin", "Towing tank 2"])
    sheet.append(["Remarks", "calm water, deep; model free to roll"])
    sheet.append([f"Type: {label}"])
    sheet.append([])
    units = ["m", "m", "deg", "m/s", "m/s", "deg/s", "deg", "deg"]
    names = [f"{name} [{unit}]" for (name, _), unit in zip(PLAIN.values(), units, strict=True)]
    sheet.append(["t [s]", *names])
    for row in table_of(log, PLAIN):
        sheet.append(row)


def write_commas(workbook: Any, log: Log, label: str) -> None:
    """Write all numbers as texts with a decimal comma."""
    sheet = workbook.active
    sheet.append(["Test", label])
    sheet.append(["Time", *(name for name, _ in PLAIN.values())])
    sheet.append(["s", "m", "m", "deg", "m/s", "m/s", "deg/s", "deg", "deg"])
    for row in table_of(log, PLAIN):
        sheet.append([f"{value:.5f}".replace(".", ",") for value in row])


def write_drift(workbook: Any, log: Log, label: str) -> None:
    """Write speed V and drift angle instead of surge and sway."""
    sheet = workbook.active
    speed = np.hypot(log["u"], log["v"])
    drift = -np.arctan2(log["v"], log["u"]) * DEGREES
    sheet.append(["Test type", label])
    names = ["Time", "X", "Y", "Psi", "V", "Drift angle", "r", "Rudder order", "Rudder"]
    sheet.append(names)
    sheet.append(["s", "m", "m", "deg", "m/s", "deg", "deg/s", "deg", "deg"])
    degrees = {name: log[name] * DEGREES for name in ("psi", "r", "cmd_delta", "delta")}
    columns = [
        log.t, log["x"], log["y"], degrees["psi"], speed, drift, degrees["r"],
        degrees["cmd_delta"], degrees["delta"],
    ]  # fmt: skip
    for row in np.round(np.column_stack(columns), 5).tolist():
        sheet.append(row)


def write_sheets(workbook: Any, log: Log, label: str) -> None:
    """Write the tracking system and the model's recorder on two sheets, after particulars."""
    cover = workbook.active
    cover.title = "Info"
    cover.append(["Model", "M-4711"])
    cover.append(["Type", label])
    for title, names, stride, units in (
        ("Tracking", ("x", "y", "psi"), 2, ("m", "m", "deg")),
        ("Model", ("u", "v", "r", "cmd_delta", "delta"), 1, ("m/s", "m/s", "deg/s", "deg", "deg")),
    ):
        columns = {name: PLAIN[name] for name in names}
        sheet = workbook.create_sheet(title)
        sheet.append(["Time", *(name for name, _ in columns.values())])
        sheet.append(["s", *units])
        for row in table_of(log, columns)[::stride]:
            sheet.append(row)


LAYOUTS: dict[str, Callable[[Any, Log, str], None]] = {
    "merged_groups": write_merged_groups,
    "comments": write_comments,
    "commas": write_commas,
    "drift": write_drift,
    "sheets": write_sheets,
}


def write_layout(folder: Path, layout: str) -> None:
    """Write the workbooks of all tests in one layout."""
    folder.mkdir(exist_ok=True)
    for name, log in make_tests().items():
        workbook = openpyxl.Workbook()
        angle = round(float(np.abs(log["cmd_delta"]).max()) * DEGREES)
        label = (
            f"Zigzag {angle}/{angle}" if log.manoeuvre == "zigzag" else f"Turning circle {angle}"
        )
        LAYOUTS[layout](workbook, log, label)
        workbook.save(folder / f"{name}.xlsx")


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_drafted_with_the_channels_and_kinds_of_the_tests(
    layout: str, tmp_path: Path
) -> None:
    write_layout(tmp_path / layout, layout)
    draft = residnet.draft_config(
        tmp_path / layout, folder=tmp_path, length=f"{LENGTH} m", scale=50.0
    )
    content = yaml.safe_load(draft.text)
    assert content["signals"]["inputs"] == ["delta"]
    reader = content["data"]["reader"]
    assert reader["manoeuvre"] == "auto" or reader["manoeuvre"] in ("zigzag", "turning_circle")
    gear = content["booklet"]["inputs"]["delta"]
    assert float(gear["rate"].split()[0]) == pytest.approx(0.6 * DEGREES, rel=0.1)
    names = [entry["name"] for entry in content["booklet"]["manoeuvres"]]
    assert {"circle_35_starboard", "zigzag_10_10", "zigzag_20_20"} <= set(names)
    logs = residnet.read_logs(sorted((tmp_path / layout).glob("*.xlsx")), reader=reader)
    for log, (name, truth) in zip(logs, make_tests().items(), strict=True):
        assert log.manoeuvre == truth.manoeuvre, name
        # speed and drift angle are converted to surge and sway only with complete motion
        channels = [
            channel for channel in ("psi", "r", "delta", "x", "y", "u", "v")
            if channel in log.channels
        ]  # fmt: skip
        assert {"psi", "delta"} <= set(channels)
        for channel in channels:
            is_measured = np.isfinite(log[channel])
            expected = np.interp(log.t - log.t[0], truth.t, truth[channel])
            np.testing.assert_allclose(
                log[channel][is_measured] - log[channel][is_measured][0],
                expected[is_measured] - expected[is_measured][0],
                atol=2e-3,
                err_msg=f"{name}: {channel}",
            )


def test_a_sheet_is_read_again_after_a_change_only(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.xlsx"
    reads: list[str] = []
    read_excel = pd.read_excel

    def count_read(path: Path, **settings: Any) -> Any:
        reads.append(settings["sheet_name"])
        return read_excel(path, **settings)

    monkeypatch.setattr(pd, "read_excel", count_read)
    for surge in (1.0, 2.0):
        workbook = openpyxl.Workbook()
        sheet = workbook.active
        assert sheet is not None
        sheet.append(["t [s]", "u [m/s]", "r [rad/s]"])
        for k in range(8):
            sheet.append([k, surge, 0.1])
        workbook.save(file)
        preview = read_excel_sheet(file, "Sheet", 20)
        preview["u [m/s]"] = 0.0
        assert read_excel_sheet(file, None)["u [m/s]"].tolist() == [surge] * 8
        assert len(read_excel_sheet(file, "Sheet", 5)) == 4
    assert reads == ["Sheet", "Sheet"]
    # a part of a sheet is not enough for all of it
    copy = tmp_path / "b.xlsx"
    shutil.copy(file, copy)
    assert len(read_excel_sheet(copy, None, 5)) == 4
    assert len(read_excel_sheet(copy, None)) == 8


def test_a_comma_before_three_digits_alone_is_not_taken_for_a_decimal(tmp_path: Path) -> None:
    workbook = openpyxl.Workbook()
    sheet = workbook.active
    assert sheet is not None
    sheet.append(["t [s]", "rpm", "u [m/s]"])
    for k in range(8):
        sheet.append([k, f"1,{200 + k}", 1.0 + 0.1 * k])
    workbook.save(tmp_path / "a.xlsx")
    table = read_excel_sheet(tmp_path / "a.xlsx", None)
    assert table["rpm"].tolist()[0] == "1,200"
