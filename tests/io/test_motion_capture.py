"""Exports of motion capture: rows of names, units, vertical axis, bow, rotations, gaps."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

import residnet
from residnet.core.errors import ResidnetError
from residnet.core.log import Log
from residnet.io.drafting.questions import READER_KEY
from residnet.io.drafting.reading import read_mixed_formats
from residnet.io.readers.joined_files import JoinedConfig
from residnet.io.readers.motion_capture import detect_mocap_axes
from residnet.io.readers.tables import CsvConfig
from residnet.tasks.drafting import write_new_config

pytestmark = pytest.mark.usefixtures("omit_currents")

TRUTH = pd.read_csv(Path(__file__).parents[1] / "corpus" / "truth_1.csv")
UNITS = {"Meters": 1.0, "Millimeters": 1000.0}
BOWS = {("y", "x"): 0.0, ("y", "z"): 90.0, ("y", "-z"): -90.0, ("z", "x"): 0.0, ("z", "y"): -90.0}
"""Vertical axis and bow -> angle in deg, clockwise, from the x axis of the body to the bow."""


def write_take(
    path: Path,
    up: str = "y",
    bow: str = "x",
    unit: str = "Meters",
    rotation: Literal["Quaternion", "XYZ", "ZYX"] = "Quaternion",
    bodies: tuple[str, ...] = ("hover",),
) -> None:
    """Write a motion as Motive exports it; x of the room is north."""
    heading = TRUTH.psi.to_numpy() - np.radians(BOWS[up, bow])
    # the heading turns clockwise from above, against the axis that points up
    axis = np.array([0.0, 1.0, 0.0]) if up == "y" else np.array([0.0, 0.0, 1.0])
    rotations = Rotation.from_rotvec(-heading[:, None] * axis)
    height = 0.12 + np.random.default_rng(0).normal(0.0, 5e-4, len(TRUTH))
    position = (TRUTH.x, height, TRUTH.y) if up == "y" else (TRUTH.x, -TRUTH.y, height)
    if rotation == "Quaternion":
        angles = rotations.as_quat()
        names = ["X", "Y", "Z", "W"]
    else:
        euler = rotations.as_euler(rotation, degrees=True)
        angles = euler[:, [rotation.index(name) for name in "XYZ"]]
        names = ["X", "Y", "Z"]
    block = np.column_stack([angles, UNITS[unit] * np.stack(position, axis=1), height * 0.0])
    quantities = ["Rotation"] * len(names) + ["Position"] * 3 + ["Mean Marker Error"]
    columns = [["Rigid Body"] * len(quantities), [""] * len(quantities), quantities]
    rows = [[*[cell for _ in bodies for cell in columns[0]], "Rigid Body Marker", "Marker"]]
    rows += [[*[body for body in bodies for _ in quantities], "hover:M1", "loose"]]
    rows += [[*quantities * len(bodies), "Position", "Position"]]
    rows += [[*[*names, "X", "Y", "Z", ""] * len(bodies), "X", "X"]]
    head = f"Format Version,1.23,Take Name,Take {path.stem},Capture Frame Rate,5.0,Rotation Type,"
    head += f"{rotation},Length Units,{unit},Coordinate Space,Global"
    lines = [head, "", ",Type," + ",".join(rows[0]), ",Name," + ",".join(rows[1])]
    lines += [",ID," + ",".join(['"A1"'] * len(rows[0])), ",," + ",".join(rows[2])]
    lines += ["Frame,Time (Seconds)," + ",".join(rows[3])]
    for k, values in enumerate(block):
        # a frame in which the body is not tracked has empty cells
        cells = [""] * values.size if k % 97 == 50 else [f"{value:.6f}" for value in values]
        lines.append(f"{k},{TRUTH.t[k]:.6f}," + ",".join([*cells * len(bodies), "0.1", ""]))
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("up", "bow"), [*BOWS])
@pytest.mark.parametrize("unit", [*UNITS])
@pytest.mark.parametrize("rotation", ["Quaternion", "XYZ", "ZYX"])
def test_an_export_of_rigid_bodies_is_read(
    up: str, bow: str, unit: str, rotation: Literal["Quaternion", "XYZ", "ZYX"], tmp_path: Path
) -> None:
    write_take(tmp_path / "take.csv", up, bow, unit, rotation)
    assert detect_mocap_axes(tmp_path / "take.csv", 20_000) == (up, bow)
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    expected = TRUTH.drop(index=[k for k in TRUTH.index if k % 97 == 50])
    is_tracked = np.isfinite(log["x"])
    assert is_tracked.sum() == len(expected)
    assert np.abs(log["x"][is_tracked] - expected.x).max() < 1e-5
    assert np.abs(log["y"][is_tracked] - expected.y).max() < 1e-5
    error = np.exp(1j * (log["psi"][is_tracked] - expected.psi.to_numpy()))
    assert np.abs(np.angle(error)).max() < 1e-4


def test_a_take_and_the_commands_of_another_recorder_are_a_log(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    commands = {"millis": (1000.0 * TRUTH.t + 3000.0).astype(int)}
    commands |= {"thrust_cmd": TRUTH.n / 25.0, "rudder_deg": np.degrees(TRUTH.delta)}
    commands |= {"gyro_z_dps": np.degrees(TRUTH.r)}
    for run in (1, 2):
        write_take(logs / f"run{run}_mocap.csv")
        pd.DataFrame(commands).to_csv(logs / f"run{run}_board.csv", index=False)
    first, second = residnet.read_logs(logs)
    for log in (first, second):
        assert {"x", "y", "psi", "delta"} <= set(log.channels)
        at = log.t - log.t[0]
        error = log["delta"] - np.interp(at, TRUTH.t - TRUTH.t[0], TRUTH.delta)
        assert np.nanmedian(np.abs(error)) < np.radians(1.0)
    config = tmp_path / "boat.yaml"
    write_new_config([logs], config, None, overwrite=False)
    text = " ".join(config.read_text().replace("#", " ").split())
    assert "export of motion capture, by the motion y points up and x of the rigid body" in text
    assert JoinedConfig.model_fields


def test_several_bodies_have_columns_of_their_own(tmp_path: Path) -> None:
    write_take(tmp_path / "take.csv", bodies=("hover", "obstacle"))
    entries = {"x": {"column": "hover north [m]", "unit": "m"}}
    entries["y"] = {"column": "obstacle east [m]", "unit": "m"}
    settings = {"time": {"column": "t [s]"}, "channels": entries, "mocap_up": "y"}
    log = CsvConfig.model_validate(settings).build().read(tmp_path / "take.csv")
    assert np.nanmax(np.abs(log["y"] - TRUTH.y[: len(log)])) < 1e-5


def write_qualisys(path: Path, bodies: tuple[str, ...] = ("hull",), with_time: bool = True) -> None:
    """Write a motion as Qualisys exports it: z up, mm, zeros where the body is lost."""
    heading = -TRUTH.psi.to_numpy()
    matrices = Rotation.from_euler("Z", heading[:, None]).as_matrix()
    names = ["Frame", "Time"] if with_time else ["Frame"]
    quantities = ["Y", "Z", "Roll", "Pitch", "Yaw", "Residual", *(f"Rot[{i}]" for i in range(9))]
    lines = [f"NO_OF_FRAMES\t{len(TRUTH)}", "NO_OF_CAMERAS\t8", f"NO_OF_BODIES\t{len(bodies)}"]
    lines += ["FREQUENCY\t5", "NO_OF_ANALOG\t0", "ANALOG_FREQUENCY\t0", "DESCRIPTION\t--"]
    lines += ["TIME_STAMP\t2025-05-03, 14:22:31\t78123.12", "DATA_INCLUDED\t6D"]
    lines += ["BODY_NAMES\t" + "\t".join(bodies)]
    names += [cell for body in bodies for cell in (f"{body} X", *quantities)]
    lines += ["\t".join(names)]
    for k in range(len(TRUTH)):
        pose = [1000.0 * TRUTH.x[k], -1000.0 * TRUTH.y[k], 12.0, 0.0, 0.0, np.degrees(heading[k])]
        cells = [*pose, 0.4, *matrices[k].T.ravel()]
        cells = [0.0] * len(cells) if k % 97 == 50 else cells
        # further bodies do not move
        moving = [f"{value:.5f}" for value in cells]
        still = [f"{value:.5f}" for value in (5.0, 5.0, 5.0, 0, 0, 0, 0.4, *np.eye(3).ravel())]
        clock = [str(k + 1), f"{0.2 * k:.5f}"][: 1 + with_time]
        lines.append("\t".join([*clock, *still * (len(bodies) - 1), *moving]))
    path.write_text("\n".join(lines) + "\n")


def write_vicon(path: Path, unit: str = "deg") -> None:
    """Write a motion as Vicon exports it: z up, mm, empty cells where the body is lost."""
    scale = np.degrees(1.0) if unit == "deg" else 1.0
    heading = scale * ((-TRUTH.psi + np.pi) % (2.0 * np.pi) - np.pi)
    lines = ["Segments", "5", ",,boat:boat,,,,,", "Frame,Sub Frame,RX,RY,RZ,TX,TY,TZ"]
    lines += [f",,{unit},{unit},{unit},mm,mm,mm"]
    for k in range(len(TRUTH)):
        pose = [0.0, 0.0, heading[k], 1000.0 * TRUTH.x[k], -1000.0 * TRUTH.y[k], 12.0]
        cells = [""] * 6 if k % 97 == 50 else [f"{value:.6f}" for value in pose]
        lines.append(",".join([str(k + 1), "0", *cells]))
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("system", ["qualisys", "qualisys_frames", "vicon_deg", "vicon_rad"])
def test_exports_of_other_systems_are_read(system: str, tmp_path: Path) -> None:
    if system.startswith("qualisys"):
        write_qualisys(tmp_path / "take.tsv", with_time=system == "qualisys")
    else:
        write_vicon(tmp_path / "take.csv", system.removeprefix("vicon_"))
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    is_lost = np.arange(len(log)) % 97 == 50
    np.testing.assert_array_equal(np.isfinite(log["x"]), ~is_lost)
    np.testing.assert_allclose(log.t - log.t[0], 0.2 * np.arange(len(log)), atol=1e-4)
    for name, tolerance in (("x", 1e-5), ("y", 1e-5), ("psi", 1e-4)):
        error = (log[name] - TRUTH[name].to_numpy())[~is_lost]
        error = np.angle(np.exp(1j * error)) if name == "psi" else error
        assert np.abs(error).max() < tolerance, name


def test_the_body_that_moves_most_is_proposed_among_several(tmp_path: Path) -> None:
    write_qualisys(tmp_path / "take.tsv", ("frame", "hull"))
    (log,) = residnet.read_logs(tmp_path)
    assert isinstance(log, Log)
    assert np.nanmax(np.abs(log["x"] - TRUTH.x)) < 1e-5
    answers: dict[tuple[str, ...], str] = {(*READER_KEY, "mocap_body"): "frame"}
    result = read_mixed_formats([tmp_path / "take.tsv"], answers)[0]
    assert result.reader["mocap_body"] in ("frame", "hull")
    settings = {
        "time": {"column": "t [s]"},
        "channels": {"x": {"column": "north [m]", "unit": "m"}},
    }
    reader = CsvConfig.model_validate(settings | {"mocap_up": "z", "mocap_body": "hul"}).build()
    with pytest.raises(ResidnetError, match=r"no rigid body 'hul'; did you mean 'hull'"):
        reader.read(tmp_path / "take.tsv")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Rot[0]", "Rod[0]", r"has 6D and no rotation of a rigid body .*export '6D' data"),
        ("Frame\tTime", "A\tB", "has no column Time or Frame"),
    ],
)
def test_incomplete_exports_of_qualisys_are_refused(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    write_qualisys(tmp_path / "take.tsv")
    text = (tmp_path / "take.tsv").read_text().replace(old, new)
    (tmp_path / "take.tsv").write_text(text)
    with pytest.raises(ResidnetError, match=message) as refused:
        residnet.read_logs(tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Rigid Body", "Marker", "the export of Motive has no rigid body"),
        ("Length Units,Meters", "Length Units,Feet", "line 1 has the length unit 'Feet'"),
        ("Rotation,Rotation", "Rotatio,Rotation", "has no column 'Rotation X'"),
    ],
)
def test_other_exports_are_refused_in_one_line(
    old: str, new: str, message: str, tmp_path: Path
) -> None:
    write_take(tmp_path / "take.csv")
    text = (tmp_path / "take.csv").read_text().replace(old, new)
    (tmp_path / "take.csv").write_text(text)
    with pytest.raises(ResidnetError, match=message) as refused:
        residnet.read_logs(tmp_path)
    assert "\n" not in str(refused.value)
    assert "take.csv" in str(refused.value)


def test_the_bow_is_horizontal_and_the_file_an_export(tmp_path: Path) -> None:
    settings = {"time": {"column": "t"}, "channels": {"x": {"column": "x", "unit": "m"}}}
    with pytest.raises(ValueError, match=r"mocap_bow: 'y' is vertical with mocap_up: y"):
        CsvConfig.model_validate(settings | {"mocap_up": "y", "mocap_bow": "y"})
    (tmp_path / "plain.csv").write_text("t,x\n0,1\n1,2\n")
    reader = CsvConfig.model_validate(settings | {"mocap_up": "y"}).build()
    with pytest.raises(ResidnetError, match=r"plain\.csv: is no export of OptiTrack Motive"):
        reader.read(tmp_path / "plain.csv")
