"""Writes the inputs of the corpus: trips of a boat of 2 m by equations of its own, as recorders do.

`python tests/corpus/make.py [LAYOUT...]` writes the truth and every layout, each into its folder.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

HERE = Path(__file__).parent
STEP, EVERY, LENGTH = 0.02, 10, 100.0
START = pd.Timestamp("2025-06-17 08:30:00")
COMMANDS = {1: (1, 12.0), 2: (2, 9.0)}
"""Trip -> seed of its commands, and their longest hold in s."""


def trip(number: int) -> pd.DataFrame:
    """Return the truth of a trip each 0.02 s: pose, velocities, roll, shaft in 1/s, rudder."""
    seed, longest = COMMANDS[number]
    random, t = np.random.default_rng(seed), np.arange(0.0, LENGTH, STEP)

    def steps(low: float, high: float) -> np.ndarray:
        at = np.cumsum(random.uniform(3.0, longest, 60))
        return random.uniform(low, high, 61)[np.searchsorted(at, t)]

    n, delta = steps(8.0, 25.0), np.radians(steps(-25.0, 25.0))
    state, rows = np.array([0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]), []
    for i in range(t.size):
        rows.append(state)
        _, _, psi, u, v, r, phi, p = state
        rate = np.array(
            [
                u * np.cos(psi) - v * np.sin(psi),
                u * np.sin(psi) + v * np.cos(psi),
                r,
                0.0022 * n[i] ** 2 - 0.18 * u - 0.22 * u * abs(u) + 0.6 * v * r,
                -0.55 * u * r - 0.9 * v - 0.5 * v * abs(v) + 0.1 * u**2 * delta[i],
                0.75 * u**2 * delta[i] - 0.9 * r - 0.6 * r * abs(r) - 0.12 * u * v,
                p,
                -6.0 * phi - 1.1 * p - 0.9 * u * r,
            ]
        )
        state = state + STEP * rate
    names = ("x", "y", "psi", "u", "v", "r", "phi", "p")
    table = pd.DataFrame(np.array(rows), columns=names)
    return table.assign(n=n, delta=delta, t=t)


def seen(number: int, every: int = EVERY) -> pd.DataFrame:
    """Return what sensors say each `every` steps, in deg and rpm."""
    true, random = trip(number)[::every].reset_index(drop=True), np.random.default_rng(70 + number)

    def noisy(name: str, size: float) -> np.ndarray:
        return np.asarray(true[name] + size * random.normal(size=len(true)))

    return pd.DataFrame(
        {
            "t": true.t,
            **{name: noisy(name, 0.005).round(3) for name in ("x", "y")},
            "heading": (np.degrees(noisy("psi", 0.001)) % 360.0).round(2),
            **{name: noisy(name, 0.005).round(3) for name in ("u", "v")},
            "rate": np.degrees(noisy("r", 0.001)).round(3),
            "roll": np.degrees(noisy("phi", 0.001)).round(2),
            "roll rate": np.degrees(noisy("p", 0.001)).round(2),
            "rudder": np.degrees(true.delta).round(1),
            "rpm": (60.0 * true.n).round(),
        }
    )


def csv(folder: Path, number: int, columns: dict[str, Any], word: str = "run") -> None:
    """Write one table."""
    pd.DataFrame(columns).to_csv(folder / f"{word}{number}.csv", index=False)


POSE = {"x": "north [m]", "y": "east [m]", "heading": "heading [deg]"}
SPEEDS = {"u": "surge [m/s]", "v": "sway [m/s]", "rate": "yaw rate [deg/s]"}
ROLL = {"roll": "roll [deg]", "roll rate": "roll rate [deg/s]"}
ACTS = {"rudder": "rudder [deg]", "rpm": "shaft [rpm]"}


def renamed(s: pd.DataFrame, *names: dict[str, str]) -> dict[str, object]:
    """Return columns by what they are called in a file."""
    return {new: s[old] for part in names for old, new in part.items()}


TABLES: dict[str, Callable[[Any], dict[str, Any]]] = {
    "plain": lambda s: {"time [s]": s.t, **renamed(s, POSE, SPEEDS, ACTS)},
    "dead_gyro": lambda s: {"time [s]": s.t, **renamed(s.assign(rate=2e-5), POSE, SPEEDS, ACTS)},
    "no_pose": lambda s: {"time [s]": s.t, **renamed(s, SPEEDS, ACTS)},
    "surge_alone": lambda s: (
        {"time [s]": s.t, "speed [m/s]": s.u, "motor [us]": (1100 + s.rpm / 2).round()}
    ),
    "yaw_alone": lambda s: (
        {"time [s]": s.t, "heading [deg]": s.heading, "rudder [deg]": s.rudder}
    ),
    "speed_and_heading": lambda s: (
        {"time [s]": s.t, "speed [m/s]": s.u, "heading [deg]": s.heading, **renamed(s, ACTS)}
    ),
    "with_roll": lambda s: {"time [s]": s.t, **renamed(s, POSE, SPEEDS, ROLL, ACTS)},
    "whole_seconds": lambda s: {
        "time": (START + pd.to_timedelta(np.floor(s.t), "s")).dt.strftime("%Y-%m-%d %H:%M:%S"),
        **renamed(s, POSE, SPEEDS, ACTS),
    },
    "magnetic": lambda s: {
        "time [s]": s.t,
        **renamed(s, {**POSE, "heading": "compass heading [deg]"}, ACTS),
    },
    "newest_first": lambda s: {"time [s]": s.t[::-1], **renamed(s[::-1], POSE, ACTS)},
}
"""Layout -> columns of its tables, of those that are written as they stand."""


def micros_wrap(folder: Path, k: int, s: Any) -> None:
    micros = (2**32 - 40_000_000 * k + (1e6 * s.t).round().astype("int64")) % 2**32
    csv(folder, k, {"micros": micros, **renamed(s, POSE, SPEEDS, ACTS)})


def pandas_index(folder: Path, k: int, s: Any) -> None:
    columns = {"tvec": s.t, **renamed(s, {n: n for n in ("x", "y", "u", "v", "rudder", "rpm")})}
    columns |= {"psi": s.heading, "r": s.rate}
    pd.DataFrame(columns).to_csv(folder / f"run{k}.csv")


def heading_interpolated(folder: Path, k: int, s: Any) -> None:
    between = np.interp(s.t, s.t[::4], s.heading[::4])
    csv(folder, k, {"time [s]": s.t, **renamed(s.assign(heading=between), POSE, ACTS)})


def summer_hour(folder: Path, k: int, s: Any) -> None:
    moments = pd.Timestamp("2024-10-27 00:59:20", tz="UTC") + pd.to_timedelta(s.t, "s")
    local = moments.dt.tz_convert("Europe/Berlin").dt.strftime("%d.%m.%Y %H:%M:%S.%f").str[:-4]
    csv(folder, k, {"Zeit": local, **renamed(s, POSE, SPEEDS, ACTS)})


def bridge(folder: Path, k: int, s: Any) -> None:
    north, east = np.gradient(s.x, s.t), np.gradient(s.y, s.t)
    columns = {
        "UTC": (START + pd.to_timedelta(s.t, "s")).dt.strftime("%Y-%m-%dT%H:%M:%S.%f").str[:-3],
        "LAT": (54.3 + s.x / 111_315.0).round(7),
        "LON": (10.15 + s.y / 65_079.0).round(7),
        "HDT": s.heading,
        "SOG": (np.hypot(north, east) * 3600 / 1852).round(2),
        "COG": (np.degrees(np.arctan2(east, north)) % 360.0).round(1),
        "ROT": (60.0 * s.rate).round(1),
        "RUDDER": -s.rudder,
        "RPM": s.rpm,
    }
    csv(folder, k, columns)


def rostopic(folder: Path, k: int, s: Any) -> None:
    yaw = np.pi / 2 - np.radians(s.heading)
    topic, zero = "field.pose.pose.", np.zeros(len(s))
    stamps = START.value + (1e9 * s.t).round().astype("int64")
    columns: dict[str, Any] = {
        "%time": stamps,
        "field.header.seq": s.index,
        "field.header.stamp": stamps,
    }
    columns |= {"field.header.frame_id": ["odom"] * len(s)}
    columns |= {"field.child_frame_id": ["base_link"] * len(s)}
    columns |= {f"{topic}position.x": s.y, f"{topic}position.y": s.x, f"{topic}position.z": zero}
    columns |= {f"{topic}orientation.x": zero, f"{topic}orientation.y": zero}
    columns |= {f"{topic}orientation.z": np.sin(yaw / 2).round(6)}
    columns |= {f"{topic}orientation.w": np.cos(yaw / 2).round(6)}
    twist = "field.twist.twist."
    columns |= {f"{twist}linear.x": s.u, f"{twist}linear.y": -s.v}
    columns |= {f"{twist}angular.z": -np.radians(s.rate).round(5)}
    csv(folder, k, columns, "odom")


def moos_alog(folder: Path, k: int, s: Any) -> None:
    lines = [f"%% LOG FILE:   ./boat_{k}.alog", f"%% LOGSTART {START.timestamp():.2f}", ""]
    row: Any
    for row in s.itertuples():
        told = {"NAV_X": row.y, "NAV_Y": row.x, "NAV_HEADING": row.heading, "NAV_SPEED": row.u}
        lines += [f"{row.t:<10.3f} {name:<12} uNav   {value:.3f}" for name, value in told.items()]
        lines += [f"{row.t + 0.01:<10.3f} DESIRED_RUDDER pPID {row.rudder:.1f}"]
        lines += [f"{row.t + 0.01:<10.3f} DESIRED_THRUST pPID {row.rpm / 15.0:.1f}"]
    (folder / f"boat_{k}.alog").write_text("\n".join(lines) + "\n")


def cut(folder: Path, k: int, s: Any) -> None:
    """One recording in two files."""
    part = seen(1)[(k - 1) * 250 : k * 250]
    csv(folder, k, {"time [s]": part.t, **renamed(part, POSE, SPEEDS, ACTS)}, "part_")


def two_files(folder: Path, k: int, s: Any) -> None:
    fix = {"utc_s": START.timestamp() + 3600 * k + s.t, **renamed(s, POSE)}
    csv(folder, k, fix, "gnss_")
    fast = seen(k, 2)
    pulses = {"pwm_motor": (1100 + fast.rpm / 2).round(), "pwm_rudder": 1500 + 14 * fast.rudder}
    millis = (1e3 * fast.t).round().astype(int) + 4_321 * k
    csv(folder, k, {"millis": millis, **{n: v.round() for n, v in pulses.items()}}, "motors_")


def several_rates(folder: Path, k: int, s: Any) -> None:
    fast, columns = seen(k, 5), {"time [s]": seen(k, 5).t.round(3)}
    for name, column in {**POSE, **SPEEDS, **ACTS}.items():
        rows = {"x": 10, "y": 10, "heading": 2, "rpm": 4}.get(name, 1)
        columns[column] = fast[name].where(fast.index % rows == 0)
    csv(folder, k, columns)


def excel(folder: Path, k: int, s: Any) -> None:
    table = pd.DataFrame({"time [s]": s.t, **renamed(s, POSE, SPEEDS, ACTS)})
    table.to_excel(folder / f"run{k}.xlsx", index=False)


def json_lines(folder: Path, k: int, s: Any) -> None:
    rows = [
        {"stamp": row.t, "nav": {"north": row.x, "east": row.y, "heading_deg": row.heading}}
        | {"act": {"rudder_deg": row.rudder, "shaft_rpm": row.rpm}}
        for row in s.itertuples()
    ]
    (folder / f"run{k}.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))


def mat_arrays(folder: Path, k: int, s: Any) -> None:
    import scipy.io

    names = {"t": "t", "x": "north", "y": "east", "heading": "heading_deg", "rudder": "rudder_deg"}
    arrays = {new: s[old].to_numpy()[:, None] for old, new in {**names, "rpm": "rpm"}.items()}
    arrays["t"] = arrays["t"].T
    scipy.io.savemat(folder / f"run{k}.mat", arrays, do_compression=True)


def rows_npy(folder: Path, k: int, s: Any) -> None:
    np.save(folder / f"run{k}.npy", s.to_numpy()[:100])


def bag_topics(folder: Path, k: int, s: Any) -> None:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    pose, number = (
        store.types[f"{n}"] for n in ("geometry_msgs/msg/Pose2D", "std_msgs/msg/Float64")
    )
    with Writer(folder / f"trip_{k}.bag") as bag:
        names = {"/boat/pose": pose, "/boat/rudder_deg": number, "/boat/shaft_rpm": number}
        topics = {
            n: bag.add_connection(n, kind.__msgtype__, typestore=store) for n, kind in names.items()
        }
        for row in s.itertuples():
            stamp = START.value + round(1e9 * row.t)
            yaw = np.pi / 2 - np.radians(row.heading)
            told = {
                "/boat/pose": pose(
                    x=row.y, y=row.x, theta=float((yaw + np.pi) % (2 * np.pi) - np.pi)
                ),
                "/boat/rudder_deg": number(data=row.rudder),
                "/boat/shaft_rpm": number(data=row.rpm),
            }
            for name, message in told.items():
                raw = store.serialize_ros1(message, topics[name].msgtype)
                bag.write(topics[name], stamp, raw)


def course_alone(folder: Path, k: int, s: Any) -> None:
    north, east = np.gradient(s.x, s.t), np.gradient(s.y, s.t)
    columns = {"time [s]": s.t, "north [m]": s.x, "east [m]": s.y}
    columns |= {"course over ground [deg]": (np.degrees(np.arctan2(east, north)) % 360).round(1)}
    columns |= {"speed over ground [m/s]": np.hypot(north, east).round(2)}
    csv(folder, k, {**columns, **renamed(s, ACTS)})


def nothing_known(folder: Path, k: int, s: Any) -> None:
    import scipy.io

    arrays = {"tank": s.u.to_numpy(), "volts": s.v.to_numpy(), "note": "harbour"}
    scipy.io.savemat(folder / f"run{k}.mat", arrays)


def two_boats(folder: Path, k: int, s: Any) -> None:
    """The same quantities of two boats that sailed together."""
    csv(folder, k, {"time [s]": s.t, **renamed(s, POSE, SPEEDS, ACTS)}, "alpha_")
    other = seen(3 - k)
    calls = {"x": "northing (m)", "y": "easting (m)", "heading": "HDG (deg)"}
    csv(folder, k, {"t (s)": other.t, **renamed(other, calls, SPEEDS, ACTS)}, "bravo_")


def savetxt(folder: Path, k: int, s: Any) -> None:
    names = "t[s] north[m] east[m] psi[deg] u[m/s] v[m/s] r[deg/s] rudder[deg] shaft[rpm]"
    rows = s[["t", "x", "y", "heading", "u", "v", "rate", "rudder", "rpm"]].to_numpy()
    np.savetxt(folder / f"run{k}.txt", rows, fmt="%.3f", header=names)


def quotients(folder: Path, k: int, s: Any) -> None:
    """A quantity by its unit, and signs between thousands."""
    columns = {"t / ms": (1e3 * s.t + 3_600_000).map("{:,.0f}".format)}
    columns |= {"N / m": (s.x + 5_990_000).map("{:,.3f}".format), "E / m": s.y}
    columns |= {"psi / deg": s.heading, "r / deg/min": (60.0 * s.rate).round(1)}
    csv(folder, k, {**columns, "RSA / deg": s.rudder, "RPM / 1/min": s.rpm.map("{:,.0f}".format)})


def marks_for_nothing(folder: Path, k: int, s: Any) -> None:
    table = pd.DataFrame({"time [s]": s.t, **renamed(s, POSE, SPEEDS, ACTS)}).astype(object)
    marks: dict[str, tuple[Any, int]] = {
        "north [m]": (-9999.0, 37),
        "surge [m/s]": ("---", 41),
        "yaw rate [deg/s]": ("n/a", 23),
    }
    for column, (mark, every) in marks.items():
        table.loc[5::every, column] = mark
    table.to_csv(folder / f"run{k}.csv", index=False)


def begun_anew(folder: Path, k: int, s: Any) -> None:
    """The names again where the recorder was switched on again, and remarks at the end."""
    table = pd.DataFrame({"time [s]": s.t, **renamed(s, POSE, SPEEDS, ACTS)})
    text = table[:220].to_csv(index=False) + "\n" + table[260:].to_csv(index=False)
    (folder / f"run{k}.csv").write_text(f"{text}\n# battery empty\n")


def plotjuggler(folder: Path, k: int, s: Any) -> None:
    yaw = np.pi / 2 - np.radians(s.heading)
    columns = {"__time": START.timestamp() + s.t}
    columns |= {"/odom/pose/pose/position/x": s.y, "/odom/pose/pose/position/y": s.x}
    columns |= {"/odom/pose/pose/orientation/yaw": ((yaw + np.pi) % (2 * np.pi) - np.pi).round(4)}
    columns |= {"/odom/twist/twist/linear/x": s.u, "/odom/twist/twist/linear/y": -s.v}
    columns |= {"/odom/twist/twist/angular/z": -np.radians(s.rate).round(5)}
    csv(folder, k, {**columns, "/rudder/data": np.radians(s.rudder).round(4), "/rpm/data": s.rpm})


def degrees_and_minutes(degrees: float, width: int) -> str:
    return f"{int(degrees):0{width}d}{60.0 * (degrees % 1.0):09.6f}"


def chart_plotter(folder: Path, k: int, s: Any) -> None:
    at = START + pd.to_timedelta(s.t, "s")
    columns = {"DATE": at.dt.strftime("%d/%m/%Y"), "UTC": at.dt.strftime("%H:%M:%S.%f").str[:-5]}
    columns |= {"LAT(DDMM.MMMM)": [degrees_and_minutes(54.3 + x / 111_315.0, 2) for x in s.x]}
    columns |= {"LON(DDDMM.MMMM)": [degrees_and_minutes(10.15 + y / 65_079.0, 3) for y in s.y]}
    columns |= {"HDG(T)": s.heading, "STW(KT)": (s.u * 3600 / 1852).round(2)}
    columns |= {"ROT(DEG/MIN)": (60.0 * s.rate).round(1), "RUD(S+)": s.rudder, "ENG RPM": s.rpm}
    csv(folder, k, columns)


def voyage_recorder(folder: Path, k: int, s: Any) -> None:
    """Sentences behind a time and the address that they came from."""
    lines = []
    for row in s.itertuples():
        at = START + pd.Timedelta(seconds=row.t)
        place = f"{degrees_and_minutes(54.3 + row.x / 111_315.0, 2)},N"
        place += f",{degrees_and_minutes(10.15 + row.y / 65_079.0, 3)},E"
        for body in (
            f"GPGGA,{at:%H%M%S}.{at.microsecond // 10_000:02d},{place},1,10,0.9,2.0,M,40.0,M,,",
            f"HEHDT,{row.heading:.2f},T",
            f"TIROT,{60.0 * row.rate:.2f},A",
            f"AGRSA,{row.rudder:.1f},A,,V",
            f"ERRPM,S,1,{row.rpm:.0f},100.0,A",
        ):
            check = 0
            for sign in body.encode():
                check ^= sign
            stamp = at.isoformat(timespec="milliseconds")
            lines.append(f"{stamp}Z 192.168.0.10 ${body}*{check:02X}")
    (folder / f"vdr_{k}.txt").write_text("\n".join(lines) + "\n")


def labview(folder: Path, k: int, s: Any) -> None:
    """A table about the columns above theirs, as LabVIEW writes it, and an ending of its own."""
    names = ("North", "East", "Heading", "Surge", "Sway", "Yaw rate", "Rudder", "Shaft")
    units = ("m", "m", "deg", "m/s", "m/s", "deg/s", "deg", "rpm")
    about = [("Channels", "8"), ("Samples", *["500"] * 8), ("Date", *["2025/06/17"] * 8)]
    about += [("Y_Unit_Label", *units), ("X_Dimension", *["Time"] * 8), ("Delta_X", *["0.2"] * 8)]
    lines = ["LabVIEW Measurement\t", "Separator\tTab", "***End_of_Header***\t", "\t"]
    lines += ["\t".join(row) for row in about]
    lines += ["***End_of_Header***\t", "\t".join(("X_Value", *names, "Comment"))]
    rows = s[["t", "x", "y", "heading", "u", "v", "rate", "rudder", "rpm"]].to_numpy()
    lines += ["\t".join(f"{value:.3f}" for value in row) + "\t" for row in rows]
    (folder / f"trial_{k}.lvm").write_text("\n".join(lines) + "\n")


def parquet_index(folder: Path, k: int, s: Any) -> None:
    at = pd.DatetimeIndex(START + pd.to_timedelta(s.t, "s")).tz_localize("UTC")
    table = pd.DataFrame(renamed(s, POSE, SPEEDS, ACTS)).set_index(at)
    table.to_parquet(folder / f"run{k}.parquet")


def ulog_csv(folder: Path, k: int, s: Any) -> None:
    """A folder a recording and a file a topic, in microseconds, as ulog2csv writes them."""
    psi, stamp = np.radians(s.heading), (1e6 * s.t).round().astype("int64") + 12_345_678
    place = {"x": s.x, "y": s.y, "heading": ((psi + np.pi) % (2 * np.pi) - np.pi).round(4)}
    pulses = {"output[0]": (1500 + 14 * s.rudder).round(), "output[1]": (1500 + s.rpm / 3).round()}
    (folder / f"log_{k}").mkdir(exist_ok=True)
    for name, late, topic in (
        ("vehicle_local_position_0", 0, {**place, "xy_valid": np.ones(len(s), dtype=int)}),
        ("actuator_outputs_0", 500, {**pulses, "noutputs": np.full(len(s), 2)}),
    ):
        table = pd.DataFrame({"timestamp": stamp + late, **topic})
        table.to_csv(folder / f"log_{k}" / f"log_{k}_{name}.csv", index=False)


def long_rows(folder: Path, k: int, s: Any) -> None:
    names = {"x": "north_m", "y": "east_m", "heading": "heading_deg", "rudder": "rudder_deg"}
    long = s.rename(columns=names).melt(["t"], [*names.values()], "signal").sort_values("t")
    long.to_csv(folder / f"run{k}.csv", index=False)


def file_a_channel(folder: Path, k: int, s: Any) -> None:
    (folder / f"trial_{k}").mkdir(exist_ok=True)
    for column in ("x", "y", "heading", "rudder"):
        table = pd.DataFrame({"t": s.t, "value": s[column]})
        table.to_csv(folder / f"trial_{k}" / f"{column}.csv", index=False)


def hdf5_trials(folder: Path, k: int, s: Any) -> None:
    """Both trips in one file, a group each."""
    import h5py

    names = {"t": "time", "x": "north", "y": "east", "heading": "heading", "rudder": "rudder"}
    with h5py.File(folder / "campaign.h5", "w") as file:
        for number in COMMANDS:
            for old, new in names.items():
                file.create_dataset(f"trial_{number}/{new}", data=seen(number)[old])


def portuguese(folder: Path, k: int, s: Any) -> None:
    names = {"x": "posição norte (m)", "y": "posição leste (m)", "heading": "rumo (graus)"}
    names |= {"u": "avanço (m/s)", "v": "deriva (m/s)", "rate": "taxa de guinada (graus/s)"}
    names |= {"rudder": "leme (graus)", "rpm": "rotação do hélice (rpm)"}
    table = pd.DataFrame({"tempo (s)": s.t, **renamed(s, names)})
    table.to_csv(folder / f"ensaio{k}.csv", index=False, sep="\t", decimal=",")


def polish(folder: Path, k: int, s: Any) -> None:
    """An older Windows of its own, whose letters are other ones in Western Europe."""
    north, east = (54.3 + s.x / 111_315.0).round(7), (10.15 + s.y / 65_079.0).round(7)
    columns = {"czas [s]": s.t, "szerokość [°]": north, "długość [°]": east, "kurs [°]": s.heading}
    columns |= {"prędkość kątowa [°/s]": s.rate, "ster [°]": s.rudder}
    table = pd.DataFrame({**columns, "obroty śruby [obr/min]": s.rpm})
    form: dict[str, Any] = {"sep": ";", "decimal": ",", "encoding": "cp1250"}
    table.to_csv(folder / f"proba{k}.csv", index=False, **form)


def chinese(folder: Path, k: int, s: Any) -> None:
    names = {"t": "时间(s)", "x": "北向位置(m)", "y": "东向位置(m)", "heading": "艏向角(°)"}
    names |= {"u": "纵向速度(m/s)", "v": "横向速度(m/s)", "rate": "转艏角速度(°/s)"}
    names |= {"rudder": "舵角(°)", "rpm": "螺旋桨转速(rpm)"}
    table = pd.DataFrame(renamed(s, names))
    table.to_csv(folder / f"trip{k}.csv", index=False, encoding="gb18030")


def russian(folder: Path, k: int, s: Any) -> None:
    names = {"t": "время, с", "x": "север, м", "y": "восток, м", "heading": "курс, град"}
    names |= {"rate": "угловая скорость, град/с", "rudder": "руль, град"}
    table = pd.DataFrame(renamed(s, {**names, "rpm": "обороты винта, об/мин"}))
    form: dict[str, Any] = {"sep": ";", "decimal": ",", "encoding": "cp1251"}
    table.to_csv(folder / f"opyt{k}.csv", index=False, **form)


def signal_k(folder: Path, k: int, s: Any) -> None:
    lines = []
    for row in s.itertuples():
        at = (START + pd.Timedelta(seconds=row.t)).isoformat(timespec="milliseconds") + "Z"
        place = {"latitude": 54.3 + row.x / 111_315.0, "longitude": 10.15 + row.y / 65_079.0}
        told: dict[str, object] = {"navigation.position": place}
        told |= {"navigation.headingTrue": float(np.radians(row.heading))}
        told |= {"steering.rudderAngle": float(np.radians(row.rudder))}
        told |= {"propulsion.main.revolutions": row.rpm / 60.0}
        values = [{"path": path, "value": value} for path, value in told.items()]
        update = {"timestamp": at, "source": {"label": "n2k"}, "values": values}
        lines.append(json.dumps({"context": "vessels.self", "updates": [update]}))
    (folder / f"boat{k}.jsonl").write_text("\n".join(lines) + "\n")


def topic_echo(folder: Path, k: int, s: Any) -> None:
    """Messages as `ros2 topic echo` prints them."""
    lines = [
        f"header:\n  stamp:\n    sec: {int(row.t)}\n    nanosec: 0\npose:\n  x: {row.y}\n---"
        for row in s[:50].itertuples()
    ]
    (folder / f"pose{k}.txt").write_text("\n".join(lines) + "\n")


def three_files(folder: Path, k: int, s: Any) -> None:
    """Three recorders with Unix time and rates of their own; the trip stands first in the names."""
    for word, every, columns in (
        ("gps", 10, {"x": "north [m]", "y": "east [m]"}),
        ("compass", 5, {"heading": "heading [deg]"}),
        ("actuators", 8, ACTS),
    ):
        part = seen(k, every)
        table = {"time": START.timestamp() + 3600 * k + part.t, **renamed(part, columns)}
        pd.DataFrame(table).to_csv(folder / f"trip{k}_{word}.csv", index=False)


def lever(folder: Path, k: int, s: Any) -> None:
    """Commands as counts of a lever, 1000 all the way."""
    columns = {"time [s]": s.t, **renamed(s, POSE)}
    columns |= {"steering": (s.rudder / 0.035).round(), "throttle": (s.rpm / 1.5).round()}
    csv(folder, k, columns)


def frames_in_names(folder: Path, k: int, s: Any) -> None:
    columns = {"Time_us": (1e6 * s.t).round().astype("int64"), "NED.N": s.x, "NED.E": s.y}
    columns |= {"NED.D": 0.1 + 0.0 * s.t, "Euler.theta": 0.0 * s.t}
    columns |= {"Euler.psi": np.radians(s.heading).round(4), "Body.u": s.u, "Body.v": s.v}
    columns |= {"Body.r": np.radians(s.rate).round(5)}
    csv(folder, k, {**columns, "Act.delta": np.radians(s.rudder).round(4), "Act.n": s.rpm / 60.0})


def to_port(folder: Path, k: int, s: Any) -> None:
    """What counts to port, told in words alone; headings in gon."""
    columns = {"t [s]": s.t, "x [m]": s.x, "y [m]": s.y, "heading [gon]": s.heading / 0.9}
    columns |= {"surge [m/s]": s.u, "sway to port [m/s]": -s.v}
    columns |= {"yaw rate to port [deg/s]": -s.rate, "rudder to port [deg]": -s.rudder}
    csv(folder, k, {**columns, "shaft [rpm]": s.rpm})


def parts_of_time(folder: Path, k: int, s: Any) -> None:
    at = (START + pd.to_timedelta(s.t, "s")).dt
    columns = {"YYYY": at.year, "MM": at.month, "DD": at.day, "hh": at.hour, "mm": at.minute}
    csv(folder, k, {**columns, "ss": s.t % 60.0, **renamed(s, POSE, ACTS)})


def totals(folder: Path, k: int, s: Any) -> None:
    """Largest and least values below the rows."""
    table = pd.DataFrame({"time [s]": s.t, **renamed(s, POSE, ACTS)})
    text = table[:100].to_csv(index=False) + f"max,{s.x.max()},,,,\nmin,{s.x.min()},,,,\n"
    (folder / f"run{k}.csv").write_text(text)


def minutes_apart(folder: Path, k: int, s: Any) -> None:
    columns: dict[str, object] = {"time [s]": s.t}
    for name, degrees in (("lat", 54.3 + s.x / 111_315.0), ("lon", 10.15 + s.y / 65_079.0)):
        columns |= {f"{name}_deg": degrees // 1, f"{name}_min": (60.0 * (degrees % 1)).round(6)}
    pd.DataFrame({**columns, **renamed(s, ACTS)})[:100].to_csv(folder / f"run{k}.csv", index=False)


def on_change(folder: Path, k: int, s: Any) -> None:
    """Commands in rows of their own, when they change."""
    rows, last = list[dict[str, object]](), None
    for row in s.itertuples():
        rows.append({"t_s": row.t, "kind": "NAV", "x_m": row.x, "y_m": row.y, "hdg": row.heading})
        if last != (row.rudder, row.rpm):
            rows.append({"t_s": row.t + 0.03, "kind": "CMD", "rudder": row.rudder, "rpm": row.rpm})
        last = (row.rudder, row.rpm)
    pd.DataFrame(rows).to_csv(folder / f"run{k}.csv", index=False)


def packed_clock(folder: Path, k: int, s: Any) -> None:
    """Hours, minutes and seconds in one number; beside a compass, the one that is true."""
    at = START + pd.to_timedelta(s.t, "s")
    columns = {"utc": at.dt.strftime("%H%M%S.%f").str[:-4], "easting": s.y, "northing": s.x}
    columns |= {"magnetic heading (deg)": (s.heading - 4.5) % 360.0}
    columns |= {"true heading of the gyro (deg)": s.heading, "rudder_fb": s.rudder}
    csv(folder, k, {**columns, "shaft_rpm": s.rpm})


def side_by_side(folder: Path, k: int, s: Any) -> None:
    """Two boats in one table, each row twice."""
    names = {"x": "x [m]", "y": "y [m]", "heading": "heading [deg]", "rudder": "rudder [deg]"}
    columns: dict[str, object] = {"time [s]": s.t}
    for boat, part in (("boat1", s), ("boat2", seen(3 - k))):
        columns |= {f"{boat}_{new}": part[old] for old, new in {**names, "rpm": "rpm"}.items()}
    table = pd.DataFrame(columns)
    table.loc[table.index.repeat(2)].to_csv(folder / f"race{k}.csv", index=False)


def korean(folder: Path, k: int, s: Any) -> None:
    names = {"t": "시간(s)", "x": "북쪽(m)", "y": "동쪽(m)", "heading": "선수각(deg)"}
    names |= {"rate": "선회율(deg/s)", "rudder": "타각(deg)", "rpm": "프로펠러 회전수(rpm)"}
    table = pd.DataFrame(renamed(s, names))
    table.to_csv(folder / f"run{k}.csv", index=False, encoding="cp949")


def units_in_cells(folder: Path, k: int, s: Any) -> None:
    """Each number with its unit behind it, decimals with a comma; two motors alike by `speed`."""
    cells = {
        "Zeit": [f"{t:.2f} s".replace(".", ",") for t in s.t],
        "Nord": [f"{x:.3f} m".replace(".", ",") for x in s.x],
        "Ost": [f"{y:.3f} m".replace(".", ",") for y in s.y],
        "Kurs": [f"{psi:.2f}°".replace(".", ",") for psi in s.heading],
        "Fahrt voraus": [f"{u * 3600.0 / 1852.0:.3f} kn".replace(".", ",") for u in s.u],
        "Ruder": [f"{delta:.1f} °".replace(".", ",") for delta in s.rudder],
        "port_speed": [f"{n:.0f} rpm" for n in s.rpm],
        "stbd_speed": [f"{n:.0f} rpm" for n in s.rpm],
    }
    pd.DataFrame(cells).to_csv(folder / f"run{k}.csv", index=False, sep=";")


def json_document(folder: Path, k: int, s: Any) -> None:
    """One document: lists by name within an object, beside what the trip is called."""
    names = {"t": "time_s", "x": "north_m", "y": "east_m", "heading": "heading_deg"}
    names |= {"rudder": "rudder_deg", "rpm": "shaft_rpm"}
    table = {new: s[old].round(3).tolist() for old, new in names.items()}
    document = {"vessel": "Alma", "crew": ["Ada", "Bo"], "log": {"version": 2, "data": table}}
    (folder / f"run{k}.json").write_text(json.dumps(document))


LAYOUTS: dict[str, Callable[[Path, int, Any], None]] = {
    layout.__name__: layout
    for layout in (
        *(pandas_index, heading_interpolated, micros_wrap, summer_hour, bridge, rostopic),
        *(moos_alog, cut, two_files, several_rates, excel, json_lines, mat_arrays, rows_npy),
        *(bag_topics, course_alone, nothing_known, two_boats, savetxt, quotients),
        *(marks_for_nothing, begun_anew, plotjuggler, chart_plotter, voyage_recorder, labview),
        *(parquet_index, ulog_csv, long_rows, file_a_channel, hdf5_trials, portuguese, polish),
        *(chinese, russian, signal_k, topic_echo, three_files, lever, frames_in_names, to_port),
        *(parts_of_time, totals, minutes_apart, on_change, packed_clock, side_by_side, korean),
        *(units_in_cells, json_document),
    )
}

if __name__ == "__main__":
    for number in COMMANDS:
        trip(number)[::5].round(6).to_csv(HERE / f"truth_{number}.csv", index=False)
    for name in sys.argv[1:] or (*TABLES, *LAYOUTS):
        (HERE / name).mkdir(exist_ok=True)
        for number in COMMANDS:
            if name in TABLES:
                csv(HERE / name, number, TABLES[name](seen(number)))
            else:
                LAYOUTS[name](HERE / name, number, seen(number))
