"""`residnet new`: a config from logs alone that `check` takes, its guesses marked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import foreign_tables
import numpy as np
import pytest
import scipy.io
import written_logs
import written_recorders
import yaml
from foreign_tables import Style
from kinds import of_kind
from scipy.integrate import cumulative_trapezoid

import residnet
from residnet.core.config import validate_config
from residnet.core.errors import DataError, UsageError
from residnet.core.log import Log
from residnet.identification.prepared import prepare_splits
from residnet.identification.recipe import choose_window_length, make_evaluation_settings
from residnet.io.readers import ReaderConfig
from residnet.io.sources import read_split_logs
from residnet.io.split import split_logs
from residnet.tasks.drafting import write_new_config
from residnet.tasks.fit.config import FitConfig
from residnet.tasks.registry import load_task

pytestmark = pytest.mark.usefixtures("omit_currents")


@pytest.fixture(scope="module")
def logs() -> list[Log]:
    """Zigzags of a ship: six, of three heading angles."""
    trials = [
        {"kind": "zigzag", "drive": drive, "steer": 0.5, "heading": angle, "start": 3}
        for drive in (0.6, 0.9)
        for angle in ("10 deg", "20 deg", "30 deg")
    ]
    flown = residnet.simulate("example_rudder_boat", trials, duration=60.0, step=0.1, seed=4)
    return list(flown.logs)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, logs: list[Log]) -> Path:
    folder = tmp_path_factory.mktemp("drafts")
    units = {"psi": "deg", "u": "kn", "v": "kn", "r": "°/min"}
    foreign_tables.write(logs, folder / "trials", Style(told=False, units=units, signs=("delta",)))
    return folder


def lasting(seconds: float) -> Log:
    t = np.arange(0.0, seconds + 0.5, 1.0)
    return Log("made", t, {name: np.sin(t) for name in ("u", "v", "r")})


def test_free_runs_are_no_longer_than_most_logs() -> None:
    for lengths, expected in (
        ([180.0], 100.0),
        ([95.0, 95.0, 200.0], 60.0),
        ([30.0], 20.0),
        ([], 0.5),
    ):
        assert choose_window_length(lengths, 20.0) == expected


def test_the_length_of_the_test_logs_enters_no_choice() -> None:
    lengths = {"train": [180.0] * 3, "validation": [180.0]}
    splits = {name: [lasting(s) for s in each] for name, each in {**lengths, "test": []}.items()}
    long, short = (
        make_evaluation_settings(splits, {**lengths, "test": [s]}, 20.0) for s in (180.0, 15.0)
    )
    assert long["selection"] == short["selection"] == "T100"
    assert long["scales"] == short["scales"]
    assert list(long["protocols"]) == list(short["protocols"])[:2] == ["T100", "T40"]
    assert min(float(one["length"].split()[0]) for one in short["protocols"].values()) < 13.0


# 4 s; test_the_length_of_the_test_logs_enters_no_choice covers the lengths
@pytest.mark.long
def test_free_runs_are_as_short_as_gaps_ask_for(tmp_path: Path, logs: list[Log]) -> None:
    random = np.random.default_rng(1)
    (log, *_) = logs
    holes = {
        name: np.where(random.random(len(log)) < 0.5, np.nan, values)
        for name, values in log.channels.items()
    }
    log.replace(channels=holes).save(tmp_path / "holes.parquet")
    out = tmp_path / "holes.yaml"
    write_new_config([tmp_path / "holes.parquet"], out, None, overwrite=False)
    task = of_kind(load_task(out), FitConfig)
    # refuses a log that holds no window
    assert all(prepare_splits(read_split_logs(task.data), task).values())


def test_a_config_from_logs_alone(folder: Path) -> None:
    out = folder / "boat.yaml"
    lines = write_new_config([folder / "trials"], out, None, overwrite=False)
    assert lines[-1] == f"next: residnet run {out}"
    load_task(out).check()
    text = out.read_text()
    content = yaml.safe_load(text)
    channels = content["data"]["reader"]["channels"]
    assert (channels["r"]["unit"], channels["u"]["unit"]) == ("deg/min", "kn")
    assert channels["delta"]["sign"] == -1
    assert content["signals"]["inputs"] == ["delta", "n"]
    assert content["recipe"] == "standard"
    assert not {"baseline", "baselines", "heads", "training", "effort"} & set(content)
    assert [len(content["data"]["split"][name]) for name in ("train", "test")] == [4, 1]
    # whatever was guessed stands above its key
    for line in ("r: {column: yaw rate", "delta: {column: rudder", "time: {column: time"):
        above = text[: text.index(line)].rstrip().splitlines()[-1]
        assert above.strip().startswith("#"), line
    # the same from Python
    draft = residnet.draft_config(folder / "trials", name="boat", folder=folder)
    assert draft.config == content
    assert "data.split" in dict(draft.guesses)
    for file, said in (("boat.yaml", "exists; give --overwrite"), ("a.txt", r"name it .*a\.txt\.")):
        with pytest.raises(UsageError, match=said):
            write_new_config([folder / "trials"], folder / file, None, overwrite=False)


def test_an_input_that_the_training_logs_hold_is_unexcited(logs: list[Log], tmp_path: Path) -> None:
    training = {log.name for log in split_logs(logs)["train"]}
    for log in logs:
        revolutions = np.where((log.name in training) | (log.t < 30.0), 5.0, 8.0)
        log.replace(channels={**log.channels, "n": revolutions}).save(
            tmp_path / f"{log.name}.parquet"
        )
    draft = residnet.draft_config(tmp_path, folder=tmp_path)
    assert draft.config["signals"]["inputs"] == ["delta"]
    assert draft.config["signals"]["unexcited"] == ["n"]
    assert "n is constant at 5 in the training logs" in draft.text


# 4 s; test_a_config_from_logs_alone drafts a split, too
@pytest.mark.long
def test_one_log_is_cut_in_time(folder: Path) -> None:
    only = sorted((folder / "trials").glob("*.csv"))[0]
    draft = residnet.draft_config(only, folder=folder)
    assert draft.config["data"]["split"]["test"] == [{"log": only.name, "from": "47.9 s"}]
    assert any("cut in time" in why for _, why in draft.guesses)
    out = folder / "Fähre Süd.yaml"
    assert write_new_config([only], out, None, overwrite=False)[-1] == f"next: residnet run '{out}'"
    assert yaml.safe_load(out.read_text())["name"] == "Fahre_Sud"


def test_answers_are_taken(logs: list[Log], tmp_path: Path) -> None:
    for file in foreign_tables.write(logs, tmp_path, Style(units={"r": "°/min"})):
        file.write_text(file.read_text().replace("[°/min]", "[deg/s]"))
    draft = residnet.draft_config(tmp_path, folder=tmp_path, answer=lambda asked: asked.options[-1])
    assert draft.config["data"]["reader"]["channels"]["r"]["unit"] == "deg/s"
    assert "answered 'deg/s' instead of 'deg/min'" in draft.text


def test_what_cannot_be_drafted(logs: list[Log], tmp_path: Path) -> None:
    foreign_tables.write(logs, tmp_path / "lost", Style(left_out=("psi",)))
    (tmp_path / "empty").mkdir()
    for name, said in (
        ("nowhere", "no such file or folder"),
        ("empty", "has no log of a known format"),
        ("lost", "no channel psi"),
    ):
        with pytest.raises((UsageError, DataError), match=said):
            residnet.draft_config(tmp_path / name)
    still = [log.replace(channels={**log.channels, "n": np.full(len(log), 3.0)}) for log in logs]
    foreign_tables.write(still, tmp_path / "still", Style(left_out=("delta",)))
    draft = residnet.draft_config(tmp_path / "still", folder=tmp_path)
    assert draft.config["signals"]["inputs"] == []
    assert "no channel of the logs is a rudder" in dict(draft.guesses)["signals.inputs"]


WRITERS: dict[str, Callable[[Log, Path], Path]] = {
    "csv": written_logs.csv,
    "mat5": written_logs.mat5,
    "mcap": written_logs.mcap,
    "bag2": written_logs.bag2,
    "nmea": written_recorders.nmea,
    "ulog": written_recorders.ulog,
}


def along_its_velocities(log: Log) -> Log:
    """Return the log with positions that are the integral of its velocities."""
    velocity = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"])
    positions = {
        "x": cumulative_trapezoid(velocity.real, log.t, initial=0),
        "y": cumulative_trapezoid(velocity.imag, log.t, initial=0),
    }
    return log.replace(channels={**log.channels, **positions})


@pytest.mark.parametrize("write", WRITERS)
def test_logs_of_a_simulated_boat_as_recorders_write_them(write: str, tmp_path: Path) -> None:
    needs = {"mcap": "rosbags", "bag2": "rosbags", "nmea": "pynmea2", "ulog": "pyulog"}
    if write in needs:
        pytest.importorskip(needs[write])
    log = along_its_velocities(written_logs.trial(60.0))
    path = WRITERS[write](log, tmp_path)
    draft = residnet.draft_config(path, folder=tmp_path)
    told = {"csv", "mat5", "mcap", "bag2"}
    assert set(draft.config["signals"]["inputs"]) == (
        {"cmd_port", "cmd_stbd"} if write in told else set()
    )
    guessed = " ".join(why for _, why in draft.guesses)
    assert ("can only predict how the vessel coasts" in guessed) == (write not in told)
    read = validate_config(draft.config["data"]["reader"], ReaderConfig, "here").build().read(path)
    np.testing.assert_allclose(read["u"][5:-5], log["u"][5:-5], atol=2e-3)


def test_a_struct_is_read_by_the_names_of_its_fields(tmp_path: Path) -> None:
    log = written_logs.trial(60.0)
    way = (log["u"] + 1j * log["v"]) * np.exp(1j * log["psi"]) * 0.1
    place = np.cumsum(way) - 0.5 * way
    fields = {"time": log.t, "north": place.real, "east": place.imag}
    fields["heading_deg"] = np.degrees(log["psi"]) % 360.0
    fields |= {"surge_kn": log["u"] * 3600.0 / 1852.0, "sway": log["v"]}
    fields |= {"yaw_rate_dps": np.degrees(log["r"]), "cmd_port": log["cmd_port"]}
    paths = [tmp_path / "still.mat", tmp_path / "trial.mat"]
    for path, moves in zip(paths, (0.0, 1.0), strict=True):
        data = fields | {"cmd_stbd": 4.0 + moves * log["cmd_stbd"]}
        scipy.io.savemat(path, {"trial": data})
    draft = residnet.draft_config(tmp_path, folder=tmp_path)
    channels = draft.config["data"]["reader"]["channels"]
    assert {name: channels[name]["unit"] for name in "uvr"} == {"u": "kn", "v": "m/s", "r": "deg/s"}
    assert draft.config["signals"]["inputs"] == ["cmd_port", "cmd_stbd"]
    assert "data.reader.channels.v" in dict(draft.guesses)
    read = (
        validate_config(draft.config["data"]["reader"], ReaderConfig, "here").build().read(paths[1])
    )
    np.testing.assert_allclose(read["u"][5:-5], log["u"][5:-5], atol=2e-3)
    np.testing.assert_allclose(read["r"][5:-5], log["r"][5:-5], atol=2e-3)
