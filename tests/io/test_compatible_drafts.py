"""Drafts whose columns have another meaning than their names say: frames and speeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from simulated_motion import BOATS, TrueMotion, simulate_motion

from residnet.core.config import validate_config
from residnet.core.errors import ConfigError, DataError
from residnet.io.drafting.named_fields import find_named_table
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.reading import DraftResult, read_drafted
from residnet.io.drafting.tables import draft_tables
from residnet.io.readers import ReaderConfig
from residnet.io.readers.recording import Recording, Series
from residnet.quality import inspect_log

TIMES = np.arange(0.0, 79.0, 0.2)


def write_run(
    path: Path, motion: TrueMotion, rng: np.random.Generator, velocities: dict[str, np.ndarray]
) -> Path:
    """Write a table with position, heading, yaw rate and further columns."""
    pose = {
        "x [m]": motion.sample("x", TIMES) + rng.normal(0.0, 0.03, TIMES.size),
        "y [m]": motion.sample("y", TIMES) + rng.normal(0.0, 0.03, TIMES.size),
        "psi [deg]": np.degrees(motion.sample("psi", TIMES)),
        "r [deg/s]": np.degrees(motion.sample("r", TIMES)),
    }
    noisy = {name: v + rng.normal(0.0, 0.01, v.size) for name, v in velocities.items()}
    pd.DataFrame({"t [s]": TIMES, **pose, **noisy}).to_csv(path, index=False)
    return path


def compute_velocities(motion: TrueMotion) -> dict[str, np.ndarray]:
    """Return the velocities in body axes, in earth axes, and the speed and drift angle."""
    u, v, psi = (motion.sample(name, TIMES) for name in ("u", "v", "psi"))
    earth = (u + 1j * v) * np.exp(1j * psi)
    return {
        "u": u,
        "v": v,
        "north": earth.real,
        "east": earth.imag,
        "speed": np.hypot(u, v),
        "drift": -np.degrees(np.arctan2(v, u)),
    }


def draft(folder: Path, columns: dict[str, str], **draft_options: object) -> DraftResult:
    """Draft and read two runs with some velocities under other names."""
    folder.mkdir(exist_ok=True)
    paths = []
    for seed in (1, 2):
        rng = np.random.default_rng(seed)
        motion = simulate_motion(BOATS["catamaran"], rng, duration=80.0)
        velocities = compute_velocities(motion)
        renamed = {name: velocities[quantity] for name, quantity in columns.items()}
        paths.append(write_run(folder / f"run{seed}.csv", motion, rng, renamed))
    return read_drafted(paths, DraftNotes(**draft_options))  # type: ignore[arg-type]


def true_motion(seed: int) -> TrueMotion:
    return simulate_motion(BOATS["catamaran"], np.random.default_rng(seed), duration=80.0)


@pytest.mark.parametrize(
    "columns",
    [
        {"u [m/s]": "north", "v [m/s]": "east"},
        {"u [m/s]": "east", "v [m/s]": "north"},
        {"vx [m/s]": "north", "vy [m/s]": "east"},
        {"vel_n": "north", "vel_e": "east"},
    ],
)
def test_earth_fixed_velocities_are_rotated(tmp_path: Path, columns: dict[str, str]) -> None:
    result = draft(tmp_path / "earth", columns)
    channels = result.reader["channels"]
    assert channels["u"]["frame"] == channels["v"]["frame"] == "ned"
    assert columns[channels["u"]["column"]] == "north"
    for seed, log in enumerate(result.logs.values(), 1):
        motion = true_motion(seed)
        for name in ("u", "v"):
            errors = log[name] - motion.sample(name, TIMES)
            assert float(np.sqrt(np.mean(errors**2))) < 0.03
    notes = (*result.draft_notes.guessed_values, *result.draft_notes.notes)
    reasons = [text for _, text in notes]
    assert any("earth axes" in text and "alternatives: velocities in" in text for text in reasons)


def test_body_velocities_stay(tmp_path: Path) -> None:
    result = draft(tmp_path / "body", {"u [m/s]": "u", "v [m/s]": "v"})
    assert "frame" not in result.reader["channels"]["u"]
    log = next(iter(result.logs.values()))
    assert log["v"] == pytest.approx(true_motion(1).sample("v", TIMES), abs=0.06)


def test_speed_beside_a_drift_angle_is_no_sway(tmp_path: Path) -> None:
    result = draft(tmp_path / "speed", {"V [m/s]": "speed", "Drift angle [deg]": "drift"})
    assert "v" not in result.reader["channels"]
    result = draft(tmp_path / "alone", {"v [m/s]": "speed"})
    assert "v" not in result.reader["channels"]
    assert any("v is the speed" in text for _, text in result.draft_notes.notes)
    named = draft(tmp_path / "sway", {"v [m/s]": "v"})
    assert named.reader["channels"]["v"]["column"] == "v [m/s]"


def test_velocities_of_another_run_stop_the_draft(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    motion = simulate_motion(BOATS["catamaran"], rng, duration=80.0)
    other = compute_velocities(
        simulate_motion(BOATS["catamaran"], np.random.default_rng(9), duration=80.0)
    )
    turned = {"u [m/s]": other["north"], "v [m/s]": other["east"]}
    path = write_run(tmp_path / "run.csv", motion, rng, turned)
    with pytest.raises(DataError, match=r"integrated, differ from the positions by \d+ %"):
        read_drafted([path], DraftNotes())


def test_a_late_heading_changes_no_unit_of_sway(tmp_path: Path) -> None:
    motion = true_motion(1)
    table = {name: motion.sample(name, TIMES) for name in ("x", "y", "u", "v", "r")}
    columns = {"x [m]": table["x"], "y [m]": table["y"], "surge": table["u"], "sway": table["v"]}
    columns |= {"psi [rad]": motion.sample("psi", TIMES - 0.7), "r [rad/s]": table["r"]}
    pd.DataFrame({"t [s]": TIMES, **columns}).to_csv(path := tmp_path / "run.csv", index=False)
    result = read_drafted([path], DraftNotes())
    assert result.reader["channels"]["v"] == {"column": "sway", "unit": "m/s"}
    log = next(iter(result.logs.values()))
    codes = {f.code for f in inspect_log(log).findings if f.level == "will mislead"}
    assert "lag_psi" in codes


@pytest.mark.parametrize("is_dead", [True, False])
def test_a_gyro_of_noise_is_left_out_and_a_late_one_is_not(
    tmp_path: Path, *, is_dead: bool
) -> None:
    motion = true_motion(1)
    table = {f"{name} [m]": motion.sample(name, TIMES) for name in ("x", "y")}
    noise = 0.006 + 0.02 * np.std(motion.r) * np.random.default_rng(1).normal(size=TIMES.size)
    table["yaw_rate"] = noise + (0.0 if is_dead else motion.sample("r", TIMES - 4.0))
    table["psi [deg]"] = np.degrees(motion.sample("psi", TIMES)) % 360.0
    pd.DataFrame({"t [s]": TIMES, **table}).to_csv(path := tmp_path / "run.csv", index=False)
    assert ("r" in read_drafted([path], DraftNotes()).reader["channels"]) != is_dead


@pytest.mark.parametrize("names", [("north", "east"), ("x", "y")])
def test_a_heading_positive_to_port(tmp_path: Path, names: tuple[str, str]) -> None:
    motion = true_motion(1)
    table = {f"{n} [m]": motion.sample(c, TIMES) for n, c in zip(names, "xy", strict=True)}
    table |= {f"{name} [rad/s]": -motion.sample(name, TIMES) for name in "r"}
    table["yaw [deg]"] = -np.degrees(motion.sample("psi", TIMES)) % 360.0
    pd.DataFrame({"t [s]": TIMES, **table}).to_csv(path := tmp_path / "run.csv", index=False)
    channels = read_drafted([path], DraftNotes()).reader["channels"]
    assert channels["psi"] == {"column": "yaw [deg]", "unit": "deg", "sign": -1}
    assert channels["r"]["sign"] == -1


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_receiver_at_the_bow_changes_no_unit_or_sign_of_sway(tmp_path: Path, sign: float) -> None:
    paths = []
    for seed in (1, 2):
        motion = true_motion(seed)
        table = {name: motion.sample(name, TIMES) for name in ("x", "y", "psi", "u", "v", "r")}
        # the sway velocity of the receiver is opposite to that of the vessel's centre
        table["x"] += 12.0 * np.cos(table["psi"])
        table["y"] += 12.0 * np.sin(table["psi"])
        table["v"] *= sign
        headers = {"x": "m", "y": "m", "psi": "rad", "u": "m/s", "v": "m/s", "r": "rad/s"}
        columns = {f"{name} [{unit}]": table[name] for name, unit in headers.items()}
        paths.append(tmp_path / f"run{seed}.csv")
        pd.DataFrame({"t [s]": TIMES, **columns}).to_csv(paths[-1], index=False)
        receiver_sway = motion.sample("v", TIMES) + 12.0 * table["r"]
        assert np.corrcoef(receiver_sway, motion.sample("v", TIMES))[0, 1] < -0.5
    result = read_drafted(paths, DraftNotes())
    expected = {"column": "v [m/s]", "unit": "m/s"} | ({"sign": -1} if sign < 0.0 else {})
    assert result.reader["channels"]["v"] == expected
    log = next(iter(result.logs.values()))
    (frames,) = inspect_log(log).find_by_code("frames")
    assert frames.level == "note"
    # a reversed v without a lever arm is still named
    centre = {axis: true_motion(1).sample(axis, TIMES) for axis in ("x", "y")}
    reversed_sway = log.replace(channels={**log.channels, **centre, "v": -log["v"]})
    (frames,) = inspect_log(reversed_sway).find_by_code("frames")
    assert frames.level == "will mislead"
    assert "v positive to port" in frames.text


def test_positions_named_enu_are_east_and_north(tmp_path: Path) -> None:
    motion = true_motion(1)
    table = {"t": TIMES, "pos_enu/x": motion.sample("y", TIMES)}
    table |= {
        "pos_enu/y": motion.sample("x", TIMES),
        "yaw": 0.5 * np.pi - motion.sample("psi", TIMES),
    }
    path = tmp_path / "run.csv"
    pd.DataFrame(table).to_csv(path, index=False)
    channels = draft_tables([path], DraftNotes())[0]["channels"]
    assert channels["x"]["column"] == "pos_enu/y"
    assert channels["psi"] == {"column": "yaw", "unit": "rad", "frame": "enu"}


def test_a_reset_of_the_position_is_no_contradiction(tmp_path: Path) -> None:
    motion = true_motion(1)
    velocities = compute_velocities(motion)
    table = {name: motion.sample(name, TIMES) for name in ("x", "y", "psi", "r")}
    after = np.flatnonzero(TIMES > 40.0)
    for name in ("x", "y"):
        table[name][after] -= table[name][after[0]] + 60.0
    table |= {"t": TIMES, "u": velocities["u"], "v": velocities["v"]}
    path = tmp_path / "run.csv"
    pd.DataFrame(table).to_csv(path, index=False)
    (log,) = read_drafted([path], DraftNotes()).logs.values()
    found = {finding.code: finding for finding in inspect_log(log).findings}
    assert found["position_jump"].level == "will mislead"
    assert found["position_jump"].figures["t"] == pytest.approx(TIMES[after[0]], abs=0.01)
    # the frames of both parts are right
    assert found["frames"].level == "note"


def test_velocities_along_north_and_east_need_a_heading(tmp_path: Path) -> None:
    motion = true_motion(1)
    velocities = compute_velocities(motion)
    table = {"t [s]": TIMES, "nav.vel.n": velocities["north"], "nav.vel.e": velocities["east"]}
    table["rudder [deg]"] = 10.0 * np.sin(TIMES)
    heading = {"heading [deg]": np.degrees(motion.sample("psi", TIMES))}
    drafts = []
    for name, columns in (("with", {**table, **heading}), ("without", table)):
        path = tmp_path / f"{name}.csv"
        pd.DataFrame(columns).to_csv(path, index=False)
        drafts.append(draft_tables([path], DraftNotes())[0]["channels"])
    assert drafts[0]["u"] == {"column": "nav.vel.n", "frame": "ned", "unit": "m/s"}
    assert drafts[0]["v"]["column"] == "nav.vel.e"
    assert set(drafts[1]) == {"delta"}


def test_earth_velocities_need_both_columns_and_a_heading() -> None:
    entry = {"column": "u", "unit": "m/s", "frame": "ned"}
    settings = {"kind": "csv", "time": {"column": "t"}, "channels": {"u": entry}}
    with pytest.raises(ConfigError, match=r"both u .north. and v .east."):
        validate_config(settings, ReaderConfig, "draft")


@pytest.mark.parametrize("has_velocities", [True, False])
def test_magnetic_heading_gets_the_offset_of_the_motion(
    tmp_path: Path, has_velocities: bool
) -> None:
    rng = np.random.default_rng(4)
    motion = simulate_motion(BOATS["catamaran"], rng, duration=80.0)
    velocities = {"u [m/s]": motion.sample("u", TIMES), "v [m/s]": motion.sample("v", TIMES)}
    path = write_run(tmp_path / "run.csv", motion, rng, velocities if has_velocities else {})
    table = pd.read_csv(path)
    table = table.rename(columns={"psi [deg]": "Heading magnetic [deg]"})
    table["Heading magnetic [deg]"] -= 12.4
    table.to_csv(path, index=False)
    result = read_drafted([path], DraftNotes())
    offset = result.reader["channels"]["psi"]["offset"]
    assert offset == pytest.approx(-12.4, abs=0.5 if has_velocities else 3.0)
    (log,) = result.logs.values()
    errors = np.degrees(log["psi"] - motion.sample("psi", TIMES))
    assert float(np.abs((errors + 180.0) % 360.0 - 180.0).max()) < 3.5
    reasons = [text for _, text in result.draft_notes.guessed_values]
    source = "velocities against positions" if has_velocities else "mean drift angle is zero"
    assert any(source in reason for reason in reasons)


def test_earth_fixed_velocities_of_a_matlab_struct(tmp_path: Path) -> None:
    motion = true_motion(1)
    velocities = compute_velocities(motion)
    columns = {name: motion.sample(name, TIMES) for name in ("x", "y", "psi", "r")}
    columns |= {"u": velocities["north"], "v": velocities["east"], "time": TIMES}
    zeros = np.zeros(TIMES.size)
    matrices = {
        "time": TIMES,
        "pos": np.stack((columns["x"], columns["y"], zeros), axis=1),
        "vel": np.stack((columns["u"], columns["v"], zeros), axis=1),
        "rpy": np.degrees(np.stack((zeros, zeros, columns["psi"]), axis=1)),
        "pqr": np.stack((zeros, zeros, columns["r"]), axis=1),
    }
    for name, run in (("columns", columns), ("matrices", matrices)):
        path = tmp_path / f"{name}.mat"
        scipy.io.savemat(path, {"run": run})
        result = read_drafted([path], DraftNotes())
        assert result.reader["velocity"]["kind"] == "earth_fixed"
        (log,) = result.logs.values()
        for channel in ("v", "r"):
            errors = log[channel] - np.interp(log.t, TIMES, motion.sample(channel, TIMES))
            assert float(np.nanmax(np.abs(errors))) < 0.1


def test_messages_of_an_unknown_type_are_mapped_by_their_fields() -> None:
    motion = true_motion(1)
    fields = {name: motion.sample(name, TIMES) for name in ("x", "y", "psi", "u", "v", "r")}
    series = Series("/boat/state", "usv_msgs/msg/State", fields, stamp=TIMES)
    target = Series("/boat/setpoint", "usv_msgs/msg/State", fields, stamp=TIMES)
    pose = {name: fields[name] for name in ("x", "y", "psi")}
    fix = Series("/boat/fix", "usv_msgs/msg/Fix", pose, stamp=TIMES)
    recording = Recording(Path("run.mcap"), {item.name: item for item in (fix, series, target)})
    assert find_named_table([recording], DraftNotes(), needs_pose=False) is None
    sources = find_named_table([recording], DraftNotes(), needs_pose=True)
    assert sources is not None
    assert sources.settings["position"]["topic"] == "/boat/state"
    assert {*sources.settings["channels"]} == {"u", "v", "r"}
