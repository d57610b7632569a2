"""Units and signs of underwater vessels that pitch steeply, from positions, depth and attitude."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.tables import draft_tables

KNOT = 1852.0 / 3600.0
N_ROWS = 1200
STEP = 0.1


def make_steep_dive(seed: int = 0) -> dict[str, np.ndarray]:
    """Return a motion with pitch angles of 60 deg, in NED and SI, by the exact kinematics.

    Angles and body velocities are drawn, and the position is integrated (Fossen 2021, 2.40).
    """
    random = np.random.default_rng(seed)
    t = STEP * np.arange(N_ROWS)

    def draw_wave(amplitude: float, period: float) -> np.ndarray:
        phase = random.uniform(0.0, 2.0 * np.pi)
        return amplitude * np.sin(2.0 * np.pi * t / period + phase)

    angles = {"phi": draw_wave(0.1, 11.0), "theta": draw_wave(1.05, 30.0)}
    angles["psi"] = draw_wave(1.5, 45.0) + 0.02 * t
    rate = {name: np.gradient(values, t) for name, values in angles.items()}
    phi = angles["phi"]
    theta = angles["theta"]
    psi = angles["psi"]
    motion = {"t": t, **angles}
    motion["u"] = 1.5 + draw_wave(0.3, 17.0)
    motion["v"] = draw_wave(0.15, 13.0)
    motion["w"] = draw_wave(0.2, 9.0)
    motion["p"] = rate["phi"] - np.sin(theta) * rate["psi"]
    motion["q"] = np.cos(phi) * rate["theta"] + np.sin(phi) * np.cos(theta) * rate["psi"]
    motion["r"] = -np.sin(phi) * rate["theta"] + np.cos(phi) * np.cos(theta) * rate["psi"]
    ahead = motion["u"] * np.cos(theta)
    ahead += (motion["v"] * np.sin(phi) + motion["w"] * np.cos(phi)) * np.sin(theta)
    across = motion["v"] * np.cos(phi) - motion["w"] * np.sin(phi)
    down = -motion["u"] * np.sin(theta)
    down += (motion["v"] * np.sin(phi) + motion["w"] * np.cos(phi)) * np.cos(theta)
    velocity = {"x": ahead * np.cos(psi) - across * np.sin(psi)}
    velocity |= {"y": ahead * np.sin(psi) + across * np.cos(psi), "z": down}
    for name, values in velocity.items():
        motion[name] = np.cumsum(values) * STEP + (40.0 if name == "z" else 0.0)
        motion[name] += random.normal(0.0, 0.005, N_ROWS)
    return motion


def draft_units(table: dict[str, np.ndarray], path: Path) -> dict[str, tuple[str, int]]:
    """Return unit and sign of each channel that is drafted for a table."""
    pd.DataFrame(table).to_csv(path, index=False)
    reader, errors = draft_tables([path], DraftNotes())
    assert not errors
    channels = reader["channels"].items()
    return {name: (entry["unit"], entry.get("sign", 1)) for name, entry in channels}


@pytest.mark.parametrize("speed_unit", ["m/s", "kn"])
@pytest.mark.parametrize("rate_unit", ["rad/s", "deg/s"])
@pytest.mark.parametrize("has_sway", [True, False])
def test_units_of_a_steep_diver_follow_from_positions_depth_and_angles(
    speed_unit: str, rate_unit: str, has_sway: bool, tmp_path: Path
) -> None:
    motion = make_steep_dive()
    speed_factor = KNOT if speed_unit == "kn" else 1.0
    rate_factor = np.radians(1.0) if rate_unit == "deg/s" else 1.0
    table = {"t": motion["t"], "north": motion["x"], "east": motion["y"], "depth": motion["z"]}
    for column, name in (("roll", "phi"), ("pitch", "theta"), ("yaw", "psi")):
        table[column] = np.degrees(motion[name])
    speeds = ("u", "v", "w") if has_sway else ("u",)
    table |= {name: motion[name] / speed_factor for name in speeds}
    table |= {name: motion[name] / rate_factor for name in ("p", "q", "r")}
    table |= {"rpm": 600.0 + motion["u"], "rudder": 10.0 * motion["r"]}
    units = draft_units(table, tmp_path / "dive.csv")
    for name in speeds:
        assert units[name] == (speed_unit, 1), name
    for name in ("p", "q", "r"):
        assert units[name] == (rate_unit, 1), name


@pytest.mark.parametrize("speed_unit", ["m/s", "kn"])
@pytest.mark.parametrize("rate_unit", ["rad/s", "deg/s"])
def test_units_of_a_steep_diver_in_axes_of_ros(
    speed_unit: str, rate_unit: str, tmp_path: Path
) -> None:
    motion = make_steep_dive(1)
    speed_factor = KNOT if speed_unit == "kn" else 1.0
    rate_factor = np.radians(1.0) if rate_unit == "deg/s" else 1.0
    half = [0.5 * motion["phi"], -0.5 * motion["theta"], 0.5 * (0.5 * np.pi - motion["psi"])]
    c1, c2, c3 = np.cos(half)
    s1, s2, s3 = np.sin(half)
    table = {"time": 1.7e9 + motion["t"], "position_x": motion["y"], "position_y": motion["x"]}
    table |= {"position_z": -motion["z"], "orientation_x": s1 * c2 * c3 - c1 * s2 * s3}
    table |= {"orientation_y": c1 * s2 * c3 + s1 * c2 * s3}
    table |= {"orientation_z": c1 * c2 * s3 - s1 * s2 * c3}
    table |= {"orientation_w": c1 * c2 * c3 + s1 * s2 * s3}
    table |= {"linear_x": motion["u"] / speed_factor, "linear_y": -motion["v"] / speed_factor}
    table |= {"linear_z": -motion["w"] / speed_factor, "angular_x": motion["p"] / rate_factor}
    table |= {"angular_y": -motion["q"] / rate_factor, "angular_z": -motion["r"] / rate_factor}
    table |= {f"thruster_{k}": np.sin(motion["t"] / (k + 2.0)) for k in range(8)}
    # an empty message
    for axis in "xyzw":
        table[f"orientation_{axis}"][20] = 0.0
    units = draft_units(table, tmp_path / "dive.csv")
    for name, sign in (("u", 1), ("v", -1), ("w", -1)):
        assert units[name] == (speed_unit, sign), name
    for name, sign in (("p", 1), ("q", -1), ("r", -1)):
        assert units[name] == (rate_unit, sign), name
    assert {f"throttle_{k}" for k in range(8)} <= units.keys()


def test_pitch_of_one_degree_without_unit_has_the_unit_of_the_heading(tmp_path: Path) -> None:
    motion = make_steep_dive()
    small = 1.2 * np.sin(motion["t"])
    table = {"t": motion["t"], "north": motion["x"], "east": motion["y"], "depth": motion["z"]}
    table |= {"roll": small, "pitch": small, "yaw": np.degrees(motion["psi"])}
    speed = np.hypot(np.gradient(motion["x"], STEP), np.gradient(motion["y"], STEP))
    table |= {"u": np.convolve(speed, np.ones(11) / 11.0, "same"), "rudder": motion["r"]}
    assert draft_units(table, tmp_path / "dive.csv")["u"] == ("m/s", 1)
