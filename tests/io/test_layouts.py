"""Layouts of tables: printed clocks, blank rows, kinds of manoeuvres, problems of many files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import residnet
from residnet.core.errors import ConfigError, DataError, ResidnetError, UsageError
from residnet.core.log import Log
from residnet.core.units import to_si
from residnet.io.drafting.column_names import match_channels
from residnet.io.drafting.problems import (
    UnreadableLogsError,
    group_problems,
    name_files_in_errors,
)
from residnet.io.drafting.questions import DraftNotes
from residnet.io.drafting.tables import draft_manoeuvre_setting, draft_tables
from residnet.io.header_vocabulary import (
    find_earth_velocities,
    match_input_channel,
    match_state_channel,
    parse_header_unit,
    parse_name,
)
from residnet.io.readers.clock_repair import repair_clock
from residnet.io.readers.excel_tables import read_excel_sheet
from residnet.io.readers.manoeuvre_kinds import infer_manoeuvre, match_manoeuvre_name
from residnet.io.readers.tables import CsvConfig


def round_to_digits(t: np.ndarray, digits: int) -> np.ndarray:
    return np.array([float(f"{value:.{digits - 1}e}") for value in t])


@pytest.mark.parametrize(("digits", "step"), [(3, 0.1352), (2, 0.2), (3, 0.02)])
def test_a_printed_clock_follows_from_the_row_number(digits: int, step: float) -> None:
    t = step * np.arange(3000)
    values = np.random.default_rng(0).normal(size=t.size)
    repaired, remarks = repair_clock(round_to_digits(t, digits), [values], 1.0)
    # the first digit decides where the line begins
    np.testing.assert_allclose(np.diff(repaired), step, rtol=2e-3)
    assert np.abs(repaired - t).max() < 0.6 * step + 0.002 * step * t.size
    assert [remark["code"] for remark in remarks] == ["printed_clock"]


def test_an_uneven_clock_is_not_replaced_by_the_row_number() -> None:
    t = np.cumsum(np.random.default_rng(0).uniform(0.02, 0.4, 3000))
    _, remarks = repair_clock(round_to_digits(t, 3), [np.arange(t.size, dtype=float)], 1.0)
    assert "printed_clock" not in {remark["code"] for remark in remarks}


def make_log(delta_deg: np.ndarray, turn_rate_deg: np.ndarray) -> Log:
    t = np.arange(delta_deg.size) * 0.5
    psi = np.radians(np.cumsum(turn_rate_deg) * 0.5)
    channels = {"delta": np.radians(delta_deg), "psi": psi}
    return Log("run", t, channels, dict.fromkeys(channels, "rad"))


def test_manoeuvres_follow_from_rudder_and_heading() -> None:
    approach = np.zeros(40)
    circle = np.r_[approach, np.full(400, 20.0)]
    assert infer_manoeuvre(make_log(circle, 0.2 * circle)) == "turning_circle"
    executes = np.r_[approach, np.tile(np.repeat([20.0, -20.0], 20), 5)]
    assert infer_manoeuvre(make_log(executes, 0.2 * executes)) == "zigzag"
    # a free run has no single rudder angle
    random = np.repeat(np.random.default_rng(0).uniform(-25, 25, 40), 10)
    assert infer_manoeuvre(make_log(random, 0.2 * random)) == ""
    assert infer_manoeuvre(make_log(np.zeros(100), np.zeros(100))) == ""


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("TC_35_S", "turning_circle"), ("Drehkreis_35", "turning_circle"),
        ("ZZ_10-10_P_1", "zigzag"), ("zig-zag20", "zigzag"), ("crash_stop_1", "stopping"),
        ("spiral_2", "spiral"),
        ("returning", ""), ("DISC_TEST2", ""), ("run0", ""),
    ],
)  # fmt: skip
def test_manoeuvres_follow_from_names(name: str, kind: str) -> None:
    assert match_manoeuvre_name(name) == kind


def test_a_problem_of_many_files_is_one_line() -> None:
    paths = [Path(f"logs/run{i}.csv") for i in range(24)]
    messages = {path: f"{path}: line {i} has 3 cells" for i, path in enumerate(paths)}
    messages[paths[3]] = "is empty"
    # an error of the first file that stands for its group
    messages[paths[5]] = messages[paths[0]]
    first, second = group_problems(messages)
    assert first.startswith("logs/run0.csv: line 0 has 3 cells (and 22 other files: run1.csv, ")
    assert second == "logs/run3.csv: is empty"
    error = UnreadableLogsError({path: DataError(text) for path, text in messages.items()})
    assert str(error) == first


def write_rows(path: Path, rows: int, columns: int = 4) -> Path:
    random = np.random.default_rng(len(path.name))
    np.savetxt(path, random.normal(size=(rows, columns)), fmt="%.4f", delimiter=",")
    return path


def test_names_and_step_have_to_fit(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "run.csv", 80)
    channels = {"u": {"column": "u", "unit": "m/s"}}
    time = {"step": "0.1 s"}
    config = {"kind": "csv", "names": ["u", "v", "r", "delta"], "time": time, "channels": channels}
    log = CsvConfig.model_validate(config).build().read(path)
    np.testing.assert_allclose(log.t, 0.1 * np.arange(80), atol=1e-12)
    wrong = CsvConfig.model_validate(config | {"names": ["u", "v"]})
    with pytest.raises(DataError, match=r"run\.csv: no line has 2 numbers"):
        wrong.build().read(path)
    for both_or_none in ({}, {"step": "0.1 s", "column": "t"}):
        with pytest.raises((ConfigError, ValueError), match="give `column`"):
            CsvConfig.model_validate(config | {"time": both_or_none})


@pytest.mark.parametrize(
    ("answers", "message"),
    [
        ({}, "has 4 columns of numbers without names"),
        ({"names": "u, v, r"}, "has 4 columns, and 3 names are given"),
        ({"names": "u, v, r, delta"}, "no column has a name of time"),
        ({"names": "u, v, r, delta", "step": "fast"}, "'fast' is no time; write it as '0.1 s'"),
    ],
)
def test_what_is_missing_is_asked_for_once(
    answers: dict[str, str], message: str, tmp_path: Path
) -> None:
    paths = [write_rows(tmp_path / f"run{i}.csv", 80) for i in range(3)]
    keys = {"names": ("data", "reader", "names"), "step": ("data", "reader", "time", "step")}
    notes = DraftNotes(None, {keys[name]: text for name, text in answers.items()})
    with pytest.raises((DataError, UsageError), match=message) as refused:
        draft_tables(paths, notes)
    assert "\n" not in str(refused.value)


def test_a_selected_vessel_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "ais.csv"
    path.write_text("MMSI,t,u\n" + "".join(f"{7 + i % 2},{i},{i}\n" for i in range(40)))
    config = {
        "kind": "csv",
        "time": {"column": "t"},
        "select": {"MMSI": 8},
        "channels": {"u": {"column": "u", "unit": "kn"}},
    }
    log = CsvConfig.model_validate(config).build().read(path)
    np.testing.assert_allclose(log["u"], to_si("kn") * np.arange(1, 40, 2))
    with pytest.raises(DataError, match=r"no row has 9 in column 'MMSI' \(it has 7, 8\)"):
        CsvConfig.model_validate(config | {"select": {"MMSI": 9}}).build().read(path)


@pytest.mark.parametrize(
    "name",
    [
        "pwm_steer", "steering", "helm", "tiller", "Steuerrad", "Lenkwinkel", "stuurhoek",
        "styring", "gouverne", "volante", "timone", "leme", "kierownica", "штурвал", "румпель",
        "dumen", "舵", "조타", "ohjauskulma", "rattvinkel rorkult",
    ],
)  # fmt: skip
def test_words_for_steering_in_many_languages(name: str) -> None:
    assert match_input_channel(parse_name(name)) == "delta"


def test_words_that_contain_steering() -> None:
    assert match_state_channel(parse_name("Steuerkurs")) == "psi"
    assert match_input_channel(parse_name("Steuerbord Drehzahl")) == "n_stbd"
    assert match_input_channel(parse_name("stuurboord toeren")) == "n_stbd"


def test_forces_by_their_units_and_speed_by_its_letter() -> None:
    forces = match_channels(["x", "y", "psi", "T_u [N]", "F_y [kN]", "M_z [Nm]"], DraftNotes())
    assert {forces[name] for name in ("tau_x", "tau_y", "tau_n")} == {
        "T_u [N]",
        "F_y [kN]",
        "M_z [Nm]",
    }
    acting = match_channels(["acting_tau_x [N]", "tau_x [N]", "psi"], DraftNotes())
    assert acting["tau_x"] == "tau_x [N]"
    assert acting["acting_tau_x"] == "acting_tau_x [N]"
    columns = ["X", "Y", "Heading", "V [m/s]", "Drift angle", "Rudder"]
    speed = match_channels(columns, DraftNotes())
    assert speed["speed"] == "V [m/s]"
    assert speed["drift_angle"] == "Drift angle"


@pytest.mark.parametrize(
    ("arrays", "advice"),
    [
        ({"a": np.arange(50.0), "b": np.arange(50.0)}, "name the vector of times t "),
        ({"t": np.arange(50.0), "b": np.sin(np.arange(50.0))}, "rename the fields, for example"),
    ],
)
def test_advice_on_files_alone_needs_no_config(
    arrays: dict[str, np.ndarray], advice: str, tmp_path: Path
) -> None:
    savemat(tmp_path / "run.mat", arrays)
    with pytest.raises(ResidnetError, match=advice) as refused:
        residnet.read_logs([tmp_path / "run.mat"])
    assert str(refused.value).startswith(f"{tmp_path / 'run.mat'}: ")


STEERING = {
    "English": "steer steering pwm_steer helm tiller rudder_angle steering_wheel",
    "German": "Ruder Ruderlage Lenkung Lenkwinkel Pinne Steuerrad",
    "French": "barre safran gouvernail volante",
    "Spanish": "timón caña pala",
    "Portuguese": "leme cana_do_leme",
    "Italian": "timone barra pala",
    "Dutch": "roer helmstok stuurwiel roerhoek",
    "Norwegian": "ror rorvinkel rorkult ratt",
    "Swedish": "roder rodervinkel styrning",
    "Danish": "ror rorpind",
    "Finnish": "peräsin ruori ohjaus pinna ohjauspyörä",
    "Polish": "ster kąt_steru rumpel płetwa_sterowa kierownica",
    "Russian": "руль угол_руля румпель штурвал",
    "Turkish": "dümen dümen_açısı yeke direksiyon",
    "Japanese": "舵 舵角 操舵",
    "Chinese": "舵角 操舵 方向舵",
    "Korean": "타각 방향타 조타 키각 타륜",
}


@pytest.mark.parametrize("language", STEERING)
def test_steering_in_each_language(language: str) -> None:
    words = [word.replace("_", " ") for word in STEERING[language].split()]
    assert {word: match_input_channel(parse_name(word)) for word in words} == dict.fromkeys(
        words, "delta"
    )


def test_nozzles_and_currents_of_motors_are_no_rudders() -> None:
    for word in ("Düsenwinkel", "azimut", "acimut", "asimut", "tobera", "насадка", "ノズル"):
        assert match_input_channel(parse_name(word)) == "azimuth", word
    assert match_input_channel(parse_name("steering motor current")) is None
    names = {"outboard_angle_deg": "azimuth", "outboard_rpm": "n", "engine throttle": "throttle"}
    assert {name: match_input_channel(parse_name(name)) for name in names} == names


def test_lateral_is_no_latitude_in_a_velocity() -> None:
    names = {"vel_lat": "v", "vel_fwd": "u", "lat": "latitude", "gps_lat_deg": "latitude"}
    names["ATTITUDE.yawspeed"] = "r"
    assert {name: match_state_channel(parse_name(name)) for name in names} == names
    assert find_earth_velocities(["vn_cms", "ve_cms"]) == ("vn_cms", "ve_cms")
    assert parse_header_unit("vn_cms", "m/s") == "cm/s"
    assert parse_header_unit("gz_mrad", "rad/s") == "mrad/s"


def test_folders_of_one_file_each_are_no_manoeuvres(tmp_path: Path) -> None:
    def setting(*names: str) -> dict[str, str]:
        return draft_manoeuvre_setting([tmp_path / name for name in names], DraftNotes())

    assert setting("day_1/gps.csv", "day_2/gps.csv") == {}
    assert setting("zigzag/a.csv", "circle/b.csv") == {"manoeuvre": "folder"}
    assert setting("calm/a.csv", "calm/b.csv", "waves/c.csv") == {"manoeuvre": "folder"}


def test_errors_of_many_files_name_them(tmp_path: Path) -> None:
    paths = [tmp_path / name / "gps.csv" for name in ("day_1", "day_2")]
    assert group_problems(dict.fromkeys(paths, "has no clock"), has_full_paths=False) == [
        "day_1/gps.csv: has no clock (and 1 other file: day_2/gps.csv)"
    ]
    with (
        pytest.raises(
            DataError, match=r"day_1/gps\.csv: no fix \(and 1 other file: day_2/gps\.csv\)"
        ),
        name_files_in_errors(paths),
    ):
        raise DataError("no fix")
    with (
        pytest.raises(DataError, match=r"^[^ ]*day_2/gps\.csv: no fix$"),
        name_files_in_errors(paths),
    ):
        raise DataError(f"{paths[1]}: no fix")


def test_numbers_stored_as_text_in_a_sheet(tmp_path: Path) -> None:
    t = 0.1 * np.arange(50)
    texts = [f"{value:.3f}".replace(".", ",") for value in t]
    table = pd.DataFrame({"t (s)": texts, "Ruder (°)": texts, "note": ["a"] * t.size})
    table.to_excel(path := tmp_path / "log.xlsx", index=False)
    sheet = read_excel_sheet(path, None)
    np.testing.assert_allclose(sheet["t (s)"], t, atol=1e-9)
    assert sheet["Ruder (°)"].dtype == np.float64
    assert sheet["note"].tolist() == ["a"] * t.size


def test_names_of_a_sheet_in_groups_above_units(tmp_path: Path) -> None:
    rows: list[list[object]] = [
        ["Time", "Position", None, "Heading", "Velocity", None],
        [None, "X", "Y", None, "u", "v"],
        ["s", "m", "m", "deg", "m/s", "m/s"],
        *(list[object]((0.1 * k, 1.0 * k, 2.0 * k, 3.0, 1.0, 0.5)) for k in range(20)),
    ]
    pd.DataFrame(rows).to_excel(path := tmp_path / "log.xlsx", index=False, header=False)
    sheet = read_excel_sheet(path, None)
    names = ["Time", "Position X", "Position Y", "Heading", "Velocity u", "Velocity v"]
    assert sheet.columns.tolist() == names
    assert sheet.attrs["unit_rows"] == [["s", "m", "m", "deg", "m/s", "m/s"]]
    assert len(sheet) == 20
    channels = match_channels([*sheet.columns], DraftNotes())
    assert {name: channels[name] for name in ("x", "y", "u", "v")} == {
        "x": "Position X",
        "y": "Position Y",
        "u": "Velocity u",
        "v": "Velocity v",
    }
