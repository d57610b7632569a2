"""Speed and drift angle as the velocities of a table, in layouts of model basins."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import residnet
from residnet.core.log import Log
from residnet.io.drafting.column_names import match_channels
from residnet.io.drafting.questions import CHANNELS_KEY, DraftNotes
from residnet.io.drafting.tables import draft_tables
from residnet.io.header_vocabulary import is_drift_angle
from residnet.io.readers.tables import CsvConfig
from residnet.tasks.drafting import write_new_config
from residnet.tasks.registry import load_task

pytestmark = pytest.mark.usefixtures("omit_currents")

CORPUS = Path(__file__).parents[1] / "corpus"
TRUTH = [pd.read_csv(CORPUS / f"truth_{trip}.csv") for trip in (1, 2)]
SPEED_NAMES = ("V", "U", "Vs", "Speed", "Ship speed", "V_model", "Geschwindigkeit")
DRIFT_NAMES = ("beta", "Drift angle", "BETA", "\u03b2", "Driftwinkel", "Drift", "leeway angle")
KNOT = 1852.0 / 3600.0


def write_layout(folder: Path, seed: int) -> tuple[str, list[dict[str, np.ndarray]]]:
    """Write both trips in a drawn layout, and return it in words and the true u and v."""
    random = np.random.default_rng(seed)
    speed_name = str(random.choice(SPEED_NAMES))
    drift_name = str(random.choice(DRIFT_NAMES))
    is_degrees = bool(random.integers(2))
    is_full_scale = bool(random.integers(2))
    is_reversed = bool(random.integers(2))
    has_track = bool(random.integers(2))
    has_units = bool(random.integers(2)) or (is_full_scale and not has_track)
    is_excel = bool(random.integers(2))
    length_scale = 50.0 if is_full_scale else 1.0
    time_scale = np.sqrt(length_scale)
    speed_unit = KNOT if is_full_scale else 1.0
    truth = []
    for number, trip in enumerate(TRUTH, 1):
        u = trip.u.to_numpy() * time_scale
        v = trip.v.to_numpy() * time_scale
        drift_angle = np.arctan2(-v, u) * (-1.0 if is_reversed else 1.0)
        drift_angle = np.degrees(drift_angle) if is_degrees else drift_angle
        speed_text = " [kn]" if is_full_scale else " [m/s]"
        angle_text = " [deg]" if is_degrees else " [rad]"
        table = {"Time [s]": trip.t * time_scale}
        if has_track:
            table |= {"X [m]": trip.x * length_scale, "Y [m]": trip.y * length_scale}
            table["Heading [deg]"] = np.degrees(trip.psi) % 360.0
        table[speed_name + speed_text * has_units] = np.hypot(u, v) / speed_unit
        table[drift_name + angle_text * has_units] = drift_angle
        table["Yaw rate [deg/s]"] = np.degrees(trip.r) / time_scale
        table |= {"Rudder [deg]": np.degrees(trip.delta), "RPM": trip.n * 60.0 / time_scale}
        path = folder / f"test_{number}"
        if is_excel:
            pd.DataFrame(table).to_excel(path.with_suffix(".xlsx"), index=False)
        else:
            pd.DataFrame(table).to_csv(path.with_suffix(".csv"), index=False)
        truth.append({"u": u, "v": v})
    layout = f"{speed_name}, {drift_name}, {is_degrees=}, {is_full_scale=}, {is_reversed=}"
    return f"{layout}, {has_track=}, {has_units=}, {is_excel=}", truth


# the first five layouts have both values of every choice; other combinations are long tests
@pytest.mark.parametrize(
    "seed", [*range(5), *(pytest.param(seed, marks=pytest.mark.long) for seed in range(5, 10))]
)
def test_speed_and_drift_angle_of_drawn_layouts_become_u_and_v(seed: int, tmp_path: Path) -> None:
    layout, truth = write_layout(tmp_path, seed)
    logs = residnet.read_logs(tmp_path)
    for log, expected in zip(logs, truth, strict=True):
        assert isinstance(log, Log)
        for name, values in expected.items():
            error = np.abs(log[name] - values).max()
            assert error < 0.01 * np.abs(expected["u"]).max(), (layout, name)


def test_a_drafted_config_has_both_columns_with_their_meaning(tmp_path: Path) -> None:
    trip = TRUTH[0]
    speed = np.hypot(trip.u, trip.v)
    beta = np.degrees(np.arctan2(-trip.v, trip.u))
    logs = tmp_path / "logs"
    logs.mkdir()
    for number in range(3):
        rows = slice(number, None)
        table = {"t [s]": trip.t[rows], "U [m/s]": speed[rows], "beta [deg]": beta[rows]}
        table |= {"r [deg/s]": np.degrees(trip.r[rows]), "n [rpm]": 60.0 * trip.n[rows]}
        table["rudder [deg]"] = np.degrees(trip.delta[rows])
        pd.DataFrame(table).to_csv(logs / f"log_{number}.csv", index=False)
    config = tmp_path / "boat.yaml"
    write_new_config([logs], config, None, overwrite=False)
    text = " ".join(config.read_text().replace("#", " ").split())
    assert "'beta [deg]' is positive with the flow from port" in text
    assert "speed: {column: 'U [m/s]', unit: m/s}" in text
    assert "drift_angle: {column: 'beta [deg]', unit: deg}" in text
    load_task(config, []).check()


def draft(table: dict[str, np.ndarray], path: Path) -> tuple[dict[str, dict[str, str]], str]:
    """Return the channel map of a table, and its guesses and notes."""
    pd.DataFrame(table).to_csv(path, index=False)
    notes = DraftNotes()
    reader, errors = draft_tables([path], notes)
    assert not errors
    texts = [text for _, text in notes.guessed_values + notes.notes]
    return reader["channels"], "; ".join(texts)


def test_the_unit_of_a_drift_angle_is_no_unit_of_a_velocity(tmp_path: Path) -> None:
    trip = TRUTH[0]
    table = trip[["t", "x", "y", "psi", "delta"]].copy()
    table["V"] = np.hypot(trip["u"], trip["v"])
    table["beta"] = np.degrees(-np.arctan2(trip["v"], trip["u"]))
    path = tmp_path / "trip.csv"
    table.to_csv(path, index=False)
    notes = DraftNotes()
    draft_tables([path], notes)
    texts = {
        text for key, text in notes.guessed_values + notes.notes if key[-1] in ("drift_angle", "v")
    }
    assert any("deg" in text for text in texts)
    assert not any("m/s" in text for text in texts)


def test_the_symbol_u_next_to_a_drift_angle_is_marked_as_the_speed(tmp_path: Path) -> None:
    trip = TRUTH[0]
    beta = np.degrees(np.arctan2(-trip.v, trip.u))
    speed = {"u [m/s]": np.hypot(trip.u, trip.v), "beta [deg]": beta, "rudder": trip.delta}
    channels, text = draft({"t": trip.t, "r": trip.r} | speed, tmp_path / "no_track.csv")
    assert channels["speed"]["column"] == "u [m/s]"
    assert "'u [m/s]' next to the drift angle 'beta [deg]' is assumed the speed" in text


@pytest.mark.parametrize("kind", ["another clock", "frozen", "another angle"])
def test_an_angle_that_is_not_the_drift_angle_of_the_track_is_left_out(
    kind: str, tmp_path: Path
) -> None:
    trip = TRUTH[0]
    beta = {
        "another clock": 12.0 * np.sin(0.9 * trip.t),
        "frozen": 0.0 * trip.t,
        "another angle": 60.0 * np.sin(trip.t),
    }[kind]
    table = {"t": trip.t, "x [m]": trip.x, "y [m]": trip.y, "psi [deg]": np.degrees(trip.psi)}
    table |= {"V [m/s]": np.hypot(trip.u, trip.v), "beta [deg]": beta, "rudder": trip.delta}
    channels, notes = draft(table, tmp_path / "trip.csv")
    assert not {"speed", "drift_angle", "u", "v"} & channels.keys()
    assert "'V [m/s]' and 'beta [deg]' are left out: as speed and drift angle they" in notes


def test_measured_velocities_take_precedence(tmp_path: Path) -> None:
    columns = ["t", "u [m/s]", "v [m/s]", "beta [deg]", "V [m/s]", "rudder"]
    names = match_channels(columns, DraftNotes())
    assert names["u"] == "u [m/s]"
    assert names["v"] == "v [m/s]"
    assert "speed" not in names


def test_names_of_drift_angles() -> None:
    for name in (*DRIFT_NAMES, "beta_deg", "Drift angle [deg]", "angle de d\u00e9rive", "sideslip"):
        assert is_drift_angle(name), name
    for name in ("drift [m/s]", "drift speed", "beta_motor", "rudder angle", "alphabeta"):
        assert not is_drift_angle(name), name


def test_units_of_the_channels_are_checked() -> None:
    channels = {"speed": {"column": "V", "unit": "deg"}}
    channels["drift_angle"] = {"column": "beta", "unit": "deg"}
    with pytest.raises(ValueError, match="channel speed"):
        CsvConfig.model_validate({"time": {"column": "t"}, "channels": channels})


def test_a_mapped_velocity_is_not_replaced(tmp_path: Path) -> None:
    trip = TRUTH[0]
    table = {"t": trip.t, "u": trip.u, "V": np.hypot(trip.u, trip.v), "beta": -trip.v}
    pd.DataFrame(table).to_csv(tmp_path / "log.csv", index=False)
    entries = {"u": {"column": "u", "unit": "m/s"}, "speed": {"column": "V", "unit": "m/s"}}
    entries["drift_angle"] = {"column": "beta", "unit": "rad"}
    settings = {"time": {"column": "t"}, "channels": entries}
    log = CsvConfig.model_validate(settings).build().read(tmp_path / "log.csv")
    assert set(log.channels) == set(entries)
    del entries["u"]
    log = CsvConfig.model_validate(settings).build().read(tmp_path / "log.csv")
    assert set(log.channels) == {"u", "v"}
    assert log.units["v"] == "m/s"


@pytest.mark.parametrize("kind", ["mat", "h5", "parquet", "json"])
@pytest.mark.parametrize("seed", [31, 32])
def test_recordings_have_the_same_channels_as_tables(kind: str, seed: int, tmp_path: Path) -> None:
    trip = TRUTH[seed % 2]
    random = np.random.default_rng(seed)
    is_reversed = bool(random.integers(2))
    angle = np.arctan2(-trip.v, trip.u) * (-1.0 if is_reversed else 1.0)
    table = {"t": trip.t, "x": trip.x, "y": trip.y, "heading": np.degrees(trip.psi)}
    table |= {str(random.choice(SPEED_NAMES[:3])): np.hypot(trip.u, trip.v)}
    table |= {str(random.choice(DRIFT_NAMES[:3])): np.degrees(angle)}
    table |= {"yaw_rate": np.degrees(trip.r), "rudder": np.degrees(trip.delta)}
    file = tmp_path / f"run.{kind}"
    arrays = {name: np.asarray(values) for name, values in table.items()}
    if kind == "mat":
        savemat(file, {"log": arrays})
    elif kind == "h5":
        with h5py.File(file, "w") as written:
            for name, values in arrays.items():
                written.create_dataset(name.replace("\u03b2", "beta"), data=values)
    elif kind == "parquet":
        pd.DataFrame(arrays).to_parquet(file)
    else:
        pd.DataFrame(arrays).to_json(file, orient="records")
    (log,) = residnet.read_logs(file)
    assert isinstance(log, Log)
    assert not {"speed", "drift_angle"} & log.channels.keys()
    for name in ("u", "v"):
        expected = np.interp(log.t - log.t[0], trip.t - trip.t[0], trip[name])
        assert np.nanmax(np.abs(log[name] - expected)) < 0.01, name


def test_a_drift_angle_alone_is_noted() -> None:
    notes = DraftNotes()
    names = match_channels(["t", "r", "beta [deg]", "rudder"], notes)
    assert "drift_angle" not in names
    assert (
        CHANNELS_KEY,
        "'beta [deg]' is not read: no column is the speed next to this drift angle",
    ) in notes.notes
