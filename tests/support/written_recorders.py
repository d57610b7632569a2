"""The trial as marine electronics and autopilots record it: sentences by hand, binary logs by
struct.
"""

from __future__ import annotations

import datetime
import struct
from functools import reduce
from pathlib import Path

import numpy as np
from pyproj import Transformer
from written_logs import EPOCH

from residnet.core.log import Log

ORIGIN = (63.4411, 10.4198)
BOOT = 100_000_000


def geodetic(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Latitude and longitude in degrees of the trial's points on a tangent plane at ORIGIN, by ECEF
    and back (heights of the plane's points kept).
    """
    back = Transformer.from_pipeline(
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={ORIGIN[0]}"
        f" +lon_0={ORIGIN[1]} +h_0=0 +step +inv +proj=cart +ellps=WGS84"
    )
    longitude, latitude, _ = back.transform(log["y"], log["x"], np.zeros(len(log)), radians=False)
    return np.asarray(latitude), np.asarray(longitude)


def moos(log: Log, folder: Path) -> Path:
    """The pose and the speed of uNav, and a command of pMarinePID at every fifth sample."""
    heading = np.degrees(log["psi"]) % 360.0
    speed = np.hypot(log["u"], log["v"])
    lines = ["%% LOG FILE:   ./trial.alog", f"%% LOGSTART {EPOCH:.2f}", ""]
    for i, t in enumerate(log.t.tolist()):
        told = {"NAV_X": log["y"][i], "NAV_Y": log["x"][i], "NAV_HEADING": heading[i]}
        told["NAV_SPEED"] = speed[i]
        lines += [f"{t:<14.3f} {name:<14} uNav           {v:.9f}" for name, v in told.items()]
        lines += [f"{t:<14.3f} DESIRED_RUDDER pMarinePID     {i % 7:.1f}"] * (i % 5 == 0)
        lines += [f"{t:<14.3f} MODE           pHelmIvP       MODE=DRIVE"] * (i % 9 == 0)
    path = folder / "trial.alog"
    path.write_text("\n".join(lines) + "\n")
    return path


def nmea(log: Log, folder: Path) -> Path:
    """RMC, HDT and ROT, in this order at every sample."""
    latitude, longitude = geodetic(log)
    north, east = _over_ground(log)
    lines = []
    for i, t in enumerate(log.t.tolist()):
        clock = 9 * 3600 + 15 * 60 + 45 + t
        moment = f"{int(clock // 3600):02d}{int(clock // 60 % 60):02d}{clock % 60:05.2f}"
        speed = np.hypot(north[i], east[i]) * 3600 / 1852
        course = np.degrees(np.arctan2(east[i], north[i])) % 360
        fix = f"{_degrees(latitude[i], 2)},N,{_degrees(longitude[i], 3)},E"
        sentences = [
            f"GPRMC,{moment},A,{fix},{speed:.6f},{course:.6f},110425,,,A",
            f"HEHDT,{np.degrees(log['psi'][i]) % 360:.6f},T",
            f"HEROT,{np.degrees(log['r'][i]) * 60:.6f},A",
        ]
        lines += [f"${text}*{reduce(lambda a, b: a ^ b, text.encode()):02X}" for text in sentences]
    path = folder / "trial.nmea"
    path.write_text("\r\n".join(lines) + "\r\n")
    return path


def ulog(log: Log, folder: Path) -> Path:
    """PX4: local position, attitude (the quaternion's sign flipping), angular velocity, and one fix
    that tells UTC.
    """
    formats = {
        "vehicle_local_position": (
            "uint64_t timestamp;float x;float y;float vx;float vy;double exact_x;"
        ),
        "vehicle_attitude": "uint64_t timestamp;double[4] q;",
        "vehicle_angular_velocity": "uint64_t timestamp;double[3] xyz;",
        "vehicle_gps_position": (
            "uint64_t timestamp;uint64_t time_utc_usec;int32_t lat;int32_t lon;"
        ),
    }
    body = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", BOOT) + _message("B", bytes(40))
    body += b"".join(_message("F", f"{name}:{text}".encode()) for name, text in formats.items())
    body += b"".join(
        _message("A", struct.pack("<BH", 0, i) + name.encode()) for i, name in enumerate(formats)
    )
    north, east = _over_ground(log)
    for i, t in enumerate(log.t.tolist()):
        at, psi = BOOT + round(t * 1e6), log["psi"][i]
        sign = -1.0 if i % 7 == 0 else 1.0
        motion = (log["x"][i], log["y"][i], north[i], east[i], log["x"][i])
        rows = [struct.pack("<Qffffd", at, *motion)]
        rows.append(
            struct.pack("<Q4d", at, sign * np.cos(psi / 2), 0.0, 0.0, sign * np.sin(psi / 2))
        )
        rows.append(struct.pack("<Q3d", at, 0.0, 0.0, log["r"][i]))
        rows += [struct.pack("<QQii", at, EPOCH * 10**6, 634411000, 104198000)] if i == 0 else []
        body += b"".join(_message("D", struct.pack("<H", k) + row) for k, row in enumerate(rows))
    path = folder / "trial.ulg"
    path.write_bytes(body)
    return path


def ardupilot(log: Log, folder: Path) -> Path:
    """ArduPilot: filter (XKF1), attitude (ATT), gyro (IMU), and GPS in weeks and milliseconds."""
    formats = [
        (128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89),
        (
            1,
            "GPS",
            "QBIHBcLLeffffB",
            "TimeUS,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
            0,
        ),
        (2, "ATT", "Qff", "TimeUS,Roll,Yaw", 0),
        (3, "IMU", "Qdd", "TimeUS,GyrX,GyrZ", 0),
        (4, "XKF1", "Qdddd", "TimeUS,PN,PE,VN,VE", 0),
    ]
    body = _formats(formats)
    north, east = _over_ground(log)
    # GPS time: weeks since 6 January 1980, 18 leap seconds ahead of UTC
    gps = EPOCH - 315_964_800 + 18
    for i, t in enumerate(log.t.tolist()):
        at, psi = BOOT + round(t * 1e6), log["psi"][i]
        if i % 2 == 0:
            ms = (gps % 604_800) * 1000 + round(t * 1e3)
            speed = float(np.hypot(north[i], east[i]))
            fix = (gps // 604_800, 12, 80, 634411000, 104198000, 0, speed, 0.0, 0.0, 0.0, 1)
            body += b"\xa3\x95\x01" + struct.pack("<QBIHBhiiiffffB", at, 3, ms, *fix)
        body += b"\xa3\x95\x02" + struct.pack("<Qff", at, 0.0, np.degrees(psi) % 360)
        body += b"\xa3\x95\x03" + struct.pack("<Qdd", at, 0.0, log["r"][i])
        body += b"\xa3\x95\x04" + struct.pack(
            "<Qdddd", at, log["x"][i], log["y"][i], north[i], east[i]
        )
    path = folder / "trial.bin"
    path.write_bytes(body)
    return path


def ardupilot_2014(log: Log, folder: Path) -> Path:
    """ArduPilot as of 2014: times in ms, that of a fix at its end; no filter, no latitude scale."""
    formats = [
        (128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89),
        (
            1,
            "GPS",
            "BIHBcLLeeEefI",
            "Status,TimeMS,Week,NSats,HDop,Lat,Lng,RelAlt,Alt,Spd,GCrs,VZ,T",
            45,
        ),
        (2, "ATT", "Iccf", "TimeMS,DesRoll,Roll,Yaw", 15),
        (3, "IMU", "Ifff", "TimeMS,GyrX,GyrY,GyrZ", 19),
    ]
    body = _formats(formats)
    latitude, longitude = geodetic(log)
    gps = EPOCH - 315_964_800 + 18
    for i, t in enumerate(log.t.tolist()):
        at = BOOT // 1000 + round(t * 1e3)
        if i % 2 == 0:
            place = (round(latitude[i] * 1e7), round(longitude[i] * 1e7), 0, 0, 0, 0, 0.0, at)
            ms = (gps % 604_800) * 1000 + round(t * 1e3)
            body += b"\xa3\x95\x01" + struct.pack(
                "<BIHBhiiiiIifI", 3, ms, gps // 604_800, 12, 80, *place
            )
        yaw = float(np.degrees(log["psi"][i]) % 360)
        body += b"\xa3\x95\x02" + struct.pack("<Ihhf", at, 0, 0, yaw)
        body += b"\xa3\x95\x03" + struct.pack("<Ifff", at, 0.0, 0.0, log["r"][i])
    path = folder / "trial.bin"
    path.write_bytes(body)
    return path


def ardurover_246(log: Log, folder: Path) -> Path:
    """ArduRover 2.46 as text: the filter EKF1, steering and throttle of CTUN, pulses of RCOU."""
    north, east = _over_ground(log)
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 150, 13, ATT, IccC, TimeMS,Roll,Pitch,Yaw",
        "FMT, 151, 31, IMU, Iffffff, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ",
        "FMT, 152, 49, EKF1, IccCffffffccc, TimeMS,Roll,Pitch,Yaw,VN,VE,VD,PN,PE,PD,GX,GY,GZ",
        "FMT, 153, 23, RCOU, Ihhhhhhhh, TimeMS,Ch1,Ch2,Ch3,Ch4,Ch5,Ch6,Ch7,Ch8",
        "FMT, 154, 19, CTUN, Ihcchf, TimeMS,Steer,Roll,Pitch,ThrOut,AccY",
    ]
    for i, t in enumerate(log.t.tolist()):
        ms = BOOT // 1000 + round(1000 * t)
        yaw = np.degrees(log["psi"][i]) % 360.0
        steer = np.sin(0.3 * t)
        lines += [
            f"ATT, {ms}, 0.0, 0.0, {yaw:.2f}",
            f"IMU, {ms}, 0.0, 0.0, {log['r'][i]:.6f}, 0.0, 0.0, -9.8",
            f"EKF1, {ms}, 0.0, 0.0, {yaw:.2f}, {north[i]:.4f}, {east[i]:.4f}, 0.0,"
            f" {log['x'][i]:.4f}, {log['y'][i]:.4f}, 0.0, 0.0, 0.0, 0.0",
            f"RCOU, {ms}, {round(1500 + 100 * steer)}, 1500, 1600, 0, 0, 0, 0, 0",
            f"CTUN, {ms}, {round(2000 * steer)}, 0.0, 0.0, {40 + round(9 * np.cos(t))}, 0.0",
        ]
    path = folder / "12.log"
    path.write_text("\n".join(lines) + "\n")
    return path


def _over_ground(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Velocities along north and east."""
    c, s = np.cos(log["psi"]), np.sin(log["psi"])
    return log["u"] * c - log["v"] * s, log["u"] * s + log["v"] * c


def _formats(formats: list[tuple[int, str, str, str, int]]) -> bytes:
    """What tells of the messages of an ArduPilot log: number, name, types, columns and length."""
    size = {"Q": 8, "B": 1, "I": 4, "H": 2, "c": 2, "L": 4, "e": 4, "f": 4, "d": 8}
    return b"".join(
        b"\xa3\x95\x80"
        + struct.pack(
            "<BB4s16s64s",
            number,
            length or 3 + sum(size[kind] for kind in kinds),
            name.encode(),
            kinds.encode(),
            columns.encode(),
        )
        for number, name, kinds, columns, length in formats
    )


def _message(kind: str, content: bytes) -> bytes:
    return struct.pack("<HB", len(content), ord(kind)) + content


def _degrees(angle: float, width: int) -> str:
    """As NMEA writes it: degrees and minutes in one number."""
    whole = int(angle)
    return f"{whole:0{width}d}{(angle - whole) * 60:010.7f}"


def tlog(log: Log, folder: Path) -> Path:
    """A telemetry log of a ground station: fix, attitude and servos of a vehicle (system 1), and
    heartbeats of the station.
    """
    from pymavlink.dialects.v20 import ardupilotmega as mavlink

    vehicle = mavlink.MAVLink(None, srcSystem=1)
    station = mavlink.MAVLink(None, srcSystem=255)
    latitude, longitude = geodetic(log)
    north, east = _over_ground(log)
    rows: list[bytes] = []
    for i, t in enumerate(log.t.tolist()):
        boot_ms = BOOT // 1000 + round(1000 * t)
        heading = float(log["psi"][i] + np.pi) % (2.0 * np.pi) - np.pi
        messages = [
            (
                vehicle,
                mavlink.MAVLink_attitude_message(
                    boot_ms, 0.0, 0.0, heading, 0.0, 0.0, float(log["r"][i])
                ),
            ),
            (
                vehicle,
                mavlink.MAVLink_global_position_int_message(
                    boot_ms,
                    round(1e7 * latitude[i]),
                    round(1e7 * longitude[i]),
                    0,
                    0,
                    round(100.0 * north[i]),
                    round(100.0 * east[i]),
                    0,
                    65535,
                ),
            ),
            (
                vehicle,
                mavlink.MAVLink_servo_output_raw_message(
                    1000 * boot_ms % 2**32,
                    0,
                    *(round(1500 + 100 * log[name][i]) for name in ("cmd_port", "cmd_stbd")),
                    *[0] * 6,
                ),
            ),
            (station, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 0, 3)),
        ]
        # messages arrive 20 to 60 ms late
        arrival = round((EPOCH + t) * 1e6) + 20_000 + 1_000 * (i * 17 % 41)
        for sender, message in messages:
            rows.append(struct.pack(">Q", arrival) + message.pack(sender))
    path = folder / "trial.tlog"
    path.write_bytes(b"".join(rows))
    return path


def nmea2000(
    log: Log, folder: Path, notation: str = "candump3", variation_deg: float = 0.0
) -> Path:
    """NMEA 2000 frames as text: fix, heading, rate of turn, course and speed, rudder, two engines.

    Args:
        log: trial with cmd_port and cmd_stbd, which are written as the revolutions of two engines.
        folder: folder of the file.
        notation: notation of the package nmea2000.
        variation_deg: magnetic variation; with one, heading and course are magnetic.
    """
    from nmea2000 import NMEA2000Field, NMEA2000Message, create_encoder

    encoder = create_encoder(notation)
    latitude, longitude = geodetic(log)
    north, east = _over_ground(log)
    reference = "Magnetic" if variation_deg else "True"
    variation = np.radians(variation_deg)
    start = datetime.datetime.fromtimestamp(EPOCH, tz=datetime.UTC).replace(tzinfo=None)
    lines: list[str] = []
    for i, t in enumerate(log.t.tolist()):
        moment = start + datetime.timedelta(seconds=t)
        course = float(np.arctan2(east[i], north[i]) - variation) % (2.0 * np.pi)
        speed = float(np.hypot(north[i], east[i]))
        heading = float(log["psi"][i] - variation) % (2.0 * np.pi)
        groups = [
            (129025, "positionRapidUpdate", {"latitude": latitude[i], "longitude": longitude[i]}),
            (127250, "vesselHeading", {"heading": heading, "reference": reference}),
            (127251, "rateOfTurn", {"rate": log["r"][i]}),
            (129026, "cogSogRapidUpdate", {"cogReference": reference, "cog": course, "sog": speed}),
            (127245, "rudder", {"instance": 0, "position": 0.1 * np.sin(0.3 * t)}),
        ]
        for side, number in (("port", 0), ("stbd", 1)):
            revolutions = {"instance": number, "speed": 60.0 * abs(log[f"cmd_{side}"][i])}
            groups.append((127488, "engineParametersRapidUpdate", revolutions))
        if i % 10 == 0:
            clock = {"date": moment.date(), "time": moment.time()}
            groups.append((129029, "gnssPositionData", clock))
            if variation_deg:
                groups.append((127258, "magneticVariation", {"variation": variation}))
        for group, name, values in groups:
            fields = [NMEA2000Field(key, value=value) for key, value in values.items()]
            message = NMEA2000Message(
                PGN=group, id=name, fields=fields, source=3, destination=255, priority=2
            )
            message.timestamp = moment
            encoded = encoder.encode(message)
            frames = [encoded] if isinstance(encoded, str) else list(encoded)
            if notation == "n2k_ascii":
                # the package writes no times in this notation
                frames = [f"A{moment:%H%M%S.%f}"[:11] + frame[11:] for frame in frames]
            elif notation == "candump2":
                frames = [f" ({moment.isoformat(sep=' ')})  {frame}" for frame in frames]
            lines += frames
    path = folder / "trial.log"
    path.write_text("\n".join(lines) + "\n")
    return path
