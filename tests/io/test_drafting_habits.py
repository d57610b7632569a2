"""Drafts of what autopilots, simulators and spreadsheets write by habit."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from drafted_logs import assert_read, drafted
from scipy.spatial.transform import Rotation

import residnet
from residnet.core.errors import DataError
from residnet.core.log import Log
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.reading import read_drafted
from residnet.io.drafting.tables import draft_tables
from residnet.preprocessing.motion import MotionConfig, complete_motion

# radii of curvature of WGS 84 at 54.3 deg north, in m per degree
MERIDIAN = 111_302.6
PARALLEL = 65_100.6
DEGREE = math.degrees(1.0)


@pytest.fixture(scope="module")
def seen() -> pd.DataFrame:
    """Turns of a boat with a rudder: channels in SI, and what recorders make of them."""
    trial = {"kind": "zigzag", "drive": 0.8, "steer": 0.6, "heading": "70 deg", "start": 3}
    flown = residnet.simulate("example_rudder_boat", [trial], duration=90.0, step=0.2, seed=4)
    (log,) = flown.logs
    s = pd.DataFrame({"t": log.t, **log.channels, "azimuth": log["delta"]})
    s["lat"], s["lon"], s["hdg"] = 54.3 + s.x / MERIDIAN, 10.15 + s.y / PARALLEL, s.psi * DEGREE
    s["hdg"], s["rudder"], s["rpm"] = s.hdg % 360.0, s.delta * DEGREE, 60.0 * s.n
    s["phi"], s["p"] = 0.1 * np.sin(s.t), 0.1 * np.cos(s.t)
    s["cos"] = np.cos(s.psi)
    s["sin"] = np.sin(s.psi)
    ground = np.exp(1j * s.psi) * (s.u + 1j * s.v)
    s["vn"], s["ve"] = ground.to_numpy().real, ground.to_numpy().imag
    south = 108.6 - s.lat
    west = 20.3 - s.lon
    for name, angle, side in (
        *(("lat_N", s.lat, "N"), ("lat_S", south, "S"), ("lon_O", s.lon, "O")),
        *(("lon_", s.lon, ""), ("lon_W", west, "W"), ("lon_O_west", west, "O")),
    ):
        s[name] = [f"{int(a)}°{a % 1 * 60:.5f}'{side}" for a in angle]
        s[f"{name}_s"] = [f"{int(a)} {int(a * 60 % 60)} {a * 3600 % 60:.4f} {side}" for a in angle]
        s[f"{name}_p"] = [f"{100 * int(a) + a % 1 * 60:.6f},{side}" for a in angle]
    # a true wind in gusts, and the one that is felt, seen from the bow
    s["wind_speed"], s["wind_dir"] = 6.0 + np.sin(0.3 * s.t), 1.0 + 0.05 * np.cos(0.2 * s.t)
    felt = (s.wind_speed * np.exp(1j * (s.wind_dir - s.psi)) + s.u + 1j * s.v).to_numpy()
    # attitudes with some roll, clockwise from north and anticlockwise from east, of either sign
    sign = np.where(np.sin(s.t) < 0, -1.0, 1.0)
    lean = np.cos(0.05 * s.t) / 40.0
    for frame, yaw in (("ned", s.psi), ("enu", math.pi / 2 - s.psi)):
        turn = Rotation.from_euler("ZX", np.stack([yaw, lean], axis=1)).as_quat()
        for part, values in zip("xyzw", turn.T, strict=True):
            s[f"{frame}_{part}"] = sign * values
    return s.assign(felt=np.abs(felt), felt_angle=np.degrees(np.angle(felt)))


TIME = "time [s] = t, rpm = rpm"
POSE = "x = x, y = y, yaw = psi"


@dataclass(frozen=True)
class Habit:
    """What a recorder writes, and what its draft must make of it.

    Attributes:
        columns: `name = expression` of what was seen, behind those of `acts`.
        read: channels that must be as they were.
        guessed: channels that the draft must mark, `sure` those that it must not.
        absent: channels that must not be read.
        told: words that stand among guesses and notes, `never` those that do not.
        atol: how far channels may be from what was seen.
    """

    columns: str
    read: str
    guessed: str = ""
    sure: str = ""
    absent: str = ""
    told: str = ""
    never: str = ""
    atol: float = 1e-9
    acts: str = f"{TIME}, rudder [deg] = rudder"


PLACE = "north [m] = x, east [m] = y"
PORT = "positive to port by roll angles"
VESSELS = "have a position each"
ROLLS = "heading [rad] = psi, roll [rad] = phi"
ONE = ", ".join(f"{{0}}_{n}" for n in ("x = x", "y = y", "psi_deg = hdg", "delta_deg = rudder"))
STILL = ", ".join(f"{{0}}_{n} = 0 * t" for n in ("u", "x", "y", "psi_deg", "delta_deg"))


def fixes(columns: str, guessed: str = "longitude", told: str = "") -> Habit:
    """Fixes, which are written to some centimetres."""
    sure = "longitude" if not guessed else ""
    return Habit(columns, "x y", guessed=guessed, sure=sure, told=told, atol=0.05)


def quaternion(names: str, frame: str) -> str:
    pairs = zip(names.split(), "xyzw", strict=True)
    return ", ".join(f"{name} = {frame}_{part}" for name, part in pairs)


def ros(stem: str, frame: str) -> str:
    """A pose and a twist by REP 103, or by the axes of NED."""
    side, (first, second) = ("", "xy") if frame == "ned" else ("-", "yx")
    turned = quaternion(" ".join(f"{stem}orientation.{part}" for part in "xyzw"), frame)
    moved = f"twist.linear.x = u, twist.linear.y = {side}v, twist.angular.z = {side}r"
    return f"{stem}position.x = {first}, {stem}position.y = {second}, {turned}, {moved}"


HABITS: dict[str, Habit] = {
    "along the axes of the boat": Habit(f"{POSE}, vx = u, vy = v", "x y psi u v", "u"),
    "along those of the ground": Habit(
        f"{POSE}, vx = vn, vy = ve",
        "x y psi u v",
        told="velocities in earth axes",
        atol=1e-6,
    ),
    "whole numbers of an autopilot": Habit(
        "lat = 1e7 * lat // 1, lon = 1e7 * lon // 1, hdg = 100 * hdg // 1",
        "x y psi",
        guessed="latitude longitude psi",
        atol=0.05,
    ),
    "O is east beside German words": fixes("Breite = lat_N, Länge = lon_O, Kurs [°] = hdg"),
    "O is west beside French words": fixes("Lat = lat_N, Long = lon_O_west, Cap [°] = hdg"),
    "O stands in a column of its own": fixes(
        "Breite = lat_N, Länge = lon_, Kurs [°] = hdg, Seite = 'O'"
    ),
    "minutes in the south-west": fixes("Lat = lat_S, Lon = lon_W", guessed=""),
    "seconds in the south-west": fixes("Lat = lat_S_s, Lon = lon_W_s", guessed=""),
    "degrees and minutes in one, south-west": fixes("Lat = lat_S_p, Lon = lon_W_p", guessed=""),
    "minutes behind degrees, letters beside them": fixes(
        "Lat = 5400 + 60 * (lat - 54), Lon = 1000 + 60 * (lon - 10), NS = 'N', EW = 'E'",
        guessed="",
        told="degrees and minutes in one",
    ),
    **{
        f"a quaternion called {names}": Habit(
            f"{PLACE}, {quaternion(names, frame)}", "psi", "qw", absent="qx qy qz qw"
        )
        for names, frame in (
            ("qx qy qz qw", "enu"),
            ("pose.orientation.x pose.orientation.y pose.orientation.z pose.orientation.w", "ned"),
            ("quat_x[-] quat_y[-] quat_z[-] quat_w[-]", "enu"),
            ("q[1] q[2] q[3] q[0]", "ned"),
            ("q0 q1 q2 q3", "enu"),
        )
    },
    **{
        f"a pose of ROS under {stem}, {frame}": Habit(
            f"header.frame_id = 'map_{frame}', {ros(stem, frame)}", "x y u v r psi", "qw x"
        )
        for stem in ("pose.", ".pose.pose.", "field.pose.pose.", "")
        for frame in ("ned", "enu")
    },
    "rates beside a heading of ROS alone": Habit(
        quaternion("imu.orientation.x imu.orientation.y imu.orientation.z imu.orientation.w", "enu")
        + ", twist.angular.z = -r",
        "r psi",
        guessed="r",
    ),
    "N beside E is north": Habit(
        "N [m] = x, E [m] = y, heading [deg] = hdg, X [kN] = n",
        "x y psi n",
        "x",
        told="but the unit",
    ),
    "N_m beside E_m is north": Habit("N_m = x, E_m = y, heading [deg] = hdg", "x y psi n", "x"),
    "what was ordered beside what was": Habit(
        f"cmd_u = 1 + 0 * t, {ONE.format('cmd')}, meas_u = u, {ONE.format('meas')}",
        "u delta",
        never=VESSELS,
        acts=TIME,
    ),
    "two vessels, the first of which rests": Habit(
        f"{STILL.format('alpha')}, bravo_u = u, {ONE.format('bravo')}",
        "u delta",
        told=VESSELS,
        acts=TIME,
    ),
    "rates in rad/s": Habit(f"{ROLLS}, ROT = r, rollrate = p", "r p", never=PORT),
    "rates in deg/s": Habit(
        f"{ROLLS}, ROT = {DEGREE} * r, rollrate = {DEGREE} * p", "r p", never=PORT
    ),
    "rates to port in deg/min": Habit(
        f"{ROLLS}, ROT = {-60 * DEGREE} * r, rollrate = {-60 * DEGREE} * p", "r p", told=PORT
    ),
    **{
        f"a {name}": Habit(f"{PLACE}, {name} = hdg", "x y psi", told="magnetic declination")
        for name in ("magnetic heading [deg]", "Compass [deg]", "heading_mag [deg]")
    },
    "a true heading": Habit(f"{PLACE}, heading [deg] = hdg", "psi", never="declination"),
    "a heading by cosine and sine": Habit(
        "x = x, y = y, cos(psi) = cos, sin(psi) = sin", "x y psi"
    ),
    "groups of a model basin": Habit(
        "Hull/Acc/Z3 = 0.1 * p, Prop/PS/Rpm = rpm, Rudder/Angle = rudder,"
        "Rudder/MaxAngle = 35 + 0 * t, psi = psi, x0 = x, y0 = y, z0 = 0.1 * phi",
        "x y psi delta",
        acts=" = t",
    ),
    "a wind that is felt": Habit(
        f"{POSE}, u = u, v = v, AWS [m/s] = felt, AWA [deg] = felt_angle", "wind_speed wind_dir"
    ),
    **{
        f"a wind told by what makes it steady, as {direction}": Habit(
            f"{POSE}, u = u, v = v, wind speed [m/s] = {speed}, wind direction [deg] = {direction}",
            "wind_speed wind_dir",
        )
        for speed, direction in (
            ("felt", "felt_angle"),
            ("wind_speed", f"{DEGREE} * (wind_dir - psi)"),
            ("wind_speed", f"{DEGREE} * wind_dir"),
        )
    },
    "a channel's own name goes before others": Habit(
        "lat (rad) = 0.7 + 0 * t, lon (rad) = 0.7 + 0 * t, x (m) = x, y (m) = y, psi (rad) = psi,"
        "vx (m/s) = vn, vy (m/s) = ve, u (m/s) = u, v (m/s) = v, Thruster_Azimuth_deg = rudder",
        "u v x y azimuth",
        sure="azimuth",
        absent="latitude",
    ),
    "a rudder told several times": Habit(
        f"{POSE}, rudder port tank [deg] = 1 + rudder,rudder two [deg] = 1 + rudder",
        "delta",
        absent="delta_port delta_1 delta_2",
    ),
}


@pytest.mark.parametrize("name", HABITS)
def test_a_habit_is_read_as_it_was_meant(name: str, seen: pd.DataFrame, tmp_path: Path) -> None:
    habit = HABITS[name]
    written = {}
    for told in f"{habit.acts}, {habit.columns}".split(","):
        column, _, expression = told.partition(" = ")
        written[column.strip()] = seen.eval(expression, engine="python")
    pd.DataFrame(written).to_csv(file := tmp_path / "22605.csv", index=False)
    log, _, marks = drafted(file)
    assert_read(log, {channel: seen[channel] for channel in habit.read.split()}, habit.atol)
    guessed = {key[-1] for key, _ in marks.guessed_values}
    assert {*habit.guessed.split()} <= guessed
    assert not {*habit.sure.split()} & guessed
    assert not {*habit.absent.split()} & {*log.channels}
    said = " ".join(text for _, text in [*marks.guessed_values, *marks.notes])
    assert habit.told in said
    assert not habit.never or habit.never not in said


def test_a_speed_is_that_forward_where_no_heading_is_known(tmp_path: Path) -> None:
    t = np.arange(0.0, 60.0, 0.2)
    speed = 1.0 + 0.5 * np.sin(0.1 * t)
    track = {"lat": 54.3 + np.cumsum(0.2 * speed) / 111_132.0, "lon": 10.15}
    frame = pd.DataFrame({"t": t, **track, "sog [m/s]": speed, "motor1 [%]": 50.0 * speed})
    frame.to_csv(file := tmp_path / "log.csv", index=False)
    log, _, marks = drafted(file)
    assert_read(log, {"u": speed})
    assert "u" in {key[-1] for key, _ in marks.guessed_values}
    frame.assign(**{"course over ground [deg]": 0.0}).to_csv(file, index=False)
    assert "u" not in drafted(file)[0].channels


def test_a_workbook_that_begins_with_words(seen: pd.DataFrame, tmp_path: Path) -> None:
    with pd.ExcelWriter(file := tmp_path / "log.xlsx") as book:
        words = pd.DataFrame({"Protokoll": ["Probefahrt", "gutes Wetter"]})
        words.to_excel(book, sheet_name="Info", index=False)
        table = pd.DataFrame(
            {"time [s]": seen.t, "x": seen.x, "y": seen.y, "yaw": seen.psi, "rpm": seen.rpm}
        )
        table.to_excel(book, sheet_name="Daten", index=False)
    log, content, _ = drafted(file)
    assert content["sheet"] == "Daten"
    assert_read(log, {"x": seen.x})


def test_json_lines(seen: pd.DataFrame, tmp_path: Path) -> None:
    lines = [
        json.dumps(
            {
                **{"stamp": row.t, "nav": {"north": row.x, "east": row.y, "heading_deg": row.hdg}},
                **{"act": {"rudder_deg": [row.rudder]}, "scan": list(range(40))},
            }
        )
        for row in seen.itertuples()
    ]
    file = tmp_path / "log.jsonl"
    file.write_text("\n".join([*lines, "", '{"stamp": 9']))
    log, content, marks = drafted(file)
    assert content["kind"] == "json_lines"
    assert "cut_line" in {finding["code"] for finding in log.meta["findings"]}
    assert_read(log, {name: seen[name] for name in ("x", "y", "psi", "delta")})
    file.write_text("\n".join([lines[0], "[1]", *lines[1:]]))
    with pytest.raises(DataError, match=r"line 2, '\[1\]', is no JSON object"):
        draft_tables([file], marks)


def test_documents_of_json(seen: pd.DataFrame, tmp_path: Path) -> None:
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [row.lon, row.lat]}}
        | {"properties": {"time": row.t, "rudder_deg": f"{row.rudder:.3f} deg", "rpm": row.rpm}}
        for row in seen.itertuples()
    ]
    file = tmp_path / "trip.json"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    assert_read(drafted(file)[0], {name: seen[name] for name in ("x", "y", "delta")}, 0.05)
    motors = {"time": seen.t.tolist(), "rpm": seen.rpm.tolist()}
    fixes = seen[["t", "x"]].rename(columns={"t": "time", "x": "north_m"})[::5]
    tables = {"motors": motors, "gnss": fixes.to_dict("records"), "notes": [{"crew": "Ada"}] * 2}
    file.write_text(json.dumps(tables))
    with pytest.raises(DataError, match=r"several tables, motors \(\d+ rows\), gnss \(\d+ rows\);"):
        draft_tables([file], DraftNotes())


@pytest.mark.parametrize("pose", [True, False], ids=["heading", "yaw rate alone"])
@pytest.mark.parametrize("side", [1.0, -1.0], ids=["clockwise", "anticlockwise"])
def test_a_wind_from_the_bow_by_cosine_and_sine_becomes_the_true_wind(
    seen: pd.DataFrame, tmp_path: Path, side: float, pose: bool
) -> None:
    s = seen
    angle = side * (seen.wind_dir - seen.psi)
    columns = {"time": s.t, "u": s.u, "v": s.v, "r": s.r} | ({"psi": s.psi} if pose else {})
    columns |= {"Vw": s.wind_speed, "alpha_x": np.cos(angle), "alpha_y": np.sin(angle)}
    columns |= {"deltal": s.delta, "deltar": 0.9 * s.delta, "n": s.n}
    pd.DataFrame(columns).to_csv(file := tmp_path / "ship.tab", index=False, sep="\t")
    log, _, marks = drafted(file)
    assert {"delta_port", "delta_stbd", "n"} <= log.channels.keys()
    begin = 0.0 if pose else s.psi[0]
    assert_read(log, {"wind_speed": s.wind_speed})
    assert_read(log, {"wind_dir": s.wind_dir - begin}, 0.02)
    assert "wind_angle_cos" in {key[-1] for key, _ in marks.guessed_values}


def test_the_wind_that_is_felt_is_made_true_by_velocities_that_a_smoother_finds(
    seen: pd.DataFrame, tmp_path: Path
) -> None:
    columns = {
        "t": seen.t,
        "x": seen.x,
        "y": seen.y,
        "yaw": seen.psi,
        "r": seen.r,
        "delta": seen.delta,
        "n": seen.n,
    }
    columns |= {"AWS [m/s]": seen.felt, "AWA [deg]": seen.felt_angle}
    pd.DataFrame(columns).to_csv(file := tmp_path / "ship.csv", index=False)
    log, _, _ = drafted(file)
    assert "wind_dir" not in log.channels
    named = residnet.inspect([log], inputs=("delta", "n", "wind_speed", "wind_dir"))
    assert named.text.str.contains("apparent_wind_angle").any()
    made = complete_motion(log, MotionConfig())
    off = np.exp(1j * made["wind_dir"]) - np.exp(1j * seen.wind_dir)
    assert float(np.abs(off).mean()) < 0.05


def test_a_folder_of_messages_whose_values_come_in_turns(
    seen: pd.DataFrame, tmp_path: Path
) -> None:
    clock = "timestamp (seconds since 01/01/1970)"
    for number in range(2):
        folder = tmp_path / f"20250614_10{number}005_auv"
        t = 1.75e9 + 900.0 * number + seen.t
        folder.mkdir()
        wrapped = (seen.psi + np.pi) % (2.0 * np.pi) - np.pi
        state = {clock: t, " system": "auv", " entity": "Navigation"}
        state |= {" x (m)": seen.x, " y (m)": seen.y, " psi (rad)": wrapped}
        fins = [
            pd.DataFrame({clock: t + 0.01 * k, " id": k, " value (rad)": value})
            for k, value in enumerate((-seen.delta, 0.3 * np.sin(0.2 * seen.t)))
        ]
        messages = {
            "EstimatedState": pd.DataFrame(state),
            "SetServoPosition": pd.concat(fins).sort_values(clock),
            "Rpm": pd.DataFrame({clock: t, " value (rpm)": seen.rpm.round()}),
        }
        for name, table in messages.items():
            table.to_csv(folder / f"{name}.csv", index=False)
        pd.DataFrame({clock: t, " value (V)": 25.0}).to_csv(folder / "Voltage.csv")
    logs = residnet.read_logs(tmp_path)
    assert len(logs) == 2
    log = logs[0]
    inner = slice(20, -20)
    assert log.units["servo_1"] == log.units["servo_2"] == "rad"
    # what the folder that holds them is called says nothing of its messages
    (alone,) = residnet.read_logs(shutil.copytree(folder, tmp_path / "one" / folder.name).parent)
    assert {*alone.channels} == {*log.channels}
    at = np.interp(log.t - log.t[0], seen.t, seen.delta)[inner]
    assert np.corrcoef(log["servo_1"][inner], -at)[0, 1] > 0.99
    np.testing.assert_allclose(60.0 * np.nanmax(log["n"]), round(seen.rpm.max()), rtol=1e-6)


def test_thrusters_that_no_number_tells_apart_are_one_each(
    seen: pd.DataFrame, tmp_path: Path
) -> None:
    called = [f"cmd_thrust_{end}_{side}" for end in ("fore", "aft") for side in ("port", "stbd")]
    called += [f"cmd_thrust_lift_{one.removeprefix('cmd_thrust_')}" for one in called]
    forces = {one: 9 * np.sin((0.1 + 0.02 * k) * seen.t) for k, one in enumerate(called)}
    pd.DataFrame({"t": seen.t, "x": seen.x, "y": seen.y, "yaw": seen.psi, **forces}).to_csv(
        file := tmp_path / "rov.csv", index=False
    )
    log, _, marks = drafted(file)
    inputs = [log[name] for name in log.channels if name.startswith("cmd_thrust")]
    assert len(inputs) == len(called)
    for force in forces.values():
        assert any(np.allclose(values, force, atol=1e-12) for values in inputs)
    assert "cmd_thrust_port_1" in {key[-1] for key, _ in marks.guessed_values}


def test_logs_with_other_columns_beside_each_other_are_no_messages(
    seen: pd.DataFrame, tmp_path: Path
) -> None:
    table = pd.DataFrame({"Time [s]": seen.t, "speed [m/s]": seen.u, "motor rps": seen.n})
    table["battery [V]"] = 24.0 - 0.01 * seen.t
    for k in range(4):
        table[[*table][: 3 + k % 2]].to_csv(tmp_path / f"run_{k}.csv", index=False)
    assert len(residnet.read_logs(tmp_path)) == 4


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["dives", "rises"])
def test_planes_are_told_by_the_pitch_that_they_hold(tmp_path: Path, side: float) -> None:
    random = np.random.default_rng(3)
    t = np.arange(0.0, 120.0, 0.1)
    planes = random.uniform(-0.2, 0.2, 31)[(t / 4.0).astype(int)]
    theta = np.zeros(t.size)
    q = np.zeros(t.size)
    for k in range(t.size - 1):
        # the pitch rate is gone by the end of most holds, the pitch is not
        turn = -1.5 * q[k] - 0.9 * np.sin(theta[k]) - 0.5 * planes[k]
        theta[k + 1], q[k + 1] = theta[k] + 0.1 * q[k], q[k] + 0.1 * turn
    u = 1.5 + 0.1 * np.sin(0.2 * t)
    heave = -0.2 * q
    frame = pd.DataFrame(
        {
            "Zeit [s]": t,
            "Fahrt [m/s]": u,
            "heave velocity [m/s]": heave,
            "pitch rate [deg/s]": np.degrees(q),
            "pitch [deg]": np.degrees(theta + 1e-4 * random.normal(size=t.size)),
            "Tiefe [m]": 10.0 + 0.1 * np.cumsum(heave * np.cos(theta) - u * np.sin(theta)),
            "Tiefenruder [deg]": np.degrees(side * planes),
            "rpm": 900.0 + 50.0 * np.cos(0.2 * t),
        }
    )
    frame.to_csv(file := tmp_path / "dive.csv", index=False)
    log: Log = read_drafted([file], DraftNotes()).logs[file]
    assert {"u", "w", "q", "theta", "z", "delta_s", "n"} <= log.channels.keys()
    assert "v" not in log.channels
    assert_read(log, {"delta_s": planes}, 1e-6)
